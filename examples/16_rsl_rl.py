"""Train PPO of rsl-rl to hover."""

import torch
from rsl_rl.runners import OnPolicyRunner

from torchrl_quad import HoveringEnv
from torchrl_quad.adapters import RslRlVecEnv

ITERATIONS = 54
NETWORK = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "tanh"}
CONFIG = {
    "num_steps_per_env": 24,
    "save_interval": 50,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": {**NETWORK, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5}},
    "critic": NETWORK,
    "algorithm": {
        "class_name": "PPO",
        "gamma": 0.98,
        "entropy_coef": 0.0,
        "num_learning_epochs": 3,
        "desired_kl": 0.02,
    },
}


def train(seed=0, log_dir=None):
    """Train PPO for the budget; return its policy. With a log_dir, rsl-rl writes checkpoints and curves there."""
    torch.manual_seed(seed)
    env = HoveringEnv(num_envs=512, seed=seed)
    runner = OnPolicyRunner(RslRlVecEnv(env), CONFIG, log_dir)
    runner.alg.actor.mlp[-1].bias.data.copy_(env.hover_action)  # a new policy hovers
    runner.learn(ITERATIONS)
    runner.alg.desired_kl = 0.003  # by which rsl-rl chooses the learning rate
    runner.learn(ITERATIONS // 3)
    return runner.get_inference_policy()


@torch.no_grad()
def mean_return(policy, seed):
    """The mean return over an episode of each of 256 drones, 25.6 at most."""
    drones = RslRlVecEnv(HoveringEnv(num_envs=256, seed=seed))
    observation, total, flies = drones.get_observations(), 0.0, torch.ones(256)
    while flies.any():
        observation, reward, done, _ = drones.step(policy(observation))
        total, flies = total + (reward * flies).mean().item(), flies * ~done
    return total


if __name__ == "__main__":
    torch.set_num_threads(1)
    print("mean return:", mean_return(train(), seed=1000))
