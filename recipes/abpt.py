"""Amended backpropagation through time (ABPT): N-step and 0-step return, from visited states.

python recipes/abpt.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import ABPTLoss, VisitedStateBuffer, differentiable_rollout, make_qvalue, restart
from torchrl_quad.training.building import (
    TargetUpdate,
    actor_parameters,
    iterations,
    make_optimizer,
    minibatches,
    network,
    own_seed,
    set_up,
    trust_region,
    update_normalizer,
)
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("abpt")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = ABPTLoss(actor, make_qvalue(env, **network(cfg, "critic", env)), **cfg.loss)
    loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    target = TargetUpdate(loss, tau=cfg.critic.tau)
    buffer = VisitedStateBuffer(cfg.buffer.capacity, env, seed=own_seed(cfg), actor=actor)

    actor_optimizer, actor_schedule = make_optimizer(cfg.actor, actor_parameters(loss), iterations(cfg))
    critic_parameters = loss.qvalue_network_params.parameters()
    critic_optimizer, critic_schedule = make_optimizer(cfg.critic, critic_parameters, iterations(cfg))

    stateful = [actor_optimizer, actor_schedule, critic_optimizer, critic_schedule]
    bound = trust_region(cfg, actor)
    run = Run(cfg, env, actor, loss, stateful, buffer)
    for _ in run:
        # The actor: up the N-step and the 0-step return of one horizon, through the dynamics.
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        loss_actor, actor_metrics = loss.loss_actor(rollout)
        loss_alpha = actor_metrics.get("loss_alpha", 0.0)
        with bound.around(rollout):
            run.optimise("actor", actor_optimizer, loss_actor + loss_alpha, cfg.actor.max_grad_norm)

        # The critics: towards the TD(lambda) targets of the target networks.
        data = loss.write_value_target(rollout.detach())
        read = data.select(*loss.qvalue_network.in_keys, loss.tensor_keys.value_target)
        for batch in minibatches(read, cfg.critic):
            loss_qvalue, critic_metrics = loss.loss_qvalue(batch)
            run.optimise("critic", critic_optimizer, loss_qvalue, cfg.critic.max_grad_norm)
            target.step()

        # The next horizon starts where the policy has been before, and in part afresh.
        update_normalizer(env, data)
        buffer.extend(data)
        if cfg.buffer.fraction is None:  # or where the last one has ended
            run.carry = restart(env, end, cfg.restart_fraction)
        else:
            run.carry = buffer.initial_state(env, cfg.buffer.fraction)

        actor_schedule.step()
        critic_schedule.step()
        run.record(loss_actor=loss_actor, loss_qvalue=loss_qvalue, **actor_metrics, **bound.metrics, **critic_metrics)


if __name__ == "__main__":
    main()
