"""A task for skrl."""

from __future__ import annotations

from typing import Any

from gymnasium import Space
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.adapters.torch_vector import TorchVectorEnv
from torchrl_quad.errors import needing

with needing('SkrlEnv needs skrl: pip install ".[adapters]" in a clone'):
    from skrl.envs.wrappers.torch import Wrapper


class SkrlEnv(Wrapper):
    """An environment of skrl: ``SequentialTrainer(env=SkrlEnv(HoveringEnv(num_envs=512)), agents=agent, cfg=...)``.

    It takes the place of skrl's ``wrap_env``. Rewards and ends are (num_envs, 1); ``info`` is that of
    :class:`~torchrl_quad.adapters.TorchVectorEnv`, which resets in the step in which an episode ends.

    Args:
        env: as for :class:`~torchrl_quad.adapters.TorchVectorEnv`; a task, or transforms around one.
    """

    def __init__(self, env: EnvBase) -> None:
        super().__init__(TorchVectorEnv(env))

    @property
    def observation_space(self) -> Space:
        """That of one drone."""
        return self._env.single_observation_space

    @property
    def action_space(self) -> Space:
        """That of one drone."""
        return self._env.single_action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Tensor, dict[str, Any]]:
        """Begin an episode with all drones: observations (num_envs, k), and ``info``."""
        return self._env.reset(seed=seed, options=options)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Fly one control step with actions (num_envs, 4); it refuses what the adapter inside refuses."""
        observation, *ends, info = self._env.step(actions)
        return observation, *(x.unsqueeze(-1) for x in ends), info

    def state(self) -> None:
        """None: the observation is all there is."""

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Nothing: trainers call it at each step. ``env.torchrl_env.render()`` draws."""

    def close(self) -> None:
        """Close the TorchRL environment."""
        self._env.close()
