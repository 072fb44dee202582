"""A task as a vector environment of plain tensors, without TensorDicts and without numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.errors import UserValueError

_INFO = "success", "crash", "reward_terms", "metrics"


class TorchVectorEnv:
    """Tensors in and out, in the manner of gymnasium's vector environments; all stay on the environment's device.

    An episode that has ended begins anew in the same step. The observation that ``step`` returns is then the first of
    the next episode, and ``info["final_obs"]`` has the last of the one before. There is no gradient: for gradients fly
    the TorchRL environment itself, with :func:`~torchrl_quad.differentiable_rollout`.

    ``info`` tells how the step ended, also where an episode began anew: ``success`` and ``crash``, bool (num_envs);
    ``reward_terms`` and ``metrics``, floats (num_envs) by name; ``final_obs`` (num_envs, k), all observations at the
    end of the step.

    Args:
        env: a task, ``HoveringEnv(num_envs=512, compile=True)``, or any TorchRL environment of batch size (num_envs)
            with one ``observation`` and one ``action``; transforms around a task work, too.

    Raises:
        ValueError: the environment has another batch size.
    """

    metadata = {"autoreset_mode": "SameStep"}

    def __init__(self, env: EnvBase) -> None:
        if len(env.batch_size) != 1:
            raise UserValueError(
                f"The environment has the batch size {tuple(env.batch_size)}, and must have one dimension. Build it "
                "with the number of its drones, HoveringEnv(num_envs=512)."
            )
        self.torchrl_env = env
        self.num_envs, self.device = env.batch_size[0], env.device
        action = env.action_spec.space
        self._low, self._high = action.low, action.high
        size = env.observation_spec["observation"].shape[-1]
        self.single_observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = Box(*(x[0].numpy(force=True).astype(np.float32) for x in (self._low, self._high)))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.now: TensorDictBase | None = None  # what the next step starts from

    @property
    def unwrapped(self) -> TorchVectorEnv:
        """This environment itself."""
        return self

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Tensor, dict[str, Any]]:
        """Begin an episode with all drones: observations (num_envs, k), and an empty ``info``."""
        with torch.inference_mode(False), torch.no_grad():
            if seed is not None:
                self.torchrl_env.set_seed(seed)
            self.now = self.torchrl_env.reset()
        return self.now["observation"], {}

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Fly one control step with actions (num_envs, 4), clipped to the bounds of the action.

        Returns:
            observations (num_envs, k); rewards, and bool ``terminated`` and ``truncated``, each (num_envs); ``info``.

        Raises:
            RuntimeError: before the first reset.
            ValueError: the actions have another shape.
        """
        if self.now is None:
            raise RuntimeError("A step needs an episode: call reset() first.")
        if action.shape != self._low.shape:
            raise UserValueError(
                f"The actions have shape {tuple(action.shape)}, expected {tuple(self._low.shape)}: a row a drone."
            )
        # Frameworks act in inference mode, whose tensors could not be differentiated later.
        with torch.inference_mode(False), torch.no_grad():
            action = action.to(self._low).clamp(self._low, self._high)
            flown, self.now = self.torchrl_env.step_and_maybe_reset(self.now.set("action", action))
        end = flown["next"]
        reward, terminated, truncated = (end[name].squeeze(-1) for name in ("reward", "terminated", "truncated"))
        info = {name: _squeezed(end[name]) for name in _INFO if name in end.keys()}  # noqa: SIM118, a tensordict
        info["final_obs"] = end["observation"]
        return self.now["observation"], reward, terminated, truncated, info

    def close(self) -> None:
        """Close the TorchRL environment."""
        self.torchrl_env.close()


def _squeezed(x: Any) -> Any:
    """An entry (n, 1) as (n); of a tensordict each by its name."""
    return x.squeeze(-1) if isinstance(x, Tensor) else {name: _squeezed(y) for name, y in x.items()}
