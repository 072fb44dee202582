"""Obstacles in a task: fixed ones, and others that each episode draws anew."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import QuadrotorParams, presets, quaternion
from torchrl_quad.dynamics.presets import is_number
from torchrl_quad.engine import looks_are_free
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import between, build, check_value, checked
from torchrl_quad.vision import Primitives, closest_approach, nearest
from torchrl_quad.vision.primitives import SIZES, distances, join

TRIES = 20  # how often an obstacle that stands in a start is drawn again before it is left out
ELSEWHERE = -1e4  # [m], the height of what is left out: nobody sees it, nobody meets it
MAX_OBSTACLES = 1_000
SMALLEST = 1e-3  # [m], of an obstacle: what single precision resolves at a distance of ten kilometres
Obstacles = Sequence[Mapping[str, Any]]
Count = Annotated[int, between(1, MAX_OBSTACLES)]
Clearance = Annotated[float, between(0.0, 100.0)]
Radius = Annotated[float, between(1e-3, 10.0)]
TOLERANCE = 1e-3  # [m], by which a state may lie nearer to an obstacle than a flight would have left it

# The fields of an obstacle by kind, with the number of their entries; a random one has ranges of them.
_FIELDS = {
    "spheres": {"centre": 3, "radius": 1},
    "cylinders": {"base": 3, "radius": 1, "height": 1},
    "boxes": {"centre": 3, "size": 3, "yaw": 1, "quaternion": 4},
    "walls": {"point": 3, "normal": 3},
}
_OPTIONAL = {"yaw", "quaternion"}


@checked
class Scene(Disturbance):
    """The obstacles of a task: ``HoveringEnv(scene={"ground": True, "cylinders": [...]})``, or a YAML file of it.

    .. code-block:: yaml

        ground: true                                                   # the plane z = 0
        walls: [{point: [8, 0, 0], normal: [-1, 0, 0]}]                # planes; the normal points into free space
        spheres: [{centre: [2, 0, 1.5], radius: 0.5}]
        cylinders:                                                     # upright
          - {base: [3, 1, 0], radius: 0.2, height: 4}
          - {count: 20, low: [-5, -5, 0], high: [5, 5, 0], radius: [0.1, 0.3], height: 4}
        boxes: [{centre: [0, 2, 0.5], size: [1, 1, 1], yaw: 0.5}]      # or quaternion: [w, x, y, z], to world

    An entry with a ``count`` stands for so many obstacles, which each episode draws anew: the centre, or base, evenly
    from ``low`` to ``high``, and a field with two values evenly between them. They keep clear of where the drone
    starts, and of its ``target`` if the state has one. One that finds no place in 20 tries is left out.

    State added: ``("scene", kind)`` for kinds with random obstacles, as :class:`~torchrl_quad.vision.Primitives` has
    them; ``collided`` (1), whether the drone came closer to a surface than its radius in this step, anywhere on the
    straight way that it flew. It then has crashed. What happens at the ground is the matter of the task: it is seen,
    and counts as the nearest surface, and touching it is no collision.

    Args:
        ground: whether there is the plane z = 0.
        spheres: a list of mappings with centre, and radius; lengths are 0.001 to 10,000 m, coordinates within 10 km.
        cylinders: a list of mappings with base, radius and height.
        boxes: a list of mappings with centre, size, and yaw or quaternion.
        walls: a list of mappings with point and normal, all fixed.
        clearance: the least way from the drone's surface to random obstacles at its start, and at its target, 0 to
            100 m.
        drone_radius: of the sphere around the drone's centre that must not touch anything, 0.001 to 10 m; by default
            that of a sphere around the propellers, as large as they can be without touching each other.
        source: what errors call the scene.

    Raises:
        ValueError: an obstacle is not one, or (in use) a drone would start within one.
    """

    is_drawn_elsewhere = False  #: whether a subclass draws obstacles that its arguments do not name

    def __init__(
        self,
        *,
        ground: bool = False,
        spheres: Obstacles = (),
        cylinders: Obstacles = (),
        boxes: Obstacles = (),
        walls: Obstacles = (),
        clearance: Clearance = 0.3,
        drone_radius: Radius | None = None,
        source: str = "scene",
    ) -> None:
        self.source, self.ground, self.clearance, self.drone_radius = source, ground, clearance, drone_radius
        self.fixed: dict[str, list[list[float]]] = {kind: [] for kind in SIZES}
        self.random: dict[str, list[dict[str, Any]]] = {kind: [] for kind in SIZES}
        if ground:
            self.fixed["planes"].append([0.0, 0.0, 1.0, 0.0])
        for kind, entries in {"spheres": spheres, "cylinders": cylinders, "boxes": boxes, "walls": walls}.items():
            self._read(kind, entries)
        count = sum(len(x) for x in self.fixed.values()) + sum(x["count"] for y in self.random.values() for x in y)
        self._require(count <= MAX_OBSTACLES, f"{count:,} obstacles are too many; {MAX_OBSTACLES:,} are the most.")
        self._require(count > 0 or self.is_drawn_elsewhere, "a scene needs an obstacle or the ground: give it one.")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            checked(cls)

    @classmethod
    def of(cls, spec: Scene | str | Path | Mapping) -> Scene:
        """The scene that a mapping or a YAML file describes, or the scene itself."""
        if isinstance(spec, Scene):
            return spec
        source, values = presets.read("scene", spec)
        return build(Scene, source, values, source=source)

    @property
    def is_random(self) -> bool:
        """Whether each episode has obstacles of its own."""
        return self.is_drawn_elsewhere or any(self.random.values())

    def bound(self, nominal: QuadrotorParams) -> Scene:
        """A copy for a drone, with its tensors in the drone's precision and on its device."""
        own, like = copy.copy(self), nominal.mass
        own.constants = Primitives(
            *(
                torch.tensor(self.fixed[kind], dtype=like.dtype, device=like.device).reshape(1, -1, size)
                for kind, size in SIZES.items()
            )
        )
        own.touchable = own.constants._replace(planes=own.constants.planes[:, int(self.ground) :])
        own.radius = drone_radius(nominal) if self.drone_radius is None else self.drone_radius
        return own

    # -- what it draws -------------------------------------------------------------------------------------------------

    def draw(self, random: Randomness, state: State) -> dict[str, Tensor]:
        """The random obstacles (n, m, ...) by kind, for drones that start in a state; a subclass may draw others."""
        keep_clear = [state["position"]]
        if "target" in state and state["target"].shape == state["position"].shape:
            keep_clear.append(state["target"])
        points, drawn = torch.stack(keep_clear, 1), {}
        for kind, groups in self.random.items():
            if groups:
                drawn[kind] = torch.cat([self._draw_clear(random, kind, group, points) for group in groups], 1)
        return drawn

    def start(self, random: Randomness, state: State) -> State:
        """Draw the obstacles, and see that no drone starts within one."""
        drawn = {("scene", kind): x for kind, x in self.draw(random, state).items()}
        state = {**state, **drawn}
        if looks_are_free(random.device):
            for complaint, where in self._inside(state).items():
                if where.any():
                    raise UserValueError(
                        f"{self.source}: {complaint}, and drones would start there, such as at "
                        f"{[round(x, 2) for x in state['position'][where][0].tolist()]} m. Move one of them."
                    )
        return {**drawn, "collided": torch.zeros_like(state["position"][:, :1], dtype=torch.bool)}

    # -- what a task may ask -------------------------------------------------------------------------------------------

    def solids(self, state: State, ground: bool = True) -> Primitives:
        """All obstacles of the scenes of a state, with the ground or without it."""
        constants = self.constants if ground else self.touchable
        own = (state.get(("scene", kind)) for kind in SIZES)
        own = (c[:, :0] if x is None else x for x, c in zip(own, constants, strict=True))
        return join(constants, Primitives(*own))

    def nearest(self, state: State) -> tuple[Tensor, Tensor]:
        """How far the drone's surface is from the nearest obstacle (n, 1) [m], and the direction (n, 3) away from it.

        Negative where it touches. Both are differentiable, and finite everywhere, also within obstacles.
        """
        distance, away = nearest(self.solids(state), state["position"])
        return distance - self.radius, away

    def collided(self, before: State, state: State) -> Tensor:
        """Whether the drone touches an obstacle on the straight way from one state to the next, bool (n, 1)."""
        solids = self.solids(state, ground=False)
        if not solids.count:
            return torch.zeros_like(state["collided"])
        return closest_approach(solids, before["position"], state["position"]) < self.radius

    def complaints(self, state: State) -> dict[str, Tensor]:
        """What is wrong with a state to start from, in words, and where, bool (n)."""
        wrong = self._inside(state)
        for kind, (first, last) in {"spheres": (3, 4), "cylinders": (3, 5), "boxes": (3, 6)}.items():
            x = state.get(("scene", kind))
            if x is not None:
                small = (x[..., first:last] <= 0.0).flatten(1).any(1)
                wrong[f"('scene', {kind!r}) must have sizes above 0"] = small
        for kind, first in {"boxes": 6, "planes": 0}.items():  # an attitude, and a normal
            x = state.get(("scene", kind))
            if x is not None:
                length = x[..., first : first + (4 if kind == "boxes" else 3)].square().sum(-1)
                wrong[f"('scene', {kind!r}) must be turned by unit vectors"] = ((length - 1.0).abs() > 1e-2).any(1)
        return wrong

    def _inside(self, state: State) -> dict[str, Tensor]:
        """Which drones start within an obstacle."""
        solids = self.solids(state, ground=False)
        if not solids.count:
            return {}
        inside = nearest(solids, state["position"])[0] < self.radius - TOLERANCE
        return {f"an obstacle stands within {self.radius:.3g} m of 'position', the radius of the drone": inside[:, 0]}

    # -- reading -------------------------------------------------------------------------------------------------------

    def _read(self, kind: str, entries: Any) -> None:
        fields, solids = _FIELDS[kind], "planes" if kind == "walls" else kind
        place = next(iter(fields))
        for entry in entries:
            is_random = "count" in entry and kind != "walls"
            sizes = {"count": 0, "low": 3, "high": 3} if is_random else {}
            sizes |= {name: size for name, size in fields.items() if not (is_random and name in (place, "quaternion"))}
            unknown = sorted(str(key) for key in entry if key not in sizes)
            missing = [key for key in sizes if key not in entry and key not in _OPTIONAL]
            what = f"{kind}: an obstacle has {', '.join(sizes)}"
            self._require(not unknown, f"{what}; unknown: {shown(', '.join(unknown))}.")
            self._require(not missing, f"{what}; missing: {', '.join(missing)}.")
            count = check_value(f"{kind}: count", entry.get("count", 1), Count)
            read = {
                name: self._range(f"{kind}: {name}", entry[name], size, is_random and name not in ("low", "high"))
                for name, size in sizes.items()
                if name in entry and name != "count"
            }
            for name in ("radius", "height", "size"):
                least = min(read[name][0]) if name in read else 1.0
                said = f"{kind}: {name} must be at least {SMALLEST:g} m, got {shown(entry.get(name))}."
                self._require(least >= SMALLEST, said)
            if is_random:
                low, high = read["low"][0], read["high"][0]
                ordered = all(a <= b for a, b in zip(low, high, strict=True))
                self._require(ordered, f"{kind}: low must not be above high along any axis, got {low} and {high}.")
                self.random[solids].append({"count": count, **read})
            else:
                self.fixed[solids].append(self._numbers(kind, {name: low for name, (low, _) in read.items()}))

    def _range(self, name: str, value: Any, size: int, may_vary: bool) -> tuple[list[float], list[float]]:
        """The least and the greatest value of a field, each a list of so many numbers."""

        def numbers(x: Any) -> list[float] | None:
            x = [x] if size == 1 and is_number(x) else x
            is_right = isinstance(x, Sequence) and len(x) == size and all(is_number(y) and abs(y) < 1e4 for y in x)
            return [float(y) for y in x] if is_right else None

        one = numbers(value)
        if one is not None:
            return one, one
        is_pair = may_vary and isinstance(value, Sequence) and len(value) == 2
        low, high = (numbers(x) for x in value) if is_pair else (None, None)
        ordered = low is not None and high is not None and all(a <= b for a, b in zip(low, high, strict=True))
        entries = "a number within 10,000" if size == 1 else f"{size} numbers within 10,000"
        more = f", or the least and the greatest of {'it' if size == 1 else 'them'}" if may_vary else ""
        self._require(ordered, f"{name} must be {entries}{more}; got {shown(value)}.")
        return low, high

    def _numbers(self, kind: str, entry: dict[str, list[float]]) -> list[float]:
        """The numbers of a fixed solid."""
        if kind == "boxes":
            self._require(not {"yaw", "quaternion"} <= set(entry), "boxes: give a yaw or a quaternion, not both.")
            yaw = entry.get("yaw", [0.0])[0]
            turned = entry.get("quaternion", [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)])
            norm = math.sqrt(sum(x * x for x in turned))
            self._require(norm > 1e-6, f"boxes: quaternion must have unit norm, got {shown(turned)}.")
            return [*entry["centre"], *(0.5 * x for x in entry["size"]), *(x / norm for x in turned)]
        if kind == "walls":
            length = math.sqrt(sum(x * x for x in entry["normal"]))
            self._require(length > 1e-6, f"walls: normal must be a direction, got {entry['normal']!r}.")
            normal = [x / length for x in entry["normal"]]
            return [*normal, sum(x * y for x, y in zip(normal, entry["point"], strict=True))]
        return [x for name in _FIELDS[kind] for x in entry[name]]

    def _require(self, condition: bool, message: str) -> None:
        if not condition:
            raise UserValueError(message)

    def _draw_clear(self, random: Randomness, kind: str, group: dict[str, Any], points: Tensor) -> Tensor:
        """The obstacles (n, count, ...) of a group; none stands at the points (n, k, 3)."""
        drawn = blocked = None
        for _ in range(TRIES):
            new = _draw(random, kind, group, len(points))
            drawn = new if drawn is None else torch.where(blocked.unsqueeze(-1), new, drawn)
            alone = Primitives(*(drawn if name == kind else x[:, :0] for name, x in _none(points).items()))
            blocked = (distances(alone, points) < self.radius + self.clearance).any(1)
            if looks_are_free(points.device) and not blocked.any():
                return drawn
        return left_out(drawn, blocked)


