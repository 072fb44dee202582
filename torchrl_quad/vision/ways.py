"""Whether a drone finds a way through obstacles."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_quad.vision.primitives import Primitives, distances

CHUNK = 2**20  # so many distances are computed at once


def has_way(
    solids: Primitives, start: Tensor, goal: Tensor, low: Tensor, high: Tensor, radius: float, cell: float = 0.25
) -> bool:
    """Whether a ball can move from start to goal (3) [m] in one scene, within a box from low to high (3) [m].

    It moves on a grid from cell to neighbouring cell. A cell is free where its centre is further from all surfaces than
    the radius; cells are no larger than the ball, so that no wall is too thin to be noticed. A gap that is hardly wider
    than the ball may be missed.
    """
    cell = min(cell, 1.8 * radius)
    counts = ((high - low) / cell).ceil().long().clamp_min(1)
    axes = [low[i] + (torch.arange(int(counts[i])) + 0.5).to(low) * (high[i] - low[i]) / counts[i] for i in range(3)]
    centres = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    first = Primitives(*(x[:1] for x in solids))
    step = max(1, CHUNK // max(first.count, 1))
    free = torch.cat([(distances(first, x.unsqueeze(0))[0] > radius).all(-1) for x in centres.split(step)])
    free = free.reshape(counts.tolist())

    def cell_of(point: Tensor) -> tuple[int, ...]:
        index = ((point - low) / (high - low) * counts).long()
        return tuple(torch.minimum(index.clamp_min(0), counts - 1).tolist())

    reached, goal_cell, count = torch.zeros_like(free), cell_of(goal), 0
    reached[cell_of(start)] = True
    reached &= free
    while count != (count := reached.sum().item()) and not reached[goal_cell]:
        for _ in range(8):  # to neighbours by a face
            for axis, size in enumerate(free.shape):
                lower, upper = reached.narrow(axis, 0, size - 1), reached.narrow(axis, 1, size - 1)
                upper |= lower.clone()
                lower |= upper.clone()
                reached &= free
    return bool(reached[goal_cell])
