"""Hybrid of pathwise and score-function gradient, joined by a regression of the advantage on the derivative.

python recipes/hybrid.py task=racing seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import HybridLoss, differentiable_rollout, make_value, restart
from torchrl_quad.training.building import (
    AdaptiveRate,
    iterations,
    make_optimizer,
    network,
    set_up,
    shuffled,
    update_normalizer,
)
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run
from torchrl_quad.training.processes import mean_of_all


@recipe("hybrid")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = HybridLoss(actor, make_value(env, **network(cfg, "critic", env)), average=mean_of_all, **cfg.loss)
    loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    actor_optimizer, _ = make_optimizer(cfg.actor, loss.actor_network_params.parameters(), iterations(cfg))
    rate = AdaptiveRate(actor_optimizer, cfg.actor.max_kl, iterations(cfg))
    critic_parameters = loss.value_network_params.parameters()
    critic_optimizer, critic_schedule = make_optimizer(cfg.critic, critic_parameters, iterations(cfg))

    run = Run(cfg, env, actor, loss, [actor_optimizer, critic_optimizer, critic_schedule])
    for iteration in run:
        # Both gradients of one horizon, and what they are worth.
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        data = loss.write_targets(rollout)
        read = data.exclude("state", "next", "metrics", "reward_terms")  # which minibatches do not read

        # Several passes over it, until the policy has moved far enough.
        moved = 0.0
        for batch in shuffled(read, cfg.batch_size, cfg.epochs):
            losses = loss(batch)
            if moved < rate.limit(iteration):
                moved = max(moved, mean_of_all(losses["kl"]).item())
                run.optimise("actor", actor_optimizer, losses["loss_actor"], cfg.actor.max_grad_norm)
            run.optimise("critic", critic_optimizer, losses["loss_value"], cfg.critic.max_grad_norm)

        update_normalizer(env, data)
        run.carry = restart(env, end, cfg.restart_fraction)
        rate.step(iteration, moved)
        critic_schedule.step()
        run.record(**losses)


if __name__ == "__main__":
    main()
