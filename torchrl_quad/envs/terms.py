"""Parts of a task: observations, reward terms, boxes, and events within a control step with exact derivatives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.linalg import vector_norm

from torchrl_quad.dynamics import quaternion
from torchrl_quad.engine.simulation import State

# Of the reward of hovering, tracking and racing (paper, table I); distances in m, speeds in m/s and rad/s.
TARGET_WEIGHTS = {"survival": 0.1, "position": 0.1 / 9, "attitude": 1e-5, "velocity": 0.002, "angular_velocity": 0.002}
# Magnitudes of body_observation() that no useful flight exceeds: the quaternion's are exact.
BODY_BOUNDS = (*4 * (10.0,), *3 * (50.0,), *3 * (50.0,))  # velocity in m/s, angular velocity in rad/s
# Derivatives of passes that graze a surface, and of those who stand before it, would have no bound. The way across the
# surface counts as at least this share of the whole way, and as at least so much in the unit of the quantity.
GRAZING, SLOW = 0.3, 1e-4


def norm(x: Tensor) -> Tensor:
    """Length of vectors (*, k), as (*, 1); its derivative at zero is zero."""
    return vector_norm(x, dim=-1, keepdim=True)


def shortened(x: Tensor, longest: float) -> Tensor:
    """Vectors (*, k), those that are longer shortened to this length: the velocity of who hurries to x, and stops."""
    return x * (longest / norm(x).clamp_min(longest))


def distance(state: Mapping[str, Tensor]) -> Tensor:
    """Distance to the target, (*, 1) [m]."""
    return norm(state["position"] - state["target"])


def body_observation(state: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Ten times the quaternion, velocity [m/s] in the world frame, angular velocity [rad/s] in the body frame.

    The paper observes a tenth of all this, and of positions, which networks learn from slowly. Times ten, a tilt of
    0.1 rad, a velocity of 0.5 m/s and a distance of 0.5 m weigh alike.
    """
    return 10 * state["quaternion"], state["velocity"], state["angular_velocity"]


