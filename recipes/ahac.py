"""Adaptive-horizon actor-critic (AHAC): SHAC with a horizon that is shorter where the adjoint grows along it.

python recipes/ahac.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import AHACLoss, differentiable_rollout, make_value, restart
from torchrl_quad.training.building import Optimizer, make_loss, mean_of_all, set_up, trust_region, update_normalizer
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("ahac")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = make_loss(AHACLoss, cfg, env, actor, make_value, horizon=cfg.horizon)
    actor_optimizer, critic_optimizer = Optimizer(cfg, "actor", loss), Optimizer(cfg, "critic", loss)
    bound = trust_region(cfg, actor)
    run = Run(cfg, env, actor, loss, [actor_optimizer, critic_optimizer])
    for _ in run:
        actor_optimizer.param_groups[0]["lr"] *= loss.lr_factor
        run.horizon = loss.horizon
        # The actor: up the return of one horizon and the value of its end, through the dynamics.
        rollout, end = differentiable_rollout(env, actor, run.carry, run.horizon)
        loss_actor, metrics = loss.loss_actor(rollout)
        with bound.around(rollout):
            run.optimise(actor_optimizer, loss_actor + metrics.get("loss_alpha", 0.0))

        # The critics: towards TD(lambda) targets, from the least of them.
        critic_metrics = run.fit_critic(critic_optimizer, loss.write_value_target(rollout.detach()))

        update_normalizer(env, rollout)
        run.carry = restart(env, end, cfg.restart_fraction)
        loss.adapt_horizon(mean_of_all(metrics["stiffness"]))
        run.record(horizon=run.horizon, loss_actor=loss_actor, **metrics, **bound.metrics, **critic_metrics)


if __name__ == "__main__":
    main()
