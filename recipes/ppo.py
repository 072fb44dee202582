"""Proximal policy optimisation (PPO): TorchRL's own loss on the same environments, without their gradients.

python recipes/ppo.py task=hovering seed=0
"""

import hydra
import torch
from common import Run, descend, iterations, make_optimizer, network, set_up, shuffled, update_normalizer
from omegaconf import DictConfig
from torchrl.collectors import Collector
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_quad import make_value


@hydra.main(config_path="config", config_name="ppo", version_base=None)
def main(cfg: DictConfig) -> None:
    env, actor = set_up(cfg)
    value = make_value(env, **network(cfg.critic))
    advantage = GAE(gamma=cfg.gamma, lmbda=cfg.critic.lmbda, value_network=value, vectorized=False)
    loss = ClipPPOLoss(actor, value, **cfg.loss)
    actor_optimizer, actor_schedule = make_optimizer(cfg.actor, actor.parameters(), iterations(cfg))
    critic_optimizer, critic_schedule = make_optimizer(cfg.critic, value.parameters(), iterations(cfg))

    run = Run(cfg, env, actor, loss=loss)
    frames = cfg.num_envs * cfg.horizon
    collector = iter(Collector(env, actor, frames_per_batch=frames, auto_register_policy_transforms=False))
    for _ in run:
        data = next(collector)
        with torch.no_grad():
            advantage(data)
        for _ in range(cfg.epochs):
            for batch in shuffled(data, cfg.batch_size):
                losses = loss(batch)
                loss_actor = losses["loss_objective"] + losses.get("loss_entropy", 0.0)
                grad_actor = descend(actor_optimizer, loss_actor, cfg.actor.max_grad_norm)
                descend(critic_optimizer, losses["loss_critic"], cfg.critic.max_grad_norm)

        update_normalizer(env, data)
        actor_schedule.step()
        critic_schedule.step()
        run.record(grad_actor=grad_actor, **losses)


if __name__ == "__main__":
    main()
