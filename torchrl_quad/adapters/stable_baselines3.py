"""A task for stable-baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from torchrl_quad.errors import MissingPackage, UserValueError

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise MissingPackage('DronesVecEnv needs stable-baselines3: pip install ".[adapters]" in a clone') from error


class DronesVecEnv(VecEnv):
    """All drones of one gymnasium vector environment as a vector environment of stable-baselines3.

    ``DronesVecEnv(gymnasium.make_vec("torchrl_quad/Hovering-v0", num_envs=128, autoreset_mode="SameStep"))``

    A task with a camera has a dictionary of observations, which the policy "MultiInputPolicy" reads.

    At the end of an episode ``info`` holds ``terminal_observation``, ``TimeLimit.truncated`` and ``is_success``,
    whether the last state fulfils the task, of which stable-baselines3 logs its success rate.

    Args:
        env: a vector environment of gymnasium whose autoreset mode is "SameStep".

    Raises:
        ImportError: stable-baselines3 is missing.
        ValueError: the autoreset mode is another.
    """

    def __init__(self, env: VectorEnv) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise UserValueError(
                f"The autoreset mode is {getattr(mode, 'value', mode)!r}, and stable-baselines3 expects an episode to "
                "begin in the step in which the last one ended. Write "
                'gymnasium.make_vec(..., autoreset_mode="SameStep").'
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Begin an episode with all drones, from the seed if ``seed()`` has set one."""
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (num_envs, 4) for :meth:`step_wait`."""
        self.actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Fly one control step: observations (num_envs, k), rewards and ends (num_envs), an ``info`` of each drone."""
        observation, reward, terminated, truncated, info = self.env.step(self.actions)
        done, infos = terminated | truncated, [{} for _ in reward]
        for i in np.flatnonzero(done):
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "is_success": bool(info["final_info"]["success"][i]),
            }
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of each drone."""
        return self.env.render()

    def get_attr(self, name: str, indices: Any = None) -> list[Any]:
        """An attribute of the vector environment, once for each drone of the indices."""
        return [getattr(self.env, name) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper: type, indices: Any = None) -> list[bool]:
        """False for each drone of the indices: none is wrapped on its own."""
        return [False for _ in self._get_indices(indices)]

    def set_attr(self, name: str, value: Any, indices: Any = None) -> None:
        """Refused: the drones are one environment, and none can change alone."""
        raise NotImplementedError(
            f"Drones of one environment share {name!r}. Set it on the environment before training."
        )

    def env_method(self, name: str, *arguments: Any, indices: Any = None, **keywords: Any) -> list[Any]:
        """Refused: the drones are one environment, and none can be called alone."""
        raise NotImplementedError(f"Drones of one environment share {name!r}. Call it on the environment, `.env`.")
