"""Adaptive-horizon actor-critic (AHAC): SHAC with a horizon that is shorter where the adjoint grows along it.

python recipes/ahac.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import AHACLoss, differentiable_rollout, make_value, restart
from torchrl_quad.training.building import (
    actor_parameters,
    advance,
    iterations,
    make_optimizer,
    minibatches,
    network,
    set_up,
    trust_region,
    update_normalizer,
)
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run
from torchrl_quad.training.processes import mean_of_all


@recipe("ahac")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = AHACLoss(actor, make_value(env, **network(cfg, "critic", env)), horizon=cfg.horizon, **cfg.loss)
    loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    actor_optimizer, actor_schedule = make_optimizer(cfg.actor, actor_parameters(loss), iterations(cfg))
    critic_parameters = loss.value_network_params.parameters()
    critic_optimizer, critic_schedule = make_optimizer(cfg.critic, critic_parameters, iterations(cfg))

    stateful = [actor_optimizer, actor_schedule, critic_optimizer, critic_schedule]
    bound = trust_region(cfg, actor)
    run = Run(cfg, env, actor, loss, stateful)
    for _ in run:
        run.horizon = loss.horizon
        # The actor: up the return of one horizon and the value of its end, through the dynamics.
        rollout, end = differentiable_rollout(env, actor, run.carry, run.horizon)
        loss_actor, actor_metrics = loss.loss_actor(rollout)
        loss_alpha = actor_metrics.get("loss_alpha", 0.0)
        with bound.around(rollout):
            run.optimise("actor", actor_optimizer, loss_actor + loss_alpha, cfg.actor.max_grad_norm)

        # The critics: towards TD(lambda) targets, from the least of them.
        data = loss.write_value_target(rollout.detach())
        read = data.select(*loss.value_network.in_keys, loss.tensor_keys.value_target)
        for batch in minibatches(read, cfg.critic):
            loss_value, critic_metrics = loss.loss_value(batch)
            run.optimise("critic", critic_optimizer, loss_value, cfg.critic.max_grad_norm)

        update_normalizer(env, rollout)
        run.carry = restart(env, end, cfg.restart_fraction)
        loss.adapt_horizon(mean_of_all(actor_metrics["stiffness"]))
        for schedule in (actor_schedule, critic_schedule):  # over the steps of the run, whatever its horizons are
            advance(schedule, (run.steps / run.drones + run.horizon) / cfg.horizon)
        run.record(
            horizon=run.horizon,
            loss_actor=loss_actor,
            loss_value=loss_value,
            **actor_metrics,
            **bound.metrics,
            **critic_metrics,
        )


if __name__ == "__main__":
    main()
