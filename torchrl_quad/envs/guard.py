"""Keep broken states and actions from reaching other environments: bounds, a filter for gradients, and checks."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.dynamics import Dynamics, QuadrotorParams
from torchrl_quad.dynamics.parameters import LIMITS, RawParams
from torchrl_quad.dynamics.vector import is_same, is_traced
from torchrl_quad.engine.packing import Key, like, looks_are_free
from torchrl_quad.engine.simulation import State
from torchrl_quad.errors import UserValueError

# Beyond these the model means nothing, and its numbers or their derivatives may overflow.
MAX_VALUE = 1e6  # of any entry of the state, in its unit
MAX_SPEED = 300.0  # [m/s], also of the wind
MAX_ANGULAR_VELOCITY = 100.0  # [rad/s]
MAX_NORM_ERROR = 0.1  # of the quaternion's squared norm
MAX_STEPS = 2**31  # since the start of an episode


class Guard:
    """Replaces meaningless states, not finite or beyond the model, by a safe one, which names and shapes are read from.

    The task's own entries are replaced only where they are out of bounds. Selecting before the physics keeps
    gradients clean: a gradient of zero never meets an infinite derivative.
    """

    def __init__(self, safe_state: State, dynamics: Dynamics, task_entries: list[Key]) -> None:
        self.safe_state, self.task_entries = safe_state, task_entries
        self.bounds = {key: _bounds(key, x, dynamics) for key, x in safe_state.items() if x.is_floating_point()}
        n = max(len(low) for low, _ in self.bounds.values())
        bounds = zip(*self.bounds.values(), strict=True)
        self.low, self.high = (torch.cat([x.expand(n, -1) for x in side], 1) for side in bounds)

    def __call__(self, state: State) -> tuple[State, Tensor]:
        """The state with safe entries where it is meaningless, and bool (n) that says where it was meaningful."""
        with torch.no_grad():
            unit = is_unit(state["quaternion"])
            if is_true(unit):  # the usual case, quick to see: nothing is wrong, and nothing is replaced
                values = torch.cat([state[key].flatten(1) for key in self.bounds], 1)
                if is_same(values.clamp(self.low, self.high), values):  # NaN is not the same
                    return dict(state), unit
            inside = self._inside(state)
            valid = functools.reduce(operator.and_, (x.all(1) for x in inside.values()), unit)
        keep, safe = valid.unsqueeze(1), dict(state)
        for key in self.bounds:
            mine = inside[key].reshape(state[key].shape) if key in self.task_entries else like(keep, state[key])
            safe[key] = torch.where(mine, state[key], self.safe_state[key])
        return safe, valid

    def problems(self, state: State) -> dict[str, Tensor]:
        """What is wrong with a state, in words, and where it is wrong, bool (n)."""
        found = {}
        for key, inside in self._inside(state).items():
            low, high = (x.min().item() for x in self.bounds[key])
            found[f"{key!r} must be finite and between {low:.4g} and {high:.4g}"] = ~inside.all(1)
        return {**found, "'quaternion' must have unit norm": ~is_unit(state["quaternion"])}

    def _inside(self, state: State) -> dict[Key, Tensor]:
        values = {key: state[key].flatten(1) for key in self.bounds}
        return {key: (values[key] >= low) & (values[key] <= high) for key, (low, high) in self.bounds.items()}


def is_unit(q: Tensor) -> Tensor:
    """Whether quaternions (n, 4) are near enough to unit norm to mean an attitude, bool (n)."""
    return (q.square().sum(1) - 1.0).abs() < MAX_NORM_ERROR


def _bounds(key: Key, x: Tensor, dynamics: Dynamics) -> tuple[Tensor, Tensor]:
    """What the entry must lie between, each (1 or n, k)."""
    if isinstance(key, tuple) and key[0] == "drone":
        low, high = LIMITS[key[1]]
    else:
        speeds = dict.fromkeys(("velocity", "wind", "mean_wind"), MAX_SPEED)
        high = {"angular_velocity": MAX_ANGULAR_VELOCITY, **speeds, **dynamics.limits}.get(str(key), MAX_VALUE)
        low = -high
    low, high = (torch.as_tensor(bound, dtype=x.dtype, device=x.device).reshape(-1, 1) for bound in (low, high))
    width = x[0].numel()
    return low.expand(-1, width), high.expand(-1, width)


class Containment:
    """Keeps the derivatives of environments that become meaningless within a step away from what all share.

    Their numbers may overflow in the middle of the physics. Zero times infinity is NaN, and would reach the parameters
    of the drone and the policy, and through them every other environment.
    """

    valid: Tensor  #: where the step made sense, bool (n); known at its end

    def enter(
        self, state: State, action: Tensor, params: QuadrotorParams
    ) -> tuple[State, Tensor, QuadrotorParams | RawParams]:
        """The same values, whose gradients come back only from meaningful environments."""
        state = {key: self._contained(x) for key, x in state.items()}
        fields = {name: x for name, x in params.fields().items() if x.requires_grad}
        for name, x in fields.items():
            each = x if x.dim() > params.dim(name) else x.unsqueeze(0)
            fields[name] = self._contained(each.expand(len(action), *each.shape[1:]))
        flown = RawParams(**{**params.fields(), **fields}) if fields else params
        return state, self._contained(action), flown

    def _contained(self, x: Tensor) -> Tensor:
        if not x.requires_grad:
            return x
        x = x.view_as(x)
        x.register_hook(self._kept)
        return x

    def _kept(self, grad: Tensor | None) -> Tensor | None:
        return None if grad is None else torch.where(like(self.valid.unsqueeze(1), grad), grad, 0.0)


def is_true(flags: Tensor) -> bool:
    """Whether all flags are set, where reading them needs no device synchronisation; False elsewhere."""
    return not is_traced() and looks_are_free(flags.device) and bool(flags.all())


def read_state(state: Any, safe_state: State, source: str, convert: bool = False) -> State:
    """The entries of a state (a tensordict), if all are there with the right shape, precision and device.

    With ``convert`` the kind of their numbers must be right, and they become copies of the right precision and device.
    """
    if not isinstance(state, TensorDictBase):
        got = type(state).__name__
        raise UserValueError(f'{source}: a state is a tensordict, such as env.reset()["state"]; got {got}.')
    given: Any = dict(state.items())  # reading all names at once is quicker than one by one
    entries: dict[Any, Any] = {
        key: state.get(key, None) if isinstance(key, tuple) else given.get(key) for key in safe_state
    }
    for key, x in entries.items():
        expected = safe_state[key]
        fits = x is not None and x.shape == expected.shape
        if convert and fits and kind_of(x) == kind_of(expected):
            entries[key] = x.to(expected, copy=True)
        elif convert or not fits or x.dtype != expected.dtype or x.device != expected.device:
            raise entry_error(entries, key, safe_state, source)
    return entries


def check_action(action: Tensor | None, example: Tensor, size: int) -> None:
    """Check that an action is (n, size), of the precision and on the device of an example (n, ...)."""
    n, dtype = len(example), example.dtype
    if action is None or action.shape != (n, size):
        got = "there is none" if action is None else f"got {tuple(action.shape)}"
        raise UserValueError(
            f"The action must have shape ({n}, {size}), named in env.action_units, for each environment; {got}. A "
            'policy writes it under "action", as make_actor(env) does.'
        )
    if action.device != example.device:
        raise UserValueError(f"The action is on {action.device}, and the environment on {example.device}.")
    if action.dtype != dtype:
        raise UserValueError(
            f"The action is {action.dtype}, and the environment flies in {dtype}. Convert the policy, "
            f"policy.to({dtype}), or build the environment with dtype={action.dtype}."
        )


def check_finite(action: Tensor) -> None:
    """Check that actions (n, k), or (n, time, k) of a horizon, are finite."""
    if is_traced() or (finite := action.isfinite().all(-1)).all():
        return
    broken = ~finite if action.dim() == 3 else ~finite.unsqueeze(1)
    at = f", first at step {broken.any(0).nonzero()[0].item()} of the rollout" if action.dim() == 3 else ""
    raise UserValueError(
        f"The action is not finite in environments {first_ten(broken.any(1))}{at}: the weights of the policy are "
        "broken, or what it reads is. Look for NaN in both; if training made them, clip the norm of the gradient, and "
        "skip updates whose gradient is not finite."
    )


def first_ten(flags: Tensor) -> str:
    """The indices of the first flags (n) that are set, for a message."""
    who = flags.nonzero().flatten().tolist()
    return ", ".join(map(str, who[:10])) + (", ..." if len(who) > 10 else "")


def kind_of(x: Tensor) -> str:
    """What the numbers of a tensor are, for a message."""
    if x.dtype == torch.bool:
        return "bool"
    return "floating point" if x.is_floating_point() else "complex" if x.is_complex() else "whole numbers"


def entry_error(entries: Mapping[Key, Any], key: Key, safe_state: State, source: str) -> UserValueError:
    """What is wrong with an entry of a state, or what the state lacks."""
    missing = [str(key) for key, x in entries.items() if x is None]
    if missing:
        return UserValueError(
            f"{source}: the state lacks {', '.join(missing)}. A state is restored whole: take it from a tensordict of "
            f"this environment, which holds {', '.join(map(str, safe_state))}. No transform may drop a part of it, as "
            "ExcludeTransform would."
        )
    x, expected = entries[key], safe_state[key]
    said = f"{source}: state {key!r}"
    if x.shape != expected.shape:
        return UserValueError(f"{said} has shape {tuple(x.shape)}, expected {tuple(expected.shape)}.")
    if kind_of(x) != kind_of(expected):
        return UserValueError(f"{said} must be {kind_of(expected)}, got {x.dtype}.")
    return UserValueError(
        f"{said} is {x.dtype} on {x.device}, and this environment {expected.dtype} on {expected.device}. Convert it: "
        "env.reset(tensordict, set_state=True) does."
    )
