"""Train PPO of stable-baselines3 to hover, on all drones of one gymnasium vector environment."""
# ruff: noqa: D102, the docstrings of the methods are in VecEnv

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

STEPS = 300_000
TASK = "torchrl_quad:torchrl_quad/Hovering-v0"  # the part before the colon is the package to import


class DronesVecEnv(VecEnv):
    """A vector environment of stable-baselines3 around one of gymnasium with the autoreset mode "SameStep"."""

    def __init__(self, env):
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self):
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observation

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        observation, reward, terminated, truncated, info = self.env.step(self.actions)
        done, infos = terminated | truncated, [{} for _ in reward]
        for i in np.flatnonzero(done):
            infos[i]["terminal_observation"] = info["final_obs"][i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return observation, reward.astype(np.float32), done, infos

    def close(self):
        self.env.close()

    def get_attr(self, name, indices=None):
        return [getattr(self.env, name) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper, indices=None):
        return [False for _ in self._get_indices(indices)]

    set_attr = env_method = None  # the drones are one environment, so none can change alone


def train(seed=0):
    """Train PPO for the budget; return its mean return over an episode of each drone, 25.6 at most."""
    drones = VecNormalize(DronesVecEnv(gymnasium.make_vec(TASK, num_envs=128, autoreset_mode="SameStep")))
    options = {"n_steps": 32, "batch_size": 1024, "n_epochs": 5, "learning_rate": 1e-3}
    ppo = PPO("MlpPolicy", drones, **options, seed=seed, device="cpu").learn(STEPS)
    drones.training = drones.norm_reward = False
    return evaluate_policy(ppo, drones, n_eval_episodes=drones.num_envs, warn=False)[0]


if __name__ == "__main__":
    print("mean return:", train())
