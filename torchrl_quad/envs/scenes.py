"""Obstacles in a task, fixed or drawn for each episode, and the camera among them."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.dynamics import QuadrotorParams, presets, quaternion
from torchrl_quad.dynamics.vector import is_traced
from torchrl_quad.engine import looks_are_free
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import between, build, check_value, checked
from torchrl_quad.vision import DepthCamera, Primitives, closest_approach, nearest
from torchrl_quad.vision.primitives import KINDS, SIZES, join

TRIES = 20  # how often an obstacle that stands in a start is drawn again before it is left out
ELSEWHERE = -1e4  # [m], the height of what is left out: outside every flight and every image
MAX_OBSTACLES = 1_000
SMALLEST = 1e-3  # [m], of an obstacle: what single precision resolves at a distance of ten kilometres
TOLERANCE = 1e-3  # [m], by which a state may lie nearer to an obstacle than a flight would have left it
Obstacles = Sequence[Mapping[str, Any]]
Count = Annotated[int, between(1, MAX_OBSTACLES)]

# The fields of an obstacle by kind, with the number of their entries; the first is where it stands.
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

    An entry with a ``count`` stands for so many obstacles, which each episode draws: the centre, or base, uniformly
    from ``low`` to ``high``, and a field with two values uniformly between them. They keep clear of where the drone
    starts, and of its ``target`` if the state has one. One that finds no place in 20 tries is left out.

    State added: ``("scene", kind)`` for kinds with random obstacles, as in :class:`~torchrl_quad.vision.Primitives`;
    ``collided`` (1), whether the drone came closer to a surface than its radius in this step, anywhere on the straight
    way that it flew. It then has crashed. The ground is in images and counts as the nearest surface, but touching it is
    no collision: that is up to the task.

    Args:
        ground: whether there is the plane z = 0.
        spheres, cylinders, boxes, walls: lists of mappings as above; walls are all fixed. Lengths are 0.001 to 10,000
            m, coordinates within 10 km.
        clearance: the least distance from the drone's surface to random obstacles at its start, and at its target, 0 to
            100 m; by default 0.3 m.
        drone_radius: of the sphere around the drone's centre that must not touch anything, 0.001 to 10 m; by default
            that of a sphere around the propellers, as large as they can be without touching each other.
        source: what errors call the scene.

    Raises:
        ValueError: an obstacle is not one, or (in use) a drone would start within one.
    """

    constants: Primitives  #: the fixed obstacles, in the precision and on the device of a drone
    touchable: Primitives  #: the same without the ground
    radius: float  #: of the drone [m]
    was_drawn = False

    def __init__(
        self,
        *,
        ground: bool = False,
        spheres: Obstacles = (),
        cylinders: Obstacles = (),
        boxes: Obstacles = (),
        walls: Obstacles = (),
        clearance: Annotated[float, between(0.0, 100.0)] | None = None,
        drone_radius: Annotated[float, between(1e-3, 10.0)] | None = None,
        source: str = "scene",
    ) -> None:
        self.source, self.ground, self.drone_radius = source, ground, drone_radius
        self.clearance = 0.3 if clearance is None else clearance
        self.fixed: dict[str, list[list[float]]] = {kind: [] for kind in SIZES}
        self.random: dict[str, list[dict[str, Any]]] = {kind: [] for kind in SIZES}
        if ground:
            self.fixed["planes"].append([0.0, 0.0, 1.0, 0.0])
        for kind, obstacles in {"spheres": spheres, "cylinders": cylinders, "boxes": boxes, "walls": walls}.items():
            for obstacle in obstacles:
                self._read(kind, obstacle)
        count = sum(len(x) for x in self.fixed.values()) + sum(x["count"] for y in self.random.values() for x in y)
        if count > MAX_OBSTACLES:
            raise UserValueError(f"{count:,} obstacles are too many; the maximum is {MAX_OBSTACLES:,}.")
        if clearance is not None and not any(self.random.values()) and type(self).draw is Scene.draw:
            raise UserValueError("clearance is of obstacles with a count, and there are none. Leave it out.")
        if not count:
            raise UserValueError("a scene needs an obstacle or the ground: give it one.")

    @classmethod
    def of(cls, spec: Scene | str | Path | Mapping[str, Any]) -> Scene:
        """The scene that a mapping or a YAML file describes, or the scene itself."""
        if isinstance(spec, Scene):
            return spec
        source, values = presets.read("scene", spec)
        return build(Scene, source, values, source=source)

    def bound(self, nominal: QuadrotorParams) -> Scene:
        """A copy for a drone, with its tensors in the drone's precision and on its device."""
        own, like = copy.copy(self), nominal.mass
        fixed = {kind: like.new_tensor(self.fixed[kind]).reshape(1, -1, size) for kind, size in SIZES.items()}
        own.constants = Primitives(**fixed)
        own.touchable = own.constants._replace(planes=own.constants.planes[:, int(self.ground) :])
        own.radius = reach_of(nominal) if self.drone_radius is None else self.drone_radius
        return own

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
        """Draw the obstacles, and check that no drone starts within one."""
        drawn: State = {("scene", kind): x for kind, x in self.draw(random, state).items()}
        state = {**state, **drawn}
        if looks_are_free(random.device) or not self.was_drawn:  # on a GPU at first only, which waits for the answer
            self.was_drawn = True
            for problem, where in self.problems(state).items():
                if where.any():
                    place = [round(x, 2) for x in state["position"][where][0].tolist()]
                    raise UserValueError(
                        f"{self.source}: {problem}, and drones would start there, such as at {place} m. Move one of "
                        "them."
                    )
        return {**drawn, "collided": torch.zeros_like(state["position"][:, :1], dtype=torch.bool)}

    def solids(self, state: State, ground: bool = True) -> Primitives:
        """All obstacles of the scenes of a state, with the ground or without it."""
        constants = self.constants if ground else self.touchable
        own = {kind: state.get(("scene", kind), x[:, :0]) for kind, x in constants._asdict().items()}
        return join(constants, Primitives(**own))

    def nearest(self, state: State) -> tuple[Tensor, Tensor]:
        """How far the drone's surface is from the nearest obstacle (n, 1) [m], and the direction (n, 3) away from it.

        For positions (n, k, 3), too. Negative where it touches. Both are differentiable, and finite everywhere, also
        within obstacles.
        """
        distance, away = nearest(self.solids(state), state["position"])
        return distance - self.radius, away

    def collided(self, before: State, state: State) -> Tensor:
        """Whether the drone touches an obstacle on the straight way from one state to the next, bool (n, 1)."""
        solids = self.solids(state, ground=False)
        if not solids.total:
            return torch.zeros_like(state["collided"])
        return closest_approach(solids, before["position"], state["position"]) < self.radius

    def problems(self, state: State) -> dict[str, Tensor]:
        solids = self.solids(state, ground=False)
        if not solids.total:
            return {}
        inside = nearest(solids, state["position"])[0] < self.radius - TOLERANCE
        return {f"an obstacle stands within {self.radius:.3g} m of 'position', the radius of the drone": inside[:, 0]}

    def _read(self, kind: str, obstacle: Mapping[str, Any]) -> None:
        """Add an obstacle to the fixed or to the random ones."""
        fields, is_random = dict(_FIELDS[kind]), "count" in obstacle and kind != "walls"
        solids = "planes" if kind == "walls" else kind
        place, *others = (name for name in fields if name != "quaternion")
        if is_random:
            fields = {"count": 0, "low": 3, "high": 3} | {name: fields[name] for name in others}
        needed, given = fields.keys() - _OPTIONAL, set(map(str, obstacle))
        for problem, names in (("unknown", given - fields.keys()), ("missing", needed - given)):
            if names:
                what = f"{kind}: an obstacle has {', '.join(fields)}"
                raise UserValueError(f"{what}; {problem}: {', '.join(sorted(names))}.")
        if not is_random:
            numbers = {name: _range(kind, name, x, fields[name], False)[0] for name, x in obstacle.items()}
            self.fixed[solids].append(_numbers(kind, numbers))
            return
        group = {name: _range(kind, name, obstacle[name], fields[name], True) for name in others if name in obstacle}
        group[place] = _range(kind, "low and high", [obstacle["low"], obstacle["high"]], 3, True)
        self.random[solids].append({"count": check_value(f"{kind}: count", obstacle["count"], Count), **group})

    def _draw_clear(self, random: Randomness, kind: str, group: dict[str, Any], points: Tensor) -> Tensor:
        """The obstacles (n, count, ...) of a group; none stands at the points (n, k, 3)."""
        n, (distance, _) = len(points), KINDS[kind]
        drawn = _draw(random, kind, group, n)
        blocked = torch.zeros_like(drawn[..., 0], dtype=torch.bool)
        for tries in range(TRIES):
            if tries:
                drawn = torch.where(blocked.unsqueeze(-1), _draw(random, kind, group, n), drawn)
            blocked = (distance(drawn.unsqueeze(1), points.unsqueeze(2)) < self.radius + self.clearance).any(1)
            if looks_are_free(points.device) and not blocked.any():
                return drawn
        return left_out(drawn, blocked)


