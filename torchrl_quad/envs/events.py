"""Events within a control step: when they happen on the way, with exact derivatives, and what a later one changes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.terms import norm

# Derivatives of passes that graze a surface, and of those who stand before it, would have no bound. The way across the
# surface counts as at least this share of the whole way, and as at least so much in the unit of the quantity.
GRAZING, SLOW = 0.3, 1e-4


class Event(NamedTuple):
    """What a task pays in the instant in which a drone crosses a surface, within a control step."""

    happened: Tensor  #: whether it did in this step, bool (n, 1)
    time: Tensor  #: when, as a fraction of the control step, (n, 1) in [0, 1] with its gradient
    amount: Tensor | float  #: what it pays, a number or (n, 1)
    term: str | None = None  #: the reward term that pays it, by default the one of the event's name


def ball_entry(start: Tensor, end: Tensor, centre: Tensor | float, radius: float) -> Tensor:
    """When the straight way between two vectors enters a ball, as a fraction of the way, with its derivative.

    Args:
        start: any quantity at the start of the control step, such as a position or a velocity, (*, k).
        end: the same at its end.
        centre: of the ball, (*, k) or a number.
        radius: of the ball.

    Returns:
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
    """When a number that changes evenly comes down to a level, as a fraction of the way, with its derivative.

    Args:
        start: any quantity at the start of the control step, such as a height, (*).
        end: the same at its end.
        level: to which it comes down.

    Returns:
        (*) in [0, 1]: 0 without a gradient where it begins at the level or below. Where it ends above the number means
        nothing. No derivative is larger than 1e4.
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
    are those of before until it, for x of the step, and those of after it for the rest.

    Args:
        events: what may have happened in the step.
        discount: per control step.
        terms: all terms of the task at the end of the step; those that pay an event are not dense.
        terms_before: the same, had no event changed the task's own entries.
        terminated: whether the episode ends with this step, bool (n, 1): then nothing is paid after the event.
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
    start, end = (x - surface for x in (start, end))
    return (1.0 - time) * (start - start.detach()) + time * (end - end.detach())
