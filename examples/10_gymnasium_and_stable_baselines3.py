"""All drones in one gymnasium vector environment, and PPO of stable-baselines3 that learns to hover with them."""
# ruff: noqa: D102, the methods are those of VecEnv

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

STEPS = 300_000
TASK = "torchrl_quad:torchrl_quad/Hovering-v0"  # the part before the colon is the package that knows the task


class DronesVecEnv(VecEnv):
    """What stable-baselines3 calls a vector environment, around one of gymnasium whose autoreset mode is "SameStep"."""

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

    def _one_by_one(self, *args, **kwargs):
        raise NotImplementedError("The drones are one environment, and none can be changed alone: see env.torchrl_env.")

    set_attr = env_method = _one_by_one


def train(seed=0):
    """A policy that PPO has trained for the budget."""
    drones = DronesVecEnv(gymnasium.make_vec(TASK, num_envs=128, autoreset_mode="SameStep"))
    options = {"n_steps": 32, "batch_size": 1024, "n_epochs": 5, "learning_rate": 1e-3}
    ppo = PPO("MlpPolicy", VecNormalize(drones), **options, seed=seed, device="cpu").learn(STEPS)
    return lambda seen: ppo.predict(ppo.get_vec_normalize_env().normalize_obs(seen), deterministic=True)[0]


def mean_return(policy, seed, num_envs=128):
    """Over the first episode of each drone; a policy maps observations (num_envs, k) to actions (num_envs, 4)."""
    env = gymnasium.make_vec(TASK, num_envs=num_envs)
    (observation, _), total, first = env.reset(seed=seed), 0.0, np.ones(num_envs, dtype=bool)
    while first.any():
        observation, reward, terminated, truncated, _ = env.step(policy(observation))
        total, first = total + reward * first, first & ~(terminated | truncated)
    return total.mean()


if __name__ == "__main__":
    random = np.random.default_rng(0)
    print("mean return of random actions:", mean_return(lambda seen: random.uniform(-1, 1, (len(seen), 4)), seed=1))
    print("mean return of what PPO learnt:", mean_return(train(), seed=1))
