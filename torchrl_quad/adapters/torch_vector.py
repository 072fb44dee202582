"""A task as a vector environment of plain tensors, without TensorDicts and without numpy."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Unbounded
from torchrl.envs import EnvBase

from torchrl_quad.adapters.gym import INFO, check_numbers, check_open, check_options
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.options import Seed, check_value

_FLOATS = torch.float16, torch.bfloat16, torch.float32, torch.float64


class TorchVectorEnv:
    """Tensors in and out, in the manner of gymnasium's vector environments; all stay on the environment's device.

    An episode that ends resets in the same step: ``step`` returns the first observation of the next episode. There is
    no gradient: for gradients fly the TorchRL environment itself, with :func:`~torchrl_quad.differentiable_rollout`.

    ``info`` tells how the step ended, before any reset: ``success`` and ``crash``, bool (num_envs); ``reward_terms``
    and ``metrics``, floats (num_envs) by name; ``final_obs`` (num_envs, k), all observations.

    Args:
        env: a task, ``HoveringEnv(num_envs=512, compile=True)``, or any TorchRL environment of batch size (num_envs)
            with one ``observation`` and one ``action``; transforms around a task work, too.
    """

    metadata = {"autoreset_mode": "SameStep"}

    def __init__(self, env: EnvBase) -> None:
        if not isinstance(env, EnvBase):
            raise UserTypeError(
                "The environment must be a task or another TorchRL environment, such as HoveringEnv(num_envs=512); got "
                f"{type(env).__name__}."
            )
        batch, action, shown = (cast("Any", x) for x in (env.batch_size, env.action_spec, env.observation_spec))
        if len(batch) != 1:
            raise UserValueError(
                f"The environment has the batch size {tuple(batch)}; build it with a number of drones, "
                "HoveringEnv(num_envs=512)."
            )
        observation = shown.get("observation", None)
        if not (isinstance(action, Bounded | Unbounded) and action.dtype in _FLOATS) or observation is None:
            raise UserTypeError(
                'The environment must have one action of floats and an entry "observation"; its actions are '
                f"{type(action).__name__}, and it shows {', '.join(map(str, shown.keys()))}."
            )
        if "depth" in shown:
            raise UserValueError(
                "The environment shows depth images, which plain observations leave out. Build it with camera=None, or "
                "fly it with GymVectorEnv, whose observations are dictionaries."
            )
        self.torchrl_env, self.closed = env, False
        self.num_envs, self.device = batch[0], env.device
        space = cast("Any", action.space)
        self._low, self._high = space.low, space.high
        size = observation.shape[-1]
        self.single_observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = Box(*(x[0].numpy(force=True).astype(np.float32) for x in (self._low, self._high)))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.now: TensorDictBase | None = None  # what the next step starts from

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Tensor, dict[str, Any]]:
        """Begin an episode with all drones: observations (num_envs, k), and an empty ``info``; there are no options."""
        seed = check_value("seed", seed, Seed | None)
        check_options(options)
        check_open(self)
        with torch.inference_mode(False), torch.no_grad():
            if seed is not None:
                self.torchrl_env.set_seed(seed)
            self.now = self.torchrl_env.reset()
        return self.now["observation"], {}

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Fly one control step with actions (num_envs, 4), clipped to the bounds of the action.

        Returns observations (num_envs, k); rewards, bool ``terminated`` and ``truncated``, each (num_envs); ``info``.
        """
        now = check_open(self, needed_by="A step")
        self._check_action(action)
        # Frameworks act in inference mode, whose tensors could not be differentiated later.
        with torch.inference_mode(False), torch.no_grad():
            action = action.to(self._low).clamp(self._low, self._high)
            flown, self.now = self.torchrl_env.step_and_maybe_reset(now.set("action", action))
        end = cast("Any", flown["next"])
        reward, terminated, truncated = (end[name].squeeze(-1) for name in ("reward", "terminated", "truncated"))
        info = {**_squeezed(end.select(*INFO, strict=False)), "final_obs": end["observation"]}
        return self.now["observation"], reward, terminated, truncated, info

    def close(self) -> None:
        """Close the TorchRL environment."""
        if not self.closed:
            self.torchrl_env.close()
        self.closed = True

    def _check_action(self, action: Any) -> None:
        """Refuse actions that cannot be flown."""
        shape, device, dtype = tuple(self._low.shape), self._low.device, self._low.dtype
        is_dense = isinstance(action, Tensor) and not action.is_nested and action.layout is torch.strided
        if not is_dense or action.dtype not in _FLOATS:
            got = action.dtype if is_dense else type(action).__name__
            raise UserTypeError(
                f"The actions must be a dense tensor of floats of shape {shape}, one row per drone; got {got}. Others "
                f"become one by torch.as_tensor(action, dtype={dtype}, device={str(device)!r})."
            )
        if action.device != device:
            raise UserValueError(
                f"The actions are on {action.device}, and the environment on {device}. Move the policy there."
            )
        check_numbers(action, shape)


def _squeezed(entries: Any) -> dict[str, Any]:
    """Entries (n, 1) as (n), by name."""
    return {name: x.squeeze(-1) if isinstance(x, Tensor) else _squeezed(x) for name, x in entries.items()}
