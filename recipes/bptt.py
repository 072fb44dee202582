"""Backpropagation through time (BPTT): the rewards of one horizon, differentiated.

python recipes/bptt.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import BPTTLoss, differentiable_rollout, restart
from torchrl_quad.training.building import Optimizer, make_loss, set_up, trust_region, update_normalizer
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("bptt")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = make_loss(BPTTLoss, cfg, env, actor)
    optimizer, bound = Optimizer(cfg, "actor", loss), trust_region(cfg, actor)
    run = Run(cfg, env, actor, loss, [optimizer])
    for _ in run:
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        loss_actor, metrics = loss.loss_actor(rollout)
        with bound.around(rollout):
            run.optimise(optimizer, loss_actor + metrics.get("loss_alpha", 0.0))
        update_normalizer(env, rollout)
        run.carry = restart(env, end, cfg.restart_fraction)
        run.record(loss_actor=loss_actor, **metrics, **bound.metrics)


if __name__ == "__main__":
    main()
