"""A collector of TorchRL whose batches keep their graph."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_quad.data.rollout import differentiable_rollout, require_actor, require_exploration
from torchrl_quad.data.unwrap import base_env, check_env
from torchrl_quad.data.visited_states import restart
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.options import Field, Fraction, checked


@checked
class DifferentiableCollector(BaseCollector):
    """Horizons with their graph, for ``torchrl.trainers.Trainer`` and for loops written around collectors.

    Each batch is what :func:`differentiable_rollout` returns, (*env.batch_size, horizon), and begins where the one
    before it has ended, or afresh. TorchRL's own collectors cut the graph. Take one step of the optimizer for each
    batch (``optim_steps_per_batch=1``): ``backward`` frees its graph.

    The policy is not copied: a step of the optimizer shows in the next batch.

    Args:
        env: any differentiable environment, also under transforms; or a function that builds it.
        policy: a TensorDictModule that writes the action.
        frames_per_batch: control steps of all environments together in a batch, a multiple of their number.
        total_frames: control steps of all environments together with which the iteration ends; -1 for never. The batch
            that reaches them is the last.
        restart_fraction: the share of flights that each batch gives up for a fresh start; see :func:`restart`.
        exploration_type: RANDOM samples the policy, DETERMINISTIC takes its mode.

    Raises:
        ValueError: an option has the wrong type or is out of its range.
        TypeError: ``env`` or ``policy`` is none.

    Attributes:
        carry: the tensordict from which the next batch starts; None resets the environment. It may be set, such as to
            ``buffer.initial_state(env, 0.9)`` of a :class:`VisitedStateBuffer`.
    """

    init_random_frames = 0
    trajs_per_batch = None

    def __init__(
        self,
        env: EnvBase | Callable[[], EnvBase],
        policy: TensorDictModuleBase,
        *,
        frames_per_batch: Annotated[int, Field(ge=1, le=10**12)],
        total_frames: Annotated[int, Field(ge=-1, le=10**15)] = -1,
        restart_fraction: Fraction = 0.0,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
    ) -> None:
        super().__init__()
        self.env: EnvBase = env if isinstance(env, EnvBase) or not _needs_nothing(env) else env()
        check_env(self.env)
        require_actor(policy, "policy")
        require_exploration(exploration_type)
        self.policy, self.exploration_type, self.restart_fraction = policy, exploration_type, restart_fraction
        self.horizon, rest = divmod(frames_per_batch, self.env.numel())
        if rest or self.horizon < 1:
            nearest = max(self.horizon, 1) * self.env.numel()
            raise UserValueError(
                f"frames_per_batch={frames_per_batch} must be a multiple of the number of environments, "
                f"{self.env.numel()}. Try {nearest}, a horizon of {nearest // self.env.numel()} control steps."
            )
        self.frames_per_batch = self.requested_frames_per_batch = frames_per_batch
        self.total_frames: float = float("inf") if total_frames < 0 else total_frames
        self.carry: TensorDictBase | None = None
        self._frames = 0

    def iterator(self) -> Iterator[TensorDictBase]:
        """Fly one batch after the other."""
        while self._frames < self.total_frames:
            start = self.carry
            if start is not None and self.restart_fraction and self._frames:
                start = restart(self.env, start, self.restart_fraction)
            options = {"exploration_type": self.exploration_type}
            batch, self.carry = differentiable_rollout(self.env, self.policy, start, self.horizon, **options)
            self._frames += batch.numel()
            yield batch

    def __len__(self) -> int:
        if self.total_frames == float("inf"):
            raise UserTypeError("A collector without total_frames goes on for ever, and has no length.")
        return -(self.total_frames // -self.frames_per_batch)

    def update_policy_weights_(
        self,
        policy_or_weights: TensorDictBase | nn.Module | Mapping[str, Any] | None = None,
        *,
        weights: TensorDictBase | Mapping[str, Any] | None = None,
        policy: nn.Module | None = None,
        weights_dict: Mapping[str, Any] | None = None,
        **_: Any,
    ) -> None:
        """Copy weights into the policy: those of a module, or a tensordict of them; without any it is up to date."""
        several = (policy_or_weights, weights, policy, (weights_dict or {}).get("policy"))
        given = next((x for x in several if x is not None), None)
        if given is not None and given is not self.policy:
            is_module = isinstance(given, nn.Module)
            given = TensorDict.from_module(given) if is_module else TensorDict(given).unflatten_keys(".")
            TensorDict.from_module(self.policy).data.update_(given.data)

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the environment; the next batch begins with a reset. Returns the seed for another environment."""
        self.carry = None
        return self.env.set_seed(seed, static_seed=static_seed)

    def state_dict(self) -> dict[str, Any]:
        """All that the collector needs to go on exactly, but torch's own random numbers, which the policy draws."""
        random = getattr(base_env(self.env), "random_state", dict)
        return {
            "frames": self._frames,
            "carry": None if self.carry is None else self.carry.to_dict(),
            "policy": self.policy.state_dict(),
            "env": self.env.state_dict(),
            "random": random(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], **_: Any) -> None:
        """Go on from what :meth:`state_dict` returned."""
        self._frames = state_dict["frames"]
        carry = state_dict["carry"]
        self.carry = None if carry is None else TensorDict(carry, self.env.batch_size, device=self.env.device)
        self.policy.load_state_dict(state_dict["policy"])
        self.env.load_state_dict(state_dict["env"])
        if state_dict["random"]:
            base_env(self.env).set_random_state(state_dict["random"])

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        """Close the environment."""
        if close_env and not self.env.is_closed:
            self.env.close(raise_if_closed=raise_on_error)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(env={self.env}, horizon={self.horizon}, total_frames={self.total_frames})"


def _needs_nothing(function: Any) -> bool:
    """Whether something that is no network can be called without arguments."""
    if isinstance(function, nn.Module):
        return False
    try:
        inspect.signature(function).bind()
    except (TypeError, ValueError):
        return False
    return True
