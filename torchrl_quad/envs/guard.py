"""Keep broken environments from reaching the others: bounds for states, and a filter for gradients."""

from __future__ import annotations

import functools
import operator
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import Dynamics, QuadrotorParams
from torchrl_quad.dynamics.parameters import LIMITS, RawParams
from torchrl_quad.dynamics.vector import is_same, is_traced
from torchrl_quad.engine.packing import like, looks_are_free
from torchrl_quad.engine.simulation import State

# Beyond these the model means nothing, and its numbers or their derivatives may overflow.
MAX_VALUE = 1e6  # of any entry of the state, in its unit
MAX_SPEED = 300.0  # [m/s], also of the wind
MAX_ANGULAR_VELOCITY = 100.0  # [rad/s]
MAX_NORM_ERROR = 0.1  # of the quaternion's squared norm


class Guard:
    """Replaces meaningless states: what is not finite, or beyond the bounds of the model.

    The task's own entries stay as they are, unless they are the trouble. Selecting before the physics keeps gradients
    clean: a gradient of zero never meets an infinite derivative.

    Args:
        safe_state: takes over where a state is meaningless; the guard reads names and shapes from it, too.
        dynamics: knows the bounds of its own entries.
        task_entries: the names of the task's own entries.
    """

    def __init__(self, safe_state: State, dynamics: Dynamics, task_entries: list[Any]) -> None:
        self.safe_state, self.task_entries = safe_state, task_entries
        self.bounds = {key: _bounds(key, x, dynamics) for key, x in safe_state.items() if x.is_floating_point()}
        n = max(len(low) for low, _ in self.bounds.values())
        bounds = zip(*self.bounds.values(), strict=True)
        self.low, self.high = (torch.cat([x.expand(n, -1) for x in side], 1) for side in bounds)

    def __call__(self, state: State) -> tuple[State, Tensor]:
        """The state with safe entries where it is meaningless, and bool (n) that says where it was meaningful."""
        with torch.no_grad():
            unit = self._is_unit(state["quaternion"])
            if is_true(unit):  # then the usual case is quick to see: nothing is wrong, and nothing to be replaced
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

    def complaints(self, state: State) -> dict[str, Tensor]:
        """What is wrong with a state, in words, and where it is wrong, bool (n)."""
        found = {}
        for key, inside in self._inside(state).items():
            low, high = (x.min().item() for x in self.bounds[key])
            found[f"{key!r} must be finite and between {low:.4g} and {high:.4g}"] = ~inside.all(1)
        found["'quaternion' must have unit norm"] = ~self._is_unit(state["quaternion"])
        return found

    def _inside(self, state: State) -> dict[Any, Tensor]:
        values = {key: state[key].flatten(1) for key in self.bounds}
        return {key: (values[key] >= low) & (values[key] <= high) for key, (low, high) in self.bounds.items()}

    @staticmethod
    def _is_unit(q: Tensor) -> Tensor:
        return (q.square().sum(1) - 1.0).abs() < MAX_NORM_ERROR


def _bounds(key: Any, x: Tensor, dynamics: Dynamics) -> tuple[Tensor, Tensor]:
    """What the entry must lie between, each (1 or n, k)."""
    if isinstance(key, tuple) and key[0] == "drone":
        low, high = LIMITS[key[1]]
    else:
        speeds = dict.fromkeys(("velocity", "wind", "mean_wind"), MAX_SPEED)
        high = {"angular_velocity": MAX_ANGULAR_VELOCITY, **speeds, **dynamics.limits}.get(key, MAX_VALUE)
        low = -high
    low, high = (torch.as_tensor(bound, dtype=x.dtype, device=x.device).reshape(-1, 1) for bound in (low, high))
    width = x[0].numel()
    return low.expand(-1, width), high.expand(-1, width)


class Containment:
    """Keeps the derivatives of environments that become meaningless within a step away from what all share.

    Their numbers may overflow in the middle of the physics. Zero times infinity is NaN, and would reach the parameters
    of the drone and the policy, and through them every other environment.
    """

    def __init__(self) -> None:
        self.valid: Tensor | None = None  # (n), known at the end of the step

    def enter(self, state: State, action: Tensor, params: QuadrotorParams) -> tuple[State, Tensor, Any]:
        """The same values, whose gradients come back from meaningful environments alone."""
        keys = [key for key, x in state.items() if x.requires_grad]
        if not (keys or action.requires_grad or params.requires_grad):
            return state, action, params
        action, *values = _Contain.apply(self, action, *(state[key] for key in keys))
        state = {**state, **dict(zip(keys, values, strict=True))}
        fields = {name: x for name, x in params.fields().items() if x.requires_grad}
        if fields:
            each = (x if x.dim() > params.dim(name) else x.unsqueeze(0) for name, x in fields.items())
            each = _Contain.apply(self, *(x.expand(len(action), *x.shape[1:]) for x in each))
            params = RawParams(**{**params.fields(), **dict(zip(fields, each, strict=True))})
        return state, action, params


class _Contain(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, containment: Containment, *values: Tensor) -> tuple[Tensor, ...]:
        ctx.containment = containment
        ctx.set_materialize_grads(False)
        return tuple(x.view_as(x) for x in values)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        keep = ctx.containment.valid.unsqueeze(1)
        return None, *(None if g is None else torch.where(like(keep, g), g, 0.0) for g in grads)


def is_true(flags: Tensor) -> bool:
    """Whether all flags are set, where a look at them is free; False where it is not."""
    return looks_are_free(flags.device) and not is_traced() and bool(flags.all())
