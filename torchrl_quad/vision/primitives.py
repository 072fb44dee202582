"""Solids that obstacles are made of, and the signed distance to them: pure functions on plain tensors.

A distance is positive outside of a solid, zero on its surface and negative within. Its derivatives are finite
everywhere: where the nearest point is not unique they are those of one choice, or zero.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion

SAMPLES = 8  # intervals into which the way of a step is divided, and once more around the nearest of their ends


class Primitives(NamedTuple):
    """The solids of n scenes; [m], world frame. Each scene has as many of a kind as the others, or all share one."""

    spheres: Tensor  #: centre (3) and radius, (n or 1, m, 4)
    cylinders: Tensor  #: upright; centre of the base (3), radius and height, (n or 1, m, 5)
    boxes: Tensor  #: centre (3), half of the edges (3), attitude as a unit quaternion (4) to world, (n or 1, m, 10)
    planes: Tensor  #: unit normal (3) into free space, and its product with a point of the plane, (n or 1, m, 4)

    @property
    def total(self) -> int:
        """How many solids each scene has."""
        return sum(x.shape[1] for x in self)


#: The numbers that describe one solid, by kind.
SIZES = {"spheres": 4, "cylinders": 5, "boxes": 10, "planes": 4}


def join(*parts: Primitives) -> Primitives:
    """The solids of several scenes in one."""

    def joined(kind: tuple[Tensor, ...]) -> Tensor:
        some = [x for x in kind if x.shape[1]] or [kind[0]]
        n = max(x.shape[0] for x in kind)  # len would be a constant of what is traced
        return some[0] if len(some) == 1 else torch.cat([x.expand(n, *x.shape[1:]) for x in some], 1)

    return Primitives(*(joined(kind) for kind in zip(*parts, strict=True)))


def distances(solids: Primitives, points: Tensor) -> Tensor:
    """Signed distances (n, k, m) [m] from points (n, k, 3) to all m solids of their scenes, in the order of kinds."""
    kinds = zip(KINDS.values(), solids, strict=True)
    parts = [distance(x.unsqueeze(1), points.unsqueeze(2)) for (distance, _), x in kinds if x.shape[1]]
    return torch.cat(parts, -1)


def nearest(solids: Primitives, position: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance (*, 1) [m] from positions (n, 3), or (n, k, 3), to the nearest surface, and the direction (*, 3)
    away from it.

    The direction is the gradient of the distance. Both are differentiable in the position.
    """
    found, away = [], []
    for (distance, normal), x in zip(KINDS.values(), solids, strict=True):
        if x.shape[1]:
            own, point = x if position.dim() == 2 else x.unsqueeze(1), position.unsqueeze(-2)
            found.append(distance(own, point))
            away.append(torch.stack(torch.broadcast_tensors(*normal(own, point), found[-1])[:3], -1))
    found, away = torch.cat(found, -1), torch.cat(away, -2)
    index = found.argmin(-1, keepdim=True)
    of = index.unsqueeze(-1).expand(*(-1 for _ in index.shape), 3)
    return found.gather(-1, index), away.gather(-2, of).squeeze(-2)


def closest_approach(solids: Primitives, start: Tensor, end: Tensor) -> Tensor:
    """The least signed distance (n, 1) [m] on the straight way between two positions (n, 3), without gradient.

    The distance to a convex solid is a convex function of the way. It is sampled twice, the second time between the
    neighbours of the least value. For a way of length L that passes a surface at a distance d, what is found is at most
    (L / 64)^2 / d too large, and never more than L / 64: at 10 m/s, with steps of 0.02 s and d = 0.1 m, 0.1 mm.
    """
    with torch.no_grad():
        share = torch.arange(SAMPLES + 1, device=start.device, dtype=start.dtype) / SAMPLES
        way = (end - start).unsqueeze(1)
        coarse = distances(solids, start.unsqueeze(1) + share[:, None] * way)  # (n, samples, m)
        best = coarse.argmin(1, keepdim=True).to(start.dtype) / SAMPLES
        around = (2.0 * share - 1.0).reshape(-1, 1) / SAMPLES
        time = (best + around).clamp(0.0, 1.0).unsqueeze(-1)  # (n, samples, m, 1)
        points = start[:, None, None] + time * way.unsqueeze(2)
        parts, first = [], 0
        for (distance, _), x in zip(KINDS.values(), solids, strict=True):
            if x.shape[1]:
                parts.append(distance(x.unsqueeze(1), points[:, :, first : first + x.shape[1]]).flatten(1).amin(1))
            first += x.shape[1]
        return torch.stack(parts, 1).amin(1, keepdim=True)


