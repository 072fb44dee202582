"""Hybrid of pathwise and score-function gradient: each where a rollout says that it is good.

python recipes/hybrid.py task=racing seed=0
"""

from omegaconf import DictConfig
from training.building import iterations, make_optimizer, network, set_up, shuffled, trust_region, update_normalizer
from training.launch import recipe
from training.loop import Run
from training.processes import mean_of_all

from torchrl_quad import HybridLoss, differentiable_rollout, make_value, restart


@recipe("hybrid")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = HybridLoss(actor, make_value(env, **network(cfg, "critic")), average=mean_of_all, **cfg.loss)
    loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    actor_parameters = loss.actor_network_params.parameters()
    actor_optimizer, actor_schedule = make_optimizer(cfg.actor, actor_parameters, iterations(cfg))
    critic_parameters = loss.value_network_params.parameters()
    critic_optimizer, critic_schedule = make_optimizer(cfg.critic, critic_parameters, iterations(cfg))

    stateful = [actor_optimizer, actor_schedule, critic_optimizer, critic_schedule]
    bound = trust_region(cfg, actor)
    run = Run(cfg, env, actor, loss, stateful)
    for _ in run:
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        data = loss.write_targets(rollout)
        with bound.around(data):
            for batch in shuffled(data, cfg.batch_size, cfg.epochs):
                losses = loss(batch)
                run.optimise("actor", actor_optimizer, losses["loss_actor"], cfg.actor.max_grad_norm)
                run.optimise("critic", critic_optimizer, losses["loss_value"], cfg.critic.max_grad_norm)

        update_normalizer(env, data)
        run.carry = restart(env, end, cfg.restart_fraction)
        actor_schedule.step()
        critic_schedule.step()
        run.record(**losses, **{f"{name}_before_bound": x for name, x in bound.metrics.items()})


if __name__ == "__main__":
    main()
