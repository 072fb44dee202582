"""One setting for every task: AHAC with one set of numbers; scale, discount, rate, noise and end follow from the run.

python recipes/train.py task=hovering seed=0
"""

from omegaconf import DictConfig

from torchrl_quad import AHACLoss, differentiable_rollout, make_value, restart
from torchrl_quad.training.building import Optimizer, ReturnScale, make_loss, mean_of_all, set_up, update_normalizer
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("train")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    longest = cfg.loss.max_horizon
    if longest is None and "recurrent_state" in actor.in_keys:  # gradients reach back through a memory for one horizon
        longest = 4 * cfg.horizon
    loss = make_loss(AHACLoss, cfg, env, actor, make_value, horizon=cfg.horizon, max_horizon=longest)
    actor_optimizer, critic_optimizer = Optimizer(cfg, "actor", loss), Optimizer(cfg, "critic", loss)
    scale = ReturnScale(loss)
    run = Run(cfg, env, actor, loss, [actor_optimizer, critic_optimizer, scale])
    for _ in run:
        # Stalls slow the actor down, for which Run has lowered the rate, or stiff gradients. Both leave less noise.
        # Down to min_epochs fewer optimiser steps replace the lower rate, and longer gradients count.
        epochs = max(round(loss.lr_factor * cfg.epochs), min(cfg.min_epochs, cfg.epochs))
        factor = min(run.pace, loss.lr_factor * cfg.epochs / epochs)
        actor_optimizer.param_groups[0]["lr"] *= factor / run.pace
        actor.scale_noise(max(min(run.pace, loss.lr_factor), 0.25))
        if loss.clip is not None:
            loss.clip.factor = cfg.loss.clip_action_gradient * cfg.epochs / epochs
        # After a stall actions follow the simulator further before the critic.
        loss.gradient_lmbda = 1.0 - run.pace * (1.0 - cfg.loss.gradient_lmbda)
        # Until nine tenths of the episodes are solved, or returns level off, the discount looks half as far ahead.
        loss.value_estimator.gamma.fill_(cfg.gamma if run.looks_ahead else max(2.0 * cfg.gamma - 1.0, 0.0))
        run.horizon = loss.horizon
        # The actor: towards actions that raise the return of one horizon and the value of its end.
        rollout, end = differentiable_rollout(env, actor, run.carry, run.horizon)
        scale.divide(rollout)
        target, metrics = loss.better_actions(rollout, cfg.step)
        data = rollout.detach().set("action_target", target)
        for _ in range(epochs):
            loss_actor = loss.loss_fit(data)
            if not run.optimise(actor_optimizer, loss_actor):
                break

        # The critics: towards TD(lambda) targets, from the least of them; more steps as the schedule lowers the rate.
        data = loss.write_value_target(data)
        scale.update(data)
        rate = actor_optimizer.param_groups[0]["lr"]
        share = max(rate / (factor * actor_optimizer.first_lr), 1 / 3)
        critic_metrics = run.fit_critic(critic_optimizer, data, times=1 / share)

        update_normalizer(env, rollout)
        run.carry = restart(env, end, cfg.restart_fraction)
        run.record(horizon=run.horizon, rate=rate, pace=run.pace, lr_factor=loss.lr_factor, scale=scale.value)
        run.record(loss_actor=loss_actor, **metrics, **critic_metrics)
        loss.adapt_horizon(mean_of_all(metrics["stiffness"]))


if __name__ == "__main__":
    main()
