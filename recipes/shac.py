"""Short-horizon actor-critic (SHAC): the rewards of one horizon and the value of its end.

python recipes/shac.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import SHACLoss, differentiable_rollout, make_value, restart
from torchrl_quad.training.building import Optimizer, TargetUpdate, make_loss, set_up, trust_region, update_normalizer
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("shac")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = make_loss(SHACLoss, cfg, env, actor, make_value)
    target, bound = TargetUpdate(loss, tau=cfg.critic.tau), trust_region(cfg, actor)
    actor_optimizer, critic_optimizer = Optimizer(cfg, "actor", loss), Optimizer(cfg, "critic", loss)
    run = Run(cfg, env, actor, loss, [actor_optimizer, critic_optimizer])
    for _ in run:
        # The actor: up the return of one horizon and the value of its end, through the dynamics.
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        loss_actor, metrics = loss.loss_actor(rollout)
        with bound.around(rollout):
            run.optimise(actor_optimizer, loss_actor + metrics.get("loss_alpha", 0.0))

        # The critic: towards the TD(lambda) targets of the target network.
        critic_metrics = run.fit_critic(critic_optimizer, loss.write_value_target(rollout.detach()), target)

        update_normalizer(env, rollout)
        run.carry = restart(env, end, cfg.restart_fraction)
        run.record(loss_actor=loss_actor, **metrics, **bound.metrics, **critic_metrics)


if __name__ == "__main__":
    main()