def reach_of(drone: QuadrotorParams) -> float:
    """The radius [m] of a drone whose propellers are as large as they can be without touching each other."""
    rotors = drone.rotor_positions.detach()[..., :2].reshape(-1, drone.rotor_spin.shape[-1], 2)[0]
    arm, gaps = rotors.norm(dim=-1).max(), torch.pdist(rotors)
    return (arm + 0.5 * gaps[gaps > 1e-2 * arm].min()).item()  # coaxial rotors are above each other


def left_out(solids: Tensor, who: Tensor) -> Tensor:
    """Solids (n, m, k) that are not planes, those of a mask (n, m) moved out of the way."""
    elsewhere = torch.cat((solids[..., :2], torch.full_like(solids[..., :1], ELSEWHERE), solids[..., 3:]), -1)
    return torch.where(who.unsqueeze(-1), elsewhere, solids)


def _range(kind: str, name: str, value: object, size: int, may_vary: bool) -> tuple[list[float], list[float]]:
    """The least and the greatest value of a field, each a list of so many numbers."""
    try:
        found = presets.as_array(value).reshape(-1, size)
    except (ValueError, RecursionError):
        found = np.full((1, size), np.nan)
    low, high = found[[0, -1]].tolist() if found.size else ([], [])
    least = SMALLEST if name in ("radius", "height", "size") else -1e4
    in_order = all(least <= a <= b < 1e4 for a, b in zip(low, high, strict=True))
    if low and len(found) <= 1 + may_vary and in_order:
        return low, high
    wanted = f"{size} numbers" if size > 1 else "a number"
    limits = f"from {least:g} to 10,000" if least > 0 else "within 10,000"
    more = f", or the least and the greatest of {'it' if size == 1 else 'them'}" if may_vary else ""
    raise UserValueError(f"{kind}: {name} must be {wanted} {limits}{more}; got {shown(value)}.")