def left_out(solids: Tensor, who: Tensor) -> Tensor:
    """Solids (n, m, k) that are not planes, those of a mask (n, m) out of everybody's way."""
    elsewhere = torch.cat((solids[..., :2], torch.full_like(solids[..., :1], ELSEWHERE), solids[..., 3:]), -1)
    return torch.where(who.unsqueeze(-1), elsewhere, solids)


def drone_radius(params: QuadrotorParams) -> float:
    """The radius of a sphere around a drone and its propellers, as large as they can be without touching [m]."""
    rotors = params.rotor_positions.detach().reshape(-1, 4, 2)[0]
    apart = torch.pdist(rotors).min() if len(rotors) > 1 else rotors.new_zeros(())
    return (rotors.norm(dim=-1).max() + 0.5 * apart).item()


def _draw(random: Randomness, kind: str, group: dict[str, Any], n: int) -> Tensor:
    """The obstacles of a group, (n, count, ...), wherever they fall."""
    count = group["count"]

    def value(name: str) -> Tensor:
        low, high = (random.tensor(x) for x in group[name])
        return low + (high - low) * 0.5 * (random.uniform(n, count, len(low)) + 1.0)

    low, high = (random.tensor(group[name][0]) for name in ("low", "high"))
    place = low + (high - low) * 0.5 * (random.uniform(n, count, 3) + 1.0)
    if kind != "boxes":
        return torch.cat((place, *(value(name) for name in ("radius", "height") if name in group)), -1)
    yaw = value("yaw") if "yaw" in group else torch.zeros_like(place[..., :1])
    turned = quaternion.from_axis_angle(torch.cat((torch.zeros_like(place[..., :2]), yaw), -1))
    return torch.cat((place, 0.5 * value("size"), turned), -1)


def _none(like: Tensor) -> dict[str, Tensor]:
    return {kind: like.new_zeros((len(like), 0, size)) for kind, size in SIZES.items()}
