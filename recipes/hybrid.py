"""Hybrid of pathwise and score-function gradient, joined by a regression of the advantage on the derivative.

python recipes/hybrid.py task=racing seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import HybridLoss, differentiable_rollout, make_value, restart
from torchrl_quad.training.building import (
    AdaptiveOptimizer,
    Optimizer,
    make_loss,
    mean_of_all,
    set_up,
    shuffled,
    update_normalizer,
)
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("hybrid")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = make_loss(HybridLoss, cfg, env, actor, make_value, average=mean_of_all)
    actor_optimizer, critic_optimizer = AdaptiveOptimizer(cfg, "actor", loss), Optimizer(cfg, "critic", loss)
    run = Run(cfg, env, actor, loss, [actor_optimizer, critic_optimizer])
    for _ in run:
        # Both gradients of one horizon, and what they are worth.
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        data = loss.write_targets(rollout)
        read = data.exclude("state", "next", "metrics", "reward_terms")  # which minibatches do not read

        # Several passes over it, until the policy has moved far enough.
        moved = 0.0
        for batch in shuffled(read, cfg.batch_size, cfg.epochs):
            losses = loss(batch)
            if moved < actor_optimizer.limit:
                moved = max(moved, mean_of_all(losses["kl"]).item())
                run.optimise(actor_optimizer, losses["loss_actor"])
            run.optimise(critic_optimizer, losses["loss_value"])

        update_normalizer(env, data)
        run.carry = restart(env, end, cfg.restart_fraction)
        actor_optimizer.adapt(moved)
        run.record(**losses)


if __name__ == "__main__":
    main()
