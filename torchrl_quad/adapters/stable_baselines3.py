"""A task for stable-baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv

from torchrl_quad.adapters.gym import check_action, check_options
from torchrl_quad.errors import Unsupported, UserTypeError, UserValueError, WrongState, needing
from torchrl_quad.options import Seed, check_value

with needing('DronesVecEnv needs stable-baselines3: pip install ".[adapters]" in a clone'):
    from stable_baselines3.common.vec_env import VecEnv


class DronesVecEnv(VecEnv):
    """All drones of one gymnasium vector environment as a vector environment of stable-baselines3.

    ``DronesVecEnv(gymnasium.make_vec("torchrl_quad/Hovering-v0", num_envs=128, autoreset_mode="SameStep"))``

    A task with a camera has a dictionary of observations, which the policy "MultiInputPolicy" reads.

    At the end of an episode ``info`` holds ``terminal_observation``, ``TimeLimit.truncated`` and ``is_success``,
    whether the last state fulfils the task, of which stable-baselines3 logs its success rate.

    Args:
        env: a vector environment of gymnasium whose autoreset mode is "SameStep".
    """

    def __init__(self, env: VectorEnv) -> None:
        if not isinstance(env, VectorEnv) or not isinstance(env.single_action_space, Box):
            raise UserTypeError(
                f"DronesVecEnv wraps a vector environment of drones, got {type(env).__name__}. Write "
                'gymnasium.make_vec("torchrl_quad/Hovering-v0", num_envs=128, autoreset_mode="SameStep").'
            )
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise UserValueError(
                f"The autoreset mode is {getattr(mode, 'value', mode)!r}, and stable-baselines3 expects an episode to "
                "begin in the step in which the last one ended. Write "
                'gymnasium.make_vec(..., autoreset_mode="SameStep").'
            )
        self.env = env
        self.actions: np.ndarray | None = None  # for the step that is to come
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Begin an episode with all drones, from the seed if ``seed()`` has set one."""
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self.actions = None
        return observation

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next :meth:`reset`; None takes a random one."""
        return super().seed(check_value("seed", seed, Seed | None))

    def set_options(self, options: list[dict] | dict | None = None) -> None:
        """Refuse options for :meth:`reset`: all drones begin together."""
        for each in options if isinstance(options, list) else [options]:
            check_options(each)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (num_envs, 4) for :meth:`step_wait`."""
        self.actions = check_action(actions, self.env.action_space)

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Fly one control step: observations (num_envs, k), rewards and ends (num_envs), an ``info`` of each drone."""
        if self.actions is None:
            raise WrongState("No actions are waiting: call step_async(actions) first, or step(actions) for both.")
        actions, self.actions = self.actions, None
        observation, reward, terminated, truncated, info = self.env.step(actions)
        done, infos = terminated | truncated, [{} for _ in reward]
        for i in np.flatnonzero(done):
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
            }
            if "success" in info["final_info"]:
                infos[i]["is_success"] = bool(info["final_info"]["success"][i])
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of each drone; None without a render mode."""
        pictures = cast("tuple[np.ndarray, ...] | None", self.env.render())
        return [None] * self.num_envs if pictures is None else pictures

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the vector environment, once for each drone of the indices."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """False for each drone of the indices."""
        return [False for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raises: all drones share one environment."""
        raise Unsupported(f"All drones share {attr_name!r}. Set it on the environment before training.")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Raises: all drones share one environment."""
        raise Unsupported(f"All drones share {method_name!r}. Call it on the environment, `.env`.")