# -- each kind: its distance (*), and the gradient of that, three components (*), from solids (*, k) and points (*, 3) -


def _sphere(x: Tensor, point: Tensor) -> Tensor:
    return _length(*(point - x[..., :3]).unbind(-1)) - x[..., 3]


def _sphere_normal(x: Tensor, point: Tensor) -> tuple[Tensor, ...]:
    return _unit(*(point - x[..., :3]).unbind(-1))


def _cylinder(x: Tensor, point: Tensor) -> Tensor:
    _, _, beside, above, _ = _cylinder_parts(x, point)
    return _from_faces(beside, above)


def _cylinder_normal(x: Tensor, point: Tensor) -> tuple[Tensor, ...]:
    dx, dy, beside, above, up = _cylinder_parts(x, point)
    side, top = _outwards(beside, above)
    nx, ny = _unit(dx, dy)
    return side * nx, side * ny, top * up


def _cylinder_parts(x: Tensor, point: Tensor) -> tuple[Tensor, ...]:
    dx, dy, dz = (point - x[..., :3]).unbind(-1)
    half = 0.5 * x[..., 4]
    z = dz - half
    return dx, dy, _length(dx, dy) - x[..., 3], z.abs() - half, _sign(z)


def _box(x: Tensor, point: Tensor) -> Tensor:
    return _from_faces(*_box_parts(x, point)[1])


def _box_normal(x: Tensor, point: Tensor) -> tuple[Tensor, ...]:
    local, beyond = _box_parts(x, point)
    outward = [weight * _sign(p) for weight, p in zip(_outwards(*beyond), local, strict=True)]
    return quaternion.rotate(x[..., 6:], torch.stack(outward, -1)).unbind(-1)


def _box_parts(x: Tensor, point: Tensor) -> tuple[tuple[Tensor, ...], list[Tensor]]:
    local = quaternion.rotate_inverse(x[..., 6:], point - x[..., :3]).unbind(-1)
    return local, [p.abs() - half for p, half in zip(local, x[..., 3:6].unbind(-1), strict=True)]


def _plane(x: Tensor, point: Tensor) -> Tensor:
    return (point * x[..., :3]).sum(-1) - x[..., 3]


def _plane_normal(x: Tensor, point: Tensor) -> tuple[Tensor, ...]:
    return x[..., :3].unbind(-1)


def _length(*parts: Tensor) -> Tensor:
    """The length of vectors, given by components; its derivative at zero is zero."""
    squares = [p * p for p in parts]
    return functools.reduce(operator.add, squares).clamp_min(1e-16).sqrt()


def _unit(*parts: Tensor) -> tuple[Tensor, ...]:
    length = _length(*parts)
    return tuple(p / length for p in parts)


def _from_faces(*beyond: Tensor) -> Tensor:
    """The signed distance from a solid, from how far a point lies beyond each of its faces."""
    return _length(*(q.clamp_min(0.0) for q in beyond)) + functools.reduce(torch.maximum, beyond).clamp_max(0.0)


def _sign(x: Tensor) -> Tensor:
    return torch.where(x < 0.0, -1.0, 1.0).to(x)


def _outwards(*beyond: Tensor) -> tuple[Tensor, ...]:
    """How much each of the directions has in the shortest way out, from how far the point lies beyond each face."""
    outside = [q.clamp_min(0.0) for q in beyond]
    length = _length(*outside)
    deepest = functools.reduce(torch.maximum, beyond)
    is_out, taken, weights = deepest > 1e-7, torch.zeros_like(deepest, dtype=torch.bool), []
    for q, out in zip(beyond, outside, strict=True):
        mine = (q == deepest) & ~taken  # the first, where several are deepest
        taken = taken | mine
        weights.append(torch.where(is_out, out / length, mine.to(q)))
    return tuple(weights)


#: The distance to each kind of solid, and its gradient.
KINDS: dict[str, tuple[Callable[..., Tensor], Callable[..., tuple[Tensor, ...]]]] = {
    "spheres": (_sphere, _sphere_normal),
    "cylinders": (_cylinder, _cylinder_normal),
    "boxes": (_box, _box_normal),
    "planes": (_plane, _plane_normal),
}
