"""Where rays meet solids: closed forms, fused by the compiler into one loop without intermediate results.

A ray enters a convex solid once and leaves it once. It meets a solid whose entry lies before the exit; a ray that
begins within a solid meets it at once.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.vector import is_traced
from torchrl_quad.engine.program import Compiled
from torchrl_quad.vision.primitives import KINDS, Primitives

CHUNK = 2**16  # pairs of a ray and a solid that an eager flight handles at once: they fit into a cache
TINY = 1e-9  # a ray whose direction has less than this along an axis is parallel to the others
GRAZING = 0.05  # the least cosine between a ray and a normal in derivatives, which would have no bound without it


def cast_rays(
    solids: Primitives,
    position: Tensor,
    attitude: Tensor,
    plane: Tensor,
    far: float,
    differentiable: bool = False,
    *,
    fused: bool = False,
) -> Tensor:
    """How far rays fly until they meet a solid: the depth (n, p) along the camera's x axis [m], at most ``far``.

    Args:
        solids: of n scenes.
        position: of the camera (n, 3) [m], world frame.
        attitude: of the camera (n, 4), a unit quaternion, to the world.
        plane: where the rays pass the plane x = 1 in the frame of the camera (2, p): y to the left, z upwards.
        far: the greatest depth [m].
        differentiable: with the derivative in position and attitude. It is that of the visible surface; a jump, as of
            an edge before another surface, has none. At a grazing ray it is limited.
        fused: compile the rays into one loop, as a compiled step does in any case; it takes seconds the first time.
    """
    solids = Primitives(*(x.detach() for x in solids))
    pose = position.detach().contiguous(), attitude.detach().contiguous()
    obstacles = [x.contiguous() for x in solids._replace(boxes=_with_axes(solids.boxes))]
    cast = _cast if fused or is_traced() else _chunks
    depth, index = cast(*pose, plane.contiguous(), obstacles, far=far, which=differentiable)
    return _attached(solids, position, attitude, plane, depth, index, far) if differentiable else depth


def directions(attitude: Tensor, plane: Tensor) -> tuple[Tensor, ...]:
    """The directions of the rays in the world, three components (n, p)."""
    w, x, y, z = (q.unsqueeze(-1) for q in attitude.unbind(-1))
    u, v = plane
    return (
        (1.0 - 2.0 * (y * y + z * z)) + 2.0 * (x * y - w * z) * u + 2.0 * (x * z + w * y) * v,
        2.0 * (x * y + w * z) + (1.0 - 2.0 * (x * x + z * z)) * u + 2.0 * (y * z - w * x) * v,
        2.0 * (x * z - w * y) + 2.0 * (y * z + w * x) * u + (1.0 - 2.0 * (x * x + y * y)) * v,
    )


def meet(
    position: Tensor, attitude: Tensor, plane: Tensor, *solids: Tensor, far: float, which: bool = False
) -> tuple[Tensor, ...]:
    """The depth of each ray (n, p), and with ``which`` the index of the solid that it meets, in the order of kinds."""
    rays = tuple(d.unsqueeze(1) for d in directions(attitude, plane))  # (n, 1, p)
    depth: list[Tensor] = []
    index, first = None, 0
    for function, x in zip((_meet_spheres, _meet_cylinders, _meet_boxes, _meet_planes), solids, strict=True):
        if x.shape[1]:
            entry, exit = function(x, position, rays)
            entry = entry.clamp_min(0.0)
            met = torch.where((exit > entry) & (entry < far), entry, far)  # NaN, where a ray misses, is not greater
            least = met.amin(1)
            if which:
                mine = met.argmin(1) + first
                index = mine if index is None else torch.where(least < depth[-1], mine, index)
            depth.append(torch.minimum(depth[-1], least) if depth else least)
        first += x.shape[1]
    return (depth[-1],) if index is None else (depth[-1], index)


def _meet_spheres(x: Tensor, position: Tensor, rays: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    ox, oy, oz = _from(x, position)
    dx, dy, dz = rays
    scale = 1.0 / (dx * dx + dy * dy + dz * dz)
    middle = -(ox * dx + oy * dy + oz * dz) * scale
    px, py, pz = ox + middle * dx, oy + middle * dy, oz + middle * dz  # where the ray comes closest to the centre
    half = ((x[..., 3:] * x[..., 3:] - (px * px + py * py + pz * pz)) * scale).sqrt()
    return middle - half, middle + half


def _meet_cylinders(x: Tensor, position: Tensor, rays: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    ox, oy, oz = _from(x, position)
    dx, dy, dz = rays
    scale = 1.0 / (dx * dx + dy * dy).clamp_min(TINY * TINY)
    middle = -(ox * dx + oy * dy) * scale
    across = ox * dy - oy * dx
    half = (x[..., 3:4] * x[..., 3:4] * scale - (across * scale) * (across * scale)).sqrt()
    floor, ceiling = (height * _inverse(dz) for height in (-oz, x[..., 4:] - oz))
    entry = torch.maximum(middle - half, torch.minimum(floor, ceiling))
    return entry, torch.minimum(middle + half, torch.maximum(floor, ceiling))


def _meet_boxes(x: Tensor, position: Tensor, rays: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    offset, entries, exits = _from(x, position), [], []
    for number in range(3):
        axis = x[..., 6 + 3 * number : 9 + 3 * number].unsqueeze(-1).unbind(-2)
        scale = _inverse(_dot(axis, rays))
        middle = -_dot(axis, offset) * scale
        half = x[..., 3 + number : 4 + number] * scale.abs()
        entries.append(middle - half)
        exits.append(middle + half)
    return functools.reduce(torch.maximum, entries), functools.reduce(torch.minimum, exits)


def _meet_planes(x: Tensor, position: Tensor, rays: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    normal = x[..., :3].unsqueeze(-1).unbind(-2)
    height = (x[..., :3] * position.unsqueeze(1)).sum(-1, keepdim=True) - x[..., 3:]
    towards = -_dot(normal, rays)
    entry = height * _inverse(towards)
    # A half-space has no end: rays that fly away from it never enter, those below it are in it already.
    return torch.where(height > 0.0, entry, 0.0), torch.where((towards > 0.0) | (height <= 0.0), torch.inf, -torch.inf)


def _with_axes(boxes: Tensor) -> Tensor:
    """The boxes with their three axes in the world (9) instead of their attitude; the compiler would not share them."""
    axes = torch.eye(3, dtype=boxes.dtype, device=boxes.device)
    axes = quaternion.rotate(boxes[..., None, 6:], axes.expand(*boxes.shape[:2], 3, 3))
    return torch.cat((boxes[..., :6], axes.flatten(2)), -1)


def _from(x: Tensor, position: Tensor) -> tuple[Tensor, ...]:
    """The camera from the point that a solid is given by, three components (n, m, 1)."""
    return tuple((position.unsqueeze(1) - x[..., :3]).unsqueeze(-1).unbind(-2))


def _dot(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _inverse(x: Tensor) -> Tensor:
    """One over x, at most 1e9 in size."""
    return 1.0 / torch.where(x.abs() < TINY, TINY, x)


def _attached(
    solids: Primitives, position: Tensor, attitude: Tensor, plane: Tensor, depth: Tensor, index: Tensor, far: float
) -> Tensor:
    """The same depth, with its derivative in the pose of the camera.

    The point that is met stays on its surface, whose normal is N. So N (o + t d) is constant, and a change of the
    origin o and of the direction d changes the depth t by -N (do + t dd) / (N d).
    """
    rays = torch.stack(directions(attitude, plane), -1)
    with torch.no_grad():
        point, normal, first = position.unsqueeze(1) + depth.unsqueeze(-1) * rays, torch.zeros_like(rays), 0
        for (_, gradient), x in zip(KINDS.values(), solids, strict=True):
            m = x.shape[1]
            if m:
                own = (index - first).clamp(0, m - 1).unsqueeze(-1).expand(-1, -1, x.shape[-1])
                mine = x.expand(len(index), -1, -1).gather(1, own)
                mine = torch.stack(torch.broadcast_tensors(*gradient(mine, point)), -1)
                normal = torch.where((index >= first).unsqueeze(-1), mine, normal)
            first += m
        length = rays.square().sum(-1).sqrt()
        slope = (normal * rays).sum(-1)
        slope = torch.minimum(slope, -GRAZING * length)  # a visible surface faces the camera
        visible = (depth < far) & (depth > 0.0)
    moved = (position - position.detach()).unsqueeze(1) + depth.unsqueeze(-1) * (rays - rays.detach())
    return depth - torch.where(visible, (normal * moved).sum(-1) / slope, 0.0)


# -- how it runs -------------------------------------------------------------------------------------------------------


def _chunks(
    position: Tensor, attitude: Tensor, plane: Tensor, solids: list[Tensor], far: float, which: bool
) -> tuple[Tensor, Tensor]:
    """Eager: some scenes after the others, so that what lies between stays in the cache."""
    most = max(1, *(x.shape[1] for x in solids))
    rays = max(1, CHUNK // most)  # of a scene at once, of which an image may have more
    step = max(1, CHUNK // (most * plane.shape[1]))
    parts = []
    for i in range(0, len(position), step):
        some = slice(i, i + step)
        own = [x if len(x) == 1 else x[some] for x in solids]
        images = [meet(position[some], attitude[some], p, *own, far=far, which=which) for p in plane.split(rays, 1)]
        parts.append([torch.cat(x, 1) for x in zip(*images, strict=True)])
    depth, *index = (torch.cat(x) for x in zip(*parts, strict=True))
    return depth, index[0] if which else depth


class _Kernel:
    """The rays of one kind of scene and camera, compiled into one loop."""

    def __init__(self, far: float, which: bool, kind: object) -> None:
        self.far, self.which = far, which
        # Inductor would store what two expressions share, which costs more than to compute it again.
        keep = dict.fromkeys(("realize_reads_threshold", "realize_acc_reads_threshold"), 10_000)
        keep |= {"realize_opcount_threshold": 10_000, "unroll_reductions_threshold": 1}
        # All inputs of a kernel are of one kind, and the function reads nothing that could change.
        self.call = Compiled(self.cast, {"options": keep}).again

    def cast(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        return meet(*inputs, far=self.far, which=self.which)


_kernel = functools.lru_cache(maxsize=32)(_Kernel)  # the code of one takes some megabytes; few programs need so many


# A function of its own for the compiler, which would tear it apart within a step.
@torch.library.custom_op("torchrl_quad::cast_rays", mutates_args=())
def _cast(
    position: Tensor, attitude: Tensor, plane: Tensor, solids: list[Tensor], far: float, which: bool
) -> tuple[Tensor, Tensor]:
    """The depth, and with ``which`` the solids that the rays meet, else nothing (0)."""
    inputs = [x.contiguous() for x in (position, attitude, plane, *solids)]
    kind = tuple((x.shape, x.dtype, x.device) for x in inputs)
    with torch.no_grad():
        depth, *index = _kernel(far, which, kind).call(*inputs)
    return depth, index[0] if which else depth.new_empty(0, dtype=torch.int64)


@_cast.register_fake
def _(position, attitude, plane, solids, far, which):
    depth = position.new_empty(len(position), plane.shape[1])
    return depth, depth.new_empty(depth.shape if which else 0, dtype=torch.int64)
