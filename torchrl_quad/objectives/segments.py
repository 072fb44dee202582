"""The segments of a horizon, between the ends of its episodes."""

from __future__ import annotations

import torch
from torch import Tensor


def segments(done: Tensor) -> tuple[Tensor, Tensor]:
    """Mark the first and the last step of each segment, both bool (*, horizon, 1), as ``done`` is.

    The last step of the horizon is the last one of a segment, too.
    """
    end = done.clone()
    end[..., -1, :] = True
    return end.roll(1, -2), end


def step_in_segment(done: Tensor) -> Tensor:
    """The steps of each segment, counted from 0: (*, horizon, 1), as ``done``."""
    start, _ = segments(done)
    index = torch.arange(done.shape[-2], device=done.device).unsqueeze(-1).expand(done.shape)
    return index - torch.where(start, index, 0).cummax(-2).values


def discounts(done: Tensor, gamma: Tensor) -> Tensor:
    """gamma^t, where t counts the steps of each segment from 0: (*, horizon, 1), as ``done``; gamma is a scalar."""
    return gamma ** step_in_segment(done)
