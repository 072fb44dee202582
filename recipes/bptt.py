"""Backpropagation through time (BPTT): the rewards of one horizon, differentiated.

python recipes/bptt.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import BPTTLoss, differentiable_rollout, restart
from torchrl_quad.training.building import (
    actor_parameters,
    iterations,
    make_optimizer,
    set_up,
    trust_region,
    update_normalizer,
)
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("bptt")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = BPTTLoss(actor, **cfg.loss).make_value_estimator(gamma=cfg.gamma)
    optimizer, schedule = make_optimizer(cfg.actor, actor_parameters(loss), iterations(cfg))

    bound = trust_region(cfg, actor)
    run = Run(cfg, env, actor, loss, [optimizer, schedule])
    for _ in run:
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        loss_actor, metrics = loss.loss_actor(rollout)
        loss_alpha = metrics.get("loss_alpha", 0.0)
        with bound.around(rollout):
            run.optimise("actor", optimizer, loss_actor + loss_alpha, cfg.actor.max_grad_norm)
        update_normalizer(env, rollout)
        run.carry = restart(env, end, cfg.restart_fraction)
        schedule.step()
        run.record(loss_actor=loss_actor, **metrics, **bound.metrics)


if __name__ == "__main__":
    main()
