"""Amended backpropagation through time (ABPT): N-step and 0-step return, from visited states.

python recipes/abpt.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import ABPTLoss, VisitedStateBuffer, differentiable_rollout, make_qvalue, restart
from torchrl_quad.training.building import Optimizer, TargetUpdate, make_loss, set_up, trust_region, update_normalizer
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run, own_seed


@recipe("abpt")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = make_loss(ABPTLoss, cfg, env, actor, make_qvalue)
    target, bound = TargetUpdate(loss, tau=cfg.critic.tau), trust_region(cfg, actor)
    buffer = VisitedStateBuffer(cfg.buffer.capacity, env, seed=own_seed(cfg), actor=actor)
    actor_optimizer, critic_optimizer = Optimizer(cfg, "actor", loss), Optimizer(cfg, "critic", loss)
    run = Run(cfg, env, actor, loss, [actor_optimizer, critic_optimizer], buffer)
    for _ in run:
        # The actor: up the N-step and the 0-step return of one horizon, through the dynamics.
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        loss_actor, metrics = loss.loss_actor(rollout)
        with bound.around(rollout):
            run.optimise(actor_optimizer, loss_actor + metrics.get("loss_alpha", 0.0))

        # The critics: towards the TD(lambda) targets of the target networks.
        data = loss.write_value_target(rollout.detach())
        critic_metrics = run.fit_critic(critic_optimizer, data, target)

        # The next horizon starts where the policy has been before, and in part from a fresh start.
        update_normalizer(env, data)
        buffer.extend(data)
        if cfg.buffer.fraction is None:  # or where the last one has ended
            run.carry = restart(env, end, cfg.restart_fraction)
        else:
            run.carry = buffer.initial_state(env, cfg.buffer.fraction)
        run.record(loss_actor=loss_actor, **metrics, **bound.metrics, **critic_metrics)


if __name__ == "__main__":
    main()
