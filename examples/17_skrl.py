"""Train PPO of skrl to hover."""

import torch
from skrl.agents.torch.ppo import PPO
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model
from torch.optim.lr_scheduler import LinearLR

from torchrl_quad import HoveringEnv
from torchrl_quad.adapters import SkrlEnv

ITERATIONS = 60
ROLLOUT, EPOCHS = 24, 3
CONFIG = {
    "rollouts": ROLLOUT,
    "learning_epochs": EPOCHS,
    "mini_batches": 4,
    "learning_rate": 3e-3,
    "learning_rate_scheduler": LinearLR,
    "learning_rate_scheduler_kwargs": {"start_factor": 1, "end_factor": 0.05, "total_iters": ITERATIONS * EPOCHS},
    "discount_factor": 0.98,
    "value_loss_scale": 1.0,
    "time_limit_bootstrap": True,
    "experiment": {"write_interval": 0, "checkpoint_interval": 0},
}
NETWORK = [{"name": "layers", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}]


def train(seed=0):
    """Train PPO for the budget; return its agent."""
    torch.manual_seed(seed)
    env = SkrlEnv(HoveringEnv(num_envs=512, seed=seed))
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    policy = gaussian_model(**spaces, network=NETWORK, output="ACTIONS", initial_log_std=-0.7)
    value = deterministic_model(**spaces, network=NETWORK, output="ONE")
    policy.init_state_dict(), value.init_state_dict()
    memory = RandomMemory(memory_size=ROLLOUT, num_envs=env.num_envs, device=env.device)
    agent = PPO(models={"policy": policy, "value": value}, memory=memory, cfg=CONFIG, **spaces)
    options = {"timesteps": ITERATIONS * ROLLOUT, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=options).train()
    return agent


@torch.no_grad()
def mean_return(agent, seed):
    """The mean return over an episode of each of 256 drones, 25.6 at most."""
    env = SkrlEnv(HoveringEnv(num_envs=256, seed=seed))
    (observation, _), total, flies = env.reset(), 0.0, torch.ones(256, 1)
    while flies.any():
        _, outputs = agent.act(observation, None, timestep=0, timesteps=1)
        observation, reward, terminated, truncated, _ = env.step(outputs["mean_actions"])
        total, flies = total + (reward * flies).mean().item(), flies * ~(terminated | truncated)
    return total


if __name__ == "__main__":
    torch.set_num_threads(1)
    print("mean return:", mean_return(train(), seed=1000))
