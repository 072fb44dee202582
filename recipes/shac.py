"""Short-horizon actor-critic (SHAC): the rewards of one horizon and the value of its end.

python recipes/shac.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import SHACLoss, differentiable_rollout, make_value, restart
from torchrl_quad.training.building import (
    TargetUpdate,
    actor_parameters,
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


@recipe("shac")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    loss = SHACLoss(actor, make_value(env, **network(cfg, "critic", env)), **cfg.loss)
    loss.make_value_estimator(gamma=cfg.gamma, lmbda=cfg.critic.lmbda)
    target = TargetUpdate(loss, tau=cfg.critic.tau)
    actor_optimizer, actor_schedule = make_optimizer(cfg.actor, actor_parameters(loss), iterations(cfg))
    critic_parameters = loss.value_network_params.parameters()
    critic_optimizer, critic_schedule = make_optimizer(cfg.critic, critic_parameters, iterations(cfg))

    stateful = [actor_optimizer, actor_schedule, critic_optimizer, critic_schedule]
    bound = trust_region(cfg, actor)
    run = Run(cfg, env, actor, loss, stateful)
    for _ in run:
        # The actor: up the return of one horizon and the value of its end, through the dynamics.
        rollout, end = differentiable_rollout(env, actor, run.carry, cfg.horizon)
        loss_actor, actor_metrics = loss.loss_actor(rollout)
        loss_alpha = actor_metrics.get("loss_alpha", 0.0)
        with bound.around(rollout):
            run.optimise("actor", actor_optimizer, loss_actor + loss_alpha, cfg.actor.max_grad_norm)

        # The critic: towards the TD(lambda) targets of the target network.
        data = loss.write_value_target(rollout.detach())
        read = data.select(*loss.value_network.in_keys, loss.tensor_keys.value_target)
        for batch in minibatches(read, cfg.critic):
            loss_value, critic_metrics = loss.loss_value(batch)
            run.optimise("critic", critic_optimizer, loss_value, cfg.critic.max_grad_norm)
            target.step()

        update_normalizer(env, rollout)
        run.carry = restart(env, end, cfg.restart_fraction)
        actor_schedule.step()
        critic_schedule.step()
        run.record(loss_actor=loss_actor, loss_value=loss_value, **actor_metrics, **bound.metrics, **critic_metrics)


if __name__ == "__main__":
    main()