def _numbers(kind: str, obstacle: dict[str, list[float]]) -> list[float]:
    """The numbers of a fixed solid, as in Primitives."""
    if kind == "boxes":
        if {"yaw", "quaternion"} <= set(obstacle):
            raise UserValueError("boxes: give a yaw or a quaternion, not both.")
        (yaw,) = obstacle.get("yaw", [0.0])
        attitude = obstacle.get("quaternion", [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)])
        return [*obstacle["centre"], *(0.5 * x for x in obstacle["size"]), *_unit("boxes: quaternion", attitude)]
    if kind == "walls":
        normal = _unit("walls: normal", obstacle["normal"])
        return [*normal, sum(x * y for x, y in zip(normal, obstacle["point"], strict=True))]
    return [x for name in _FIELDS[kind] for x in obstacle[name]]


def _unit(name: str, vector: list[float]) -> list[float]:
    length = math.sqrt(sum(x * x for x in vector))
    if length <= 1e-6:
        raise UserValueError(f"{name} must not be zero, got {vector}.")
    return [x / length for x in vector]


def _draw(random: Randomness, kind: str, group: dict[str, Any], n: int) -> Tensor:
    """The obstacles of a group, (n, count, ...), wherever they fall."""

    def uniform(low: list[float], high: list[float]) -> Tensor:
        least, most = random.tensor(low), random.tensor(high)
        return least + (most - least) * 0.5 * (random.uniform(n, group["count"], len(low)) + 1.0)

    place = uniform(*group[next(iter(_FIELDS[kind]))])
    if kind != "boxes":
        return torch.cat((place, *(uniform(*group[name]) for name in ("radius", "height") if name in group)), -1)
    yaw = uniform(*group["yaw"]) if "yaw" in group else torch.zeros_like(place[..., :1])
    attitude = quaternion.from_axis_angle(torch.cat((torch.zeros_like(place[..., :2]), yaw), -1))
    return torch.cat((place, 0.5 * uniform(*group["size"]), attitude), -1)


