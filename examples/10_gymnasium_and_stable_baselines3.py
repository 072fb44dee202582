"""Train PPO of stable-baselines3 to hover, on all drones of one gymnasium vector environment."""

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from torchrl_quad.adapters import DronesVecEnv

STEPS = 300_000
TASK = "torchrl_quad:torchrl_quad/Hovering-v0"  # the part before the colon is the package to import


def train(seed=0):
    """Train PPO for the budget; return its mean return over an episode of each drone, 25.6 at most."""
    drones = VecNormalize(DronesVecEnv(gymnasium.make_vec(TASK, num_envs=128, autoreset_mode="SameStep")))
    options = {"n_steps": 32, "batch_size": 1024, "n_epochs": 5, "learning_rate": 1e-3}
    ppo = PPO("MlpPolicy", drones, **options, seed=seed, device="cpu").learn(STEPS)
    drones.training = drones.norm_reward = False
    return evaluate_policy(ppo, drones, n_eval_episodes=drones.num_envs, warn=False)[0]


if __name__ == "__main__":
    print("mean return:", train())
