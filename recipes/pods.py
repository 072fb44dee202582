"""Policy optimisation via differentiable simulation (PODS): better actions along a flight, and a policy fitted to them.

python recipes/pods.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import PODSLoss, differentiable_rollout, restart
from torchrl_quad.training.building import Optimizer, make_loss, set_up, trust_region, update_normalizer
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("pods")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = make_loss(PODSLoss, cfg, env, actor)
    optimizer, bound = Optimizer(cfg, "actor", loss), trust_region(cfg, actor)
    run = Run(cfg, env, actor, loss, [optimizer])
    for _ in run:
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        flight = loss.write_action_target(rollout).detach()
        with bound.around(flight):
            for _ in range(cfg.epochs):
                loss_actor, metrics = loss.loss_actor(flight)
                run.optimise(optimizer, loss_actor)
        update_normalizer(env, flight)
        run.carry = restart(env, end, cfg.restart_fraction)
        run.record(loss_actor=loss_actor, **metrics, **bound.metrics)


if __name__ == "__main__":
    main()
