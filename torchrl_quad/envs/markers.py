"""What pictures show in addition to the drones: targets, gates, curves, and shapes of lines and triangles."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_quad.dynamics import quaternion
from torchrl_quad.engine.packing import like
from torchrl_quad.engine.simulation import State
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import Real, Share, accepted, between, checked
from torchrl_quad.vision.primitives import SIZES

Length = Annotated[float, between(1e-6, 1e6)]  # [m]
_COLOR = "written as #rrggbb, such as #c8452f"
Color = Annotated[Any, accepted(lambda x: isinstance(x, str) and bool(re.fullmatch("#[0-9a-fA-F]{6}", x)), _COLOR)]
_RING = 33  # points of a circle, the first again at its end


@checked
@dataclass(frozen=True)
class Shape:
    """An object that does not move: an obstacle, a wall, a path. Figures, films and replays draw it.

    The class methods make the usual ones. ``Shape(points, faces)`` takes any mesh, such as
    ``Shape(mesh.vertices, mesh.faces)`` of trimesh. The opacity is that of a surface, above 0, at most 1.
    """

    points: Any  #: (n, 3) [m], world frame; a line has a gap where a point is NaN
    faces: Any = None  #: the corners of triangles, as indices of points (m, 3); None for a line
    name: str = ""  #: in the legend
    color: Color = "#6b7a90"  # of lines and surfaces
    opacity: Share = 0.35  # of a surface, above 0, at most 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", as_points("Shape: points", self.points))
        if self.faces is not None:
            faces = as_numbers(self.faces)
            if faces is None or faces.dim() != 2 or faces.shape[1] != 3 or not 0 <= faces.max() < len(self.points):
                raise UserValueError(f"Shape: faces must be indices (m, 3) of its {len(self.points)} points.")
            object.__setattr__(self, "faces", faces.long())

    @classmethod
    def line(cls, points: object, **style: Any) -> Shape:
        """A line through points (n, 3) [m]."""
        return cls(points, **style)

    @classmethod
    @checked
    def ring(cls, centre: object, radius: Length, axis: object = (1.0, 0.0, 0.0), **style: Any) -> Shape:
        """A circle around an axis (3), such as a gate."""
        centre, axis = as_points("Shape.ring: centre and axis", [centre, axis]).split(1)
        return cls(rings(centre, axis, radius)[0], **style)

    @classmethod
    @checked
    def box(cls, low: object, high: object, **style: Any) -> Shape:
        """A box along the axes, from its lowest corner (3) to its highest (3) [m]."""
        low, high = as_points("Shape.box: low and high", [low, high])
        bits = torch.arange(8)[:, None] >> torch.tensor([2, 1, 0]) & 1
        sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return cls(low + bits * (high - low), [x for a, b, c, d in sides for x in ((a, b, c), (a, c, d))], **style)

    @classmethod
    @checked
    def sphere(cls, centre: object, radius: Length, **style: Any) -> Shape:
        """A ball."""
        angle = torch.linspace(-0.5 * math.pi, 0.5 * math.pi, 13)
        return cls._turned(centre, radius * angle.cos(), radius * angle.sin(), style)

    @classmethod
    @checked
    def cylinder(cls, base: object, radius: Length, height: Length, **style: Any) -> Shape:
        """An upright cylinder on the centre (3) of its base, such as a tree or a pillar."""
        return cls._turned(base, radius * torch.tensor([0.0, 1, 1, 0]), height * torch.tensor([0.0, 0, 1, 1]), style)

    @classmethod
    def _turned(cls, centre: object, radii: Tensor, heights: Tensor, style: dict[str, Any], around: int = 24) -> Shape:
        """The surface that a line (k) of radii and heights sweeps around an upright axis."""
        angle = torch.arange(around) * (2 * math.pi / around)
        x, y = (radii[:, None] * turn for turn in (angle.cos(), angle.sin()))
        points = torch.stack((x, y, heights[:, None].expand_as(x)), -1).reshape(-1, 3)
        row, column = torch.meshgrid(torch.arange(len(radii) - 1), torch.arange(around), indexing="ij")
        a, b = (around * row + turned for turned in (column, (column + 1) % around))
        faces = torch.stack((a, b, b + around, a, b + around, a + around), -1).reshape(-1, 3)
        return cls(as_points("Shape: the centre", [centre]) + points, faces, **style)


def as_points(what: str, points: object) -> Tensor:
    """Points (n, 3) as pictures take them: on the CPU, in single precision, without gradient."""
    found = as_numbers(points)
    if found is None or found.dim() != 2 or found.shape[1] != 3 or not len(found):
        got = shown(points) if found is None else f"shape {tuple(found.shape)}"
        raise UserValueError(f"{what} must be points (n, 3) [m], got {got}.")
    return found


def as_numbers(values: Any) -> Tensor | None:
    """A tensor, an array, or a list of numbers, or of any of these, on the CPU, in single precision; None if none."""
    try:
        if isinstance(values, list | tuple) and values:
            values = torch.stack([torch.as_tensor(x).detach().cpu().float() for x in values])
        return torch.as_tensor(values).detach().cpu().float()
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None


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
    is_upright = side.norm(dim=-1, keepdim=True) <= 1e-3
    side = normalize(torch.where(is_upright, torch.tensor([0.0, 1.0, 0.0]), side), dim=-1)
    upright = normalize(torch.linalg.cross(side, axes), dim=-1)
    angle = torch.linspace(0, 2 * math.pi, _RING)[:, None]
    turns = angle.cos() * side[:, None] + angle.sin() * upright[:, None]
    return centres[:, None] + torch.as_tensor(radius).reshape(-1, 1, 1) * turns


def rims(centres: Tensor, rotations: Tensor, sizes: Tensor) -> Tensor:
    """Rims (k, 33, 3) around the x axes of rotations (k, 4): rectangles of half a width and a height (k, 2), or circles
    of radii (k, 1)."""
    angle = torch.linspace(0, 2 * math.pi, _RING).to(centres)
    rim = torch.stack((torch.zeros_like(angle), angle.cos(), angle.sin()), -1)
    if sizes.shape[-1] == 2:  # from a circle to a square
        rim = rim / rim.abs().amax(-1, keepdim=True)
    rim = rim * torch.nn.functional.pad(sizes.expand(-1, 2), (1, 0)).unsqueeze(1)
    return centres.unsqueeze(1) + quaternion.rotate(rotations.unsqueeze(1), rim)


@checked
@dataclass(frozen=True)
class Markers:
    """What pictures show in addition to the drones; positions are in m, in the world frame.

    Without places, a curve, or gates that are the targets, pictures also show where the entry ``target`` (num_envs, 3)
    of the state has been in the flight. ``success`` is the value of the progress, in SI units, from which a state
    fulfils the task.
    """

    target: str = "target"  #: the name of the target, as in "distance to the target"
    places: Tensor | None = None  #: targets that do not move (k, 3)
    curve: Tensor | None = None  #: a line (m, 3) along which the target moves
    gates: Tensor | None = None  #: centres of gates (k, 3), in the order of flight
    gate_radius: float | Tensor = 0.3  #: of all gates, or of each (k) [m]
    gate_axes: Tensor | None = None  #: the direction (k, 3) in which each gate is flown; by default along the course
    gate_rims: Tensor | None = None  #: points around the openings (k, 33, 3), instead of circles
    shapes: Sequence[Shape] = ()  #: other objects
    progress: str | None = None  #: the metric that best shows how a flight goes; None for the distance to the target
    success: Real | None = None  # the value of the progress, in SI units, from which a state fulfils the task

    def __post_init__(self) -> None:
        for name in ("places", "curve", "gates", "gate_axes"):
            if (points := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_points(f"Markers: {name}", points))
        count = 0 if self.gates is None else len(self.gates)
        radius = as_numbers(self.gate_radius)
        is_radius = radius is not None and radius.numel() in (1, count)
        if not is_radius or not ((radius > 0) & radius.isfinite()).all():
            raise UserValueError(f"Markers: gate_radius must be positive [m], one for all {count} gates or one each.")
        if self.gate_axes is not None and len(self.gate_axes) != count:
            raise UserValueError(f"Markers: gate_axes has {len(self.gate_axes)} directions for {count} gates.")
        if self.gate_rims is not None:
            object.__setattr__(self, "gate_rims", as_numbers(self.gate_rims))
            if self.gate_rims is None or self.gate_rims.shape != (count, _RING, 3):
                raise UserValueError(f"Markers: gate_rims must be {_RING} points around each of {count} gates.")
        is_list = isinstance(self.shapes, Sequence) and not isinstance(self.shapes, str | bytes)
        if not is_list or not all(isinstance(shape, Shape) for shape in self.shapes):
            raise UserValueError("Markers: shapes must be a list of Shape, such as [Shape.sphere((0, 0, 2), 0.5)].")

    def rings(self) -> Tensor | None:
        """The rims of the gates (k, 33, 3), if there are any."""
        if self.gates is None:
            return None
        if self.gate_rims is not None:
            return self.gate_rims
        axes = along_the_course(self.gates) if self.gate_axes is None else self.gate_axes
        return rings(self.gates, axes, self.gate_radius)

    def points(self) -> list[Tensor]:
        """All points that pictures show, each (*, 3)."""
        everything = (self.places, self.curve, self.rings(), *(shape.points for shape in self.shapes))
        return [x for x in everything if x is not None]


def visible_state(state: Any) -> State:
    """The entries of a state, nested or not, that pictures show: ``position``, ``quaternion``, ``target`` if it is a
    position, the random obstacles of a scene, and a track of each environment's own."""
    shown: State = {key: state[key] for key in ("position", "quaternion")}
    if "target" in state and state["target"].shape == state["position"].shape:
        shown["target"] = state["target"]
    for key in (*(("scene", kind) for kind in SIZES), ("track", "gates"), ("track", "rotations")):
        own = state[key] if key in state else state.get(key[0], {}).get(key[1], None)
        if own is not None:
            shown[key] = own
    return {key: x.detach() for key, x in shown.items()}


def merge_reset(before: State, begun: State, mask: Tensor | None) -> State:
    """The visible state after a reset of the environments in a mask (num_envs, 1), of all of them for None."""
    if mask is None or not before:
        return dict(begun)
    return {key: torch.where(like(mask.flatten(), x), x, before[key]) for key, x in begun.items()}
