"""Objects that pictures show beside the drones: lines and surfaces of triangles."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_quad.errors import UserValueError

_RING = 33  # points of a circle, the first again at its end


@dataclass(frozen=True)
class Shape:
    """An object that does not move: an obstacle, a wall, a path. Figures, films and replays draw it.

    The class methods make the usual ones. ``Shape(points, faces)`` takes any mesh, such as
    ``Shape(mesh.vertices, mesh.faces)`` of trimesh.

    Raises:
        ValueError: points, faces or colour are not as below.
    """

    points: Tensor  #: (n, 3) [m], world frame; a line has a gap where a point is NaN
    faces: Tensor | None = None  #: the corners of triangles, as indices of points (m, 3); None for a line
    name: str = ""  #: for the legend
    color: str = "#6b7a90"  #: as "#rrggbb"
    opacity: float = 0.35  #: of a surface, above 0, at most 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", as_points("Shape: points", self.points))
        if self.faces is not None:
            faces = torch.as_tensor(self.faces).detach().cpu().long()
            if faces.dim() != 2 or faces.shape[1] != 3 or not ((faces >= 0) & (faces < len(self.points))).all():
                raise UserValueError(
                    f"Shape: faces must be indices (m, 3) of its {len(self.points)} points, three for each triangle; "
                    f"got shape {tuple(faces.shape)}."
                )
            object.__setattr__(self, "faces", faces)
        if not re.fullmatch("#[0-9a-fA-F]{6}", self.color):
            raise UserValueError(f"Shape: color must be written as #rrggbb, such as #c8452f; got {self.color!r}.")
        if not 0 < self.opacity <= 1:
            raise UserValueError(f"Shape: opacity must be above 0 and at most 1, got {self.opacity}.")

    @classmethod
    def line(cls, points: Any, **style: Any) -> Shape:
        """A line through points (n, 3) [m]."""
        return cls(points, **style)

    @classmethod
    def ring(cls, centre: Any, radius: float, axis: Any = (1.0, 0.0, 0.0), **style: Any) -> Shape:
        """A circle around an axis (3), such as a gate."""
        return cls(rings(*(torch.as_tensor(x).float().reshape(1, 3) for x in (centre, axis)), radius)[0], **style)

    @classmethod
    def box(cls, low: Any, high: Any, **style: Any) -> Shape:
        """A box along the axes, from its lowest corner (3) to its highest (3) [m]."""
        low, high = as_points("Shape.box: low and high", [low, high])
        bits = torch.arange(8)[:, None] >> torch.tensor([2, 1, 0]) & 1
        sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return cls(low + bits * (high - low), [x for a, b, c, d in sides for x in ((a, b, c), (a, c, d))], **style)

    @classmethod
    def sphere(cls, centre: Any, radius: float, **style: Any) -> Shape:
        """A ball."""
        angle = torch.linspace(-0.5 * math.pi, 0.5 * math.pi, 13)
        return cls._turned(centre, radius * angle.cos(), radius * angle.sin(), style)

    @classmethod
    def cylinder(cls, base: Any, radius: float, height: float, **style: Any) -> Shape:
        """An upright cylinder on the centre (3) of its base, such as a tree or a pillar."""
        return cls._turned(base, radius * torch.tensor([0.0, 1, 1, 0]), height * torch.tensor([0.0, 0, 1, 1]), style)

    @classmethod
    def _turned(cls, centre: Any, radii: Tensor, heights: Tensor, style: dict[str, Any], around: int = 24) -> Shape:
        """The surface that a line (k) of radii and heights sweeps around an upright axis."""
        angle = torch.arange(around) * (2 * math.pi / around)
        x, y = (radii[:, None] * turn for turn in (angle.cos(), angle.sin()))
        points = torch.stack((x, y, heights[:, None].expand_as(x)), -1).reshape(-1, 3)
        row, column = torch.meshgrid(torch.arange(len(radii) - 1), torch.arange(around), indexing="ij")
        a, b = (around * row + turned for turned in (column, (column + 1) % around))
        faces = torch.stack((a, b, b + around, a, b + around, a + around), -1).reshape(-1, 3)
        return cls(as_points("Shape: the centre", [centre]) + points, faces, **style)


def as_points(what: str, points: Any) -> Tensor:
    """Points (n, 3) as pictures take them: on the CPU, in single precision, without gradient.

    Raises:
        ValueError: they are something else.
    """
    try:
        if isinstance(points, list | tuple):
            points = torch.stack([torch.as_tensor(point).detach().cpu().float() for point in points])
        points = torch.as_tensor(points).detach().cpu().float()
    except (TypeError, ValueError, RuntimeError):
        raise UserValueError(f"{what} must be points (n, 3) [m], got {points!r}.") from None
    if points.dim() != 2 or points.shape[1] != 3 or not len(points):
        raise UserValueError(f"{what} must be points (n, 3) [m], got shape {tuple(points.shape)}.")
    return points


def along_the_course(gates: Tensor) -> Tensor:
    """The direction (k, 3) in which a course through gates (k, 3), flown round after round, passes each of them."""
    ahead, behind = (normalize(gates.roll(-k, 0) - gates, dim=-1) for k in (1, -1))
    along = ahead - behind
    return torch.where(along.norm(dim=-1, keepdim=True) > 1e-3, along, ahead)  # the course turns back


def rings(centres: Tensor, axes: Tensor, radius: float | Tensor) -> Tensor:
    """Circles (k, 33, 3) around centres (k, 3) and axes (k, 3); radius: one, or one each (k)."""
    none = axes.norm(dim=-1, keepdim=True) < 1e-6
    axes = torch.where(none, torch.tensor([1.0, 0.0, 0.0]), axes)
    side = torch.linalg.cross(axes, torch.tensor([0.0, 0.0, 1.0]).expand_as(axes))
    side = torch.where(
        side.norm(dim=-1, keepdim=True) > 1e-3, side, torch.tensor([0.0, 1.0, 0.0])
    )  # the axis is upright
    side = normalize(side, dim=-1)
    upright = normalize(torch.linalg.cross(side, axes), dim=-1)
    angle = torch.linspace(0, 2 * math.pi, _RING)[:, None]
    turns = angle.cos() * side[:, None] + angle.sin() * upright[:, None]
    return centres[:, None] + torch.as_tensor(radius).reshape(-1, 1, 1) * turns