def axes_observation(state: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`body_observation`, with ten times the body's x and z axes in the world, (*, 6), for the quaternion.

    For tasks that turn the drone about: after a full turn a quaternion has the other sign, and the axes are the same.
    """
    q = state["quaternion"]
    ahead, _, up = (quaternion.rotate(q, x.expand_as(q[..., 1:])) for x in torch.eye(3, device=q.device, dtype=q.dtype))
    return 10 * torch.cat((ahead, up), -1), state["velocity"], state["angular_velocity"]


def target_reward(state: Mapping[str, Tensor], weights: Mapping[str, float]) -> dict[str, Tensor]:
    """The terms of "be at the target, level and still", each (*, 1): ``survival``, and four penalties."""
    level = quaternion.identity(state["quaternion"])
    return {
        "survival": torch.full_like(state["position"][..., :1], weights["survival"]),
        "position": -weights["position"] * distance(state),
        "attitude": -weights["attitude"] * quaternion.distance(state["quaternion"], level),
        "velocity": -weights["velocity"] * norm(state["velocity"]),
        "angular_velocity": -weights["angular_velocity"] * norm(state["angular_velocity"]),
    }


def penalties(weights: Mapping[str, float], **errors: Tensor) -> dict[str, Tensor]:
    """The terms of "make these errors (*, k) small", each (*, 1): ``survival``, and minus the length of each error."""
    survival = torch.full_like(next(iter(errors.values()))[..., :1], weights["survival"])
    return {"survival": survival, **{name: -weights[name] * norm(x) for name, x in errors.items()}}


def outside(position: Tensor, centre: Tensor, half_width: Tensor | float, height: float, floor: float = 0.0) -> Tensor:
    """Whether a position (*, 3) [m] has left the box, (*, 1).

    The box reaches half_width (a number, or one for x and one for y) [m] to all sides of the centre (*, 3), and from
    the floor, the ground at 0, up to the height [m].
    """
    sideways = ((position - centre)[..., :2].abs() > half_width).any(-1, keepdim=True)
    z = position[..., 2:]
    return sideways | (z <= floor) | (z >= height)


class Event(NamedTuple):
    """What a task pays in the instant in which a drone crosses a surface, within a control step."""

    happened: Tensor  #: whether it did in this step, bool (n, 1)
    time: Tensor  #: when, as a fraction of the control step, (n, 1) in [0, 1] with its gradient
    amount: Tensor | float  #: what it pays, a number or (n, 1)
    term: str | None = None  #: the reward term that pays it, by default the one of the event's name


def ball_entry(start: Tensor, end: Tensor, centre: Tensor | float, radius: float) -> Tensor:
    """When the straight way from ``start`` to ``end`` (*, k) of a control step enters a ball, with its derivative.

    Of any quantity, such as a position or a velocity; the centre is (*, k) or a number. Returns a fraction of the way,
    (*, 1) in [0, 1]: 0 without a gradient where the way begins inside. Where it misses the ball the number means
    nothing. No derivative in ``start`` or ``end`` is larger than one over the larger of 0.3 times the way's length
    and 1e-4.
    """
    first, way = (start - centre).detach(), (end - start).detach()
    outside = first.square().sum(-1, keepdim=True) - radius**2
    inwards = -(first * way).sum(-1, keepdim=True)
    root = (inwards.square() - way.square().sum(-1, keepdim=True) * outside).clamp_min(0.0).sqrt()
    time = (outside / (inwards + root).clamp_min(1e-12)).clamp(0.0, 1.0)  # this form divides by no length of the way
    normal = first + time * way
    normal = normal / norm(normal).clamp_min(1e-12)
    speed = torch.maximum(-(normal * way).sum(-1, keepdim=True), GRAZING * norm(way)).clamp_min(SLOW)
    late = (normal * _moved(start, end, centre, time)).sum(-1, keepdim=True) / speed
    return time + torch.where(outside > 0.0, late, 0.0)


def level_crossing(start: Tensor, end: Tensor, level: float) -> Tensor:
    """When a number (*) that changes evenly in a control step comes down to a level, as :func:`ball_entry` gives it.

    It is 0 without a gradient where it begins at the level or below. No derivative is larger than 1e4.
    """
    above, drop = start.detach() - level, (start - end).detach()
    time = (above / drop.clamp_min(1e-12)).clamp(0.0, 1.0)
    late = _moved(start, end, level, time) / drop.clamp_min(SLOW)
    return time + torch.where(above > 0.0, late, 0.0)


def time_terms(
    events: Mapping[str, Event], discount: float, terms: State, terms_before: State, terminated: Tensor
) -> State:
    """Reward terms (n, 1) named ``<event>_time``, whose values are zero and whose gradients those in the events' times.

    An event at the fraction x of control step t adds ``amount * discount ** (t + x)`` to the return. The dense terms
    are those of before until it, for x of the step, and those of after it for the rest: ``terms`` are all terms at the
    end of the step, ``terms_before`` the same, had no event changed the task's own entries. Nothing is paid after an
    event that ends the episode, where ``terminated`` is true, bool (n, 1).
    """
    at_once = {event.term or name for name, event in events.items()}
    dense = [name for name in terms if name not in at_once]
    zero = torch.zeros_like(next(iter(terms.values())))
    before = sum((terms_before[name] for name in dense), zero)
    after = torch.where(terminated, 0.0, sum((terms[name] for name in dense), zero))
    found = {}
    for name, event in events.items():
        time = event.time.detach()
        slope = math.log(discount) * discount**time * event.amount + before - after
        found[f"{name}_time"] = torch.where(event.happened, slope.detach() * (event.time - time), 0.0)
    return found


def _moved(start: Tensor, end: Tensor, surface: Tensor | float, time: Tensor) -> Tensor:
    """How the point on the way at a fixed time moves from the surface: the value is zero, and the gradient is not."""
    start, end = start - surface, end - surface
    return (1.0 - time) * (start - start.detach()) + time * (end - end.detach())
