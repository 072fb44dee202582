"""Proximal policy optimisation (PPO): TorchRL's own loss on the same environments, without their gradients.

python recipes/ppo.py task=hovering seed=0
"""

import torch
from omegaconf import DictConfig
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.value import GAE

from torchrl_quad import differentiable_rollout, make_value, restart
from torchrl_quad.objectives.ppo import PlainClipPPOLoss
from torchrl_quad.training.building import Optimizer, mean_of_all, network, set_up, shuffled, task_of, update_normalizer
from torchrl_quad.training.launch import recipe
from torchrl_quad.training.loop import Run


@recipe("ppo")
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    value = make_value(env, **network(cfg, "critic", env))
    advantage = GAE(gamma=cfg.gamma, lmbda=cfg.critic.lmbda, value_network=None, vectorized=False)
    loss = PlainClipPPOLoss(actor, value, compile=task_of(env).is_compiled, **cfg.loss)
    actor_optimizer, critic_optimizer = Optimizer(cfg, "actor", actor), Optimizer(cfg, "critic", value)
    run = Run(cfg, env, actor, loss, [actor_optimizer, critic_optimizer])
    for _ in run:
        with torch.no_grad():
            data, run.carry = differentiable_rollout(env, actor, run.carry, cfg.horizon)
            advantage(loss.write_values(data))

        read = data.select(*loss.in_keys, "advantage", "value_target", strict=False).exclude("next")
        moved = 0.0  # how far the policy is from the one that flew
        for batch in shuffled(read, cfg.batch_size, cfg.epochs):
            if cfg.actor.max_kl is None or moved < cfg.actor.max_kl:
                with set_recurrent_mode(True):  # a memory, if there is one, goes through whole horizons
                    losses = loss(batch)
                moved = mean_of_all(losses["kl_approx"]).abs()  # a mean of samples, which can be negative
                run.optimise(actor_optimizer, losses["loss_actor"])
            else:
                losses["loss_critic"] = loss.loss_critic(batch)[0]
            run.optimise(critic_optimizer, losses["loss_critic"])

        update_normalizer(env, data)
        if cfg.normalize:  # observe again, with the new statistics
            run.carry = restart(env, run.carry, 0.0)
        run.record(**losses.exclude("loss_actor").apply(torch.mean))  # per step of the horizon with a memory


if __name__ == "__main__":
    main()