class MountedCamera(Disturbance):
    """A camera on the drones of a task: when it takes images, when the policy gets them, and which ones it keeps.

    Entry of the state where images are noisy, or older than the state: ``images`` (k, height, width) [m], oldest first.
    """

    def __init__(self, camera: DepthCamera, scene: Scene) -> None:
        self.camera, self.scene = camera, scene
        self.is_compiled = False  # whether the environment is, so that images of starts and steps agree bit for bit
        self.kept = math.ceil(camera.delay / camera.rate) + 1
        self.remembers = camera.is_noisy or camera.rate > 1 or camera.delay > 0
        reach = math.sqrt(sum(x * x for x in camera.position))
        if reach > scene.radius:
            raise UserValueError(
                f"camera: its position is {reach:.3g} m from the drone's centre, outside of the sphere of "
                f"{scene.radius:.3g} m that must not touch anything, so the camera could be inside an obstacle. Move "
                f"it, or give the scene a drone_radius of {math.ceil(100 * reach) / 100:g} m."
            )

    @property
    def noise_size(self) -> int:
        return self.camera.pixels if self.camera.is_noisy else 0

    def start(self, random: Randomness, state: State) -> State:
        if not self.remembers:
            return {}
        noise = random.normal(len(state["position"]), self.noise_size) if self.noise_size else None
        return {"images": self._take(state, noise).expand(-1, self.kept, -1, -1).clone()}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        """Take another image where it is time, and forget the oldest."""
        if not self.remembers:
            return {}
        due = state["step"] % self.camera.rate == 0
        if looks_are_free(due.device) and not is_traced() and not due.any():
            return {}
        images = torch.cat((state["images"][:, 1:], self._take(state, noise)), 1)
        return {"images": torch.where(due[:, :, None, None], images, state["images"])}

    def image(self, state: State) -> Tensor:
        """What the policy gets, (n, 1, height, width) [m]."""
        if not self.remembers:
            return self._take(state, None)
        images, step, rate = state["images"], state["step"], self.camera.rate
        if self.kept == 1:
            return images
        shown = torch.div(step - self.camera.delay, rate, rounding_mode="floor").clamp_min(0)
        newer = torch.div(step, rate, rounding_mode="floor") - shown  # images that are on their way
        index = (self.kept - 1 - newer)[:, :, None, None].expand(-1, 1, *images.shape[2:])
        return images.gather(1, index)

    def _take(self, state: State, noise: Tensor | None) -> Tensor:
        solids, fused = self.scene.solids(state), self.is_compiled
        depth = self.camera.depth(solids, state["position"], state["quaternion"], fused=fused)
        return depth if noise is None else self.camera.measure(depth, noise)
