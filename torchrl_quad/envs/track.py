"""Tracks of the racing task: spheres, or gates with a shape and a direction; and random courses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_quad.dynamics import presets, quaternion
from torchrl_quad.envs.track_files import check_order, flown_track, own_format, posed
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import Seed, accepted, between, build, check_value, checked, entries
from torchrl_quad.rotations import from_euler

MAX_GATES = 1_000
MARGIN = 4.0  # [m], from gates to the sides of the box in which drones fly
TRIES = 16  # courses that are drawn for a random track before it becomes a regular polygon
RUN_UP = 3.0  # [m], at most, from a start to its gate, where gates have a direction
LOWEST_START = 0.25  # [m], above the floor
Length = Annotated[float, between(0.01, 100.0)]
Angle = Annotated[float, between(-10.0, 10.0)]
Triple = Annotated[Sequence[Annotated[float, between(0.0, 10.0)]], entries(3, 3)]
Pair = Annotated[Sequence[Annotated[float, between(0.01, 1_000.0)]], entries(2, 2)]
_TRACK = "the name of a track, the path of a YAML or TOML file, or a mapping"
TrackOption = Annotated[Any, accepted(lambda x: isinstance(x, str | Path | Mapping), _TRACK)]
_TRACKS = resources.files("torchrl_quad.envs") / "tracks"
_OPENING = ("width", "height", "radius")  # of gates with a direction
_SIZES = ("gate_radius", *_OPENING)
# What a setting says otherwise, besides the key of its own name.
_REPLACES = {
    **dict.fromkeys(_SIZES, _SIZES),
    "gates": ("random", "start", "starts"),
    "random": ("gates", "start", "starts"),
    "box": ("floor",),
}
MAX_FILES = 10  # of tracks that change each other
_KEYS = {  # what else a track may say, beside its points
    **{key: (Length, "Of all gates [m].") for key in _SIZES},
    "frame": (Length, "How thick the bars around gates are [m]."),
    "closed": (bool, "Whether the first gate follows the last."),
    "floor": (Annotated[float, between(-1e4, 1e4)], "Its height [m]."),
    "start_range": (Annotated[float, between(0.0, 10.0)], "How far from a start drones start [m]."),
    "position_jitter": (Triple, "How far each episode moves gates to both sides [m]."),
    "rotation_jitter": (Triple, "How far each episode turns gates to both sides [rad]."),
}
_PARTS = ("gates", "starts", *_KEYS, "start", "box", "scene", "random", "notes")


@checked
@dataclass(frozen=True)
class Gate:
    """A gate with a direction. Its x axis is the direction of flight, z is up where it is neither pitched nor rolled.

    Args:
        position: of the centre [m].
        yaw: of the direction, from the world's x axis to its y axis [rad].
        pitch: of the direction, upwards [rad].
        rotation: (w, x, y, z), to the world, instead of yaw and pitch.
        width, height: of an opening with four sides [m].
        radius: of a round one [m].
    """

    position: Any
    yaw: Angle | None = None
    pitch: Angle | None = None
    rotation: Annotated[Sequence[Annotated[float, between(-1.01, 1.01)]], entries(4, 4)] | None = None
    width: Length | None = None
    height: Length | None = None
    radius: Length | None = None

    def __post_init__(self) -> None:
        if (self.yaw is None) == (self.rotation is None) or (self.pitch is not None and self.rotation is not None):
            raise UserValueError("give a yaw, and a pitch if wanted, or a rotation (w, x, y, z), not both.")
        if self.rotation is not None and abs(math.hypot(*self.rotation) - 1.0) > 0.01:
            raise UserValueError(f"its rotation must be a unit quaternion (w, x, y, z); got {shown(self.rotation)}.")
        said = {name for name in _OPENING if getattr(self, name) is not None}
        if said not in ({"width", "height"}, {"radius"}):
            raise UserValueError(
                f"how far it is open is said by {' and '.join(sorted(said)) or 'nothing'}. Give width and height, or "
                "radius [m], once for the track or for each gate: load_track(..., width=1.5, height=1.5), or "
                "env.track={file: ..., width: 1.5, height: 1.5}."
            )

    def entries(self) -> dict[str, Any]:
        """The gate as :func:`load_track` returns it."""
        if self.rotation is None:  # the y axis points left: pitched upwards is negative
            q = from_euler(np.array([0.0, -(self.pitch or 0.0), self.yaw]))
        else:
            q = np.array(self.rotation) / math.hypot(*self.rotation)
        size = {name: float(x) for name in _OPENING if (x := getattr(self, name)) is not None}
        return {"position": self.position, "rotation": q.tolist(), **size}


@checked
@dataclass(frozen=True)
class Course:
    """The rules of random tracks: closed courses that turn once around the origin.

    Args:
        gates: how many, 3 to 50.
        spacing: the least and the greatest horizontal way from gate to gate [m]; the least is between any two.
        turn: the greatest change of course at a gate [rad], at least 2 pi over the number of gates.
        heights: the least and the greatest [m], or one for each gate.
        yaw: how far a gate may be turned from the mean of the ways to it and from it [rad], 0 to 1.5.
        reach: how far from the origin gates may be, horizontally [m]; at most a quarter of the greatest length of the
            course, and up to the sides of the ``box``, if the track has one.
    """

    gates: Annotated[int, between(3, 50)] = 6
    spacing: Pair = (4.0, 8.0)
    turn: Annotated[float, between(0.1, 3.1)] = 2.2
    heights: Annotated[Sequence[Annotated[float, between(-1e3, 1e3)]], entries(2, 50)] = (1.0, 3.0)
    yaw: Annotated[float, between(0.0, 1.5)] = 0.3
    reach: Annotated[float, between(0.0, 1e4)] = 1e4

    def __post_init__(self) -> None:
        if self.turn < (least := 2.0 * math.pi / self.gates):
            raise UserValueError(f"{self.gates} gates need a turn of at least {least:.3g} rad, got {self.turn:g}.")
        if self.spacing[0] > self.spacing[1] or (len(self.heights) == 2 and self.heights[0] > self.heights[1]):
            raise UserValueError("spacing and heights are the least and then the greatest.")
        if len(self.heights) not in (2, self.gates):
            raise UserValueError(f"heights are the least and the greatest, or one for each of the {self.gates} gates.")
        object.__setattr__(self, "reach", min(self.reach, 0.25 * self.gates * self.spacing[1]))
        least = 0.25 * sum(self.spacing) / math.sin(math.pi / self.gates)
        if self.reach < least * (1.0 - 1e-9):
            raise UserValueError(
                f"{self.gates} gates with this spacing need {least:.3g} m to all sides of the origin, and may be up to "
                f"{self.reach:.3g} m from it. Choose fewer gates, a smaller spacing, or a wider box."
            )

    def draw(self, n: int, uniform: Callable[..., Tensor]) -> tuple[Tensor, Tensor]:
        """Draw n courses: centres (n, k, 3) [m], and rotations (n, k, 4).

        Turns and ways are drawn; taking the mean way off closes the course. Of 16 such courses the first that keeps to
        the rules counts, and if none does, a regular polygon.
        """
        k, (low, high), even = self.gates, self.spacing, 2.0 * math.pi / self.gates
        turn = (self.turn - even) * uniform(n, TRIES, k)
        length = low + (high - low) * 0.5 * (uniform(n, TRIES, k) + 1.0)
        turn[:, -1], length[:, -1] = 0.0, 0.5 * (low + high)
        side = torch.where(uniform(n, 1, 1) < 0.0, -1.0, 1.0).to(turn)
        course = math.pi * uniform(n, 1, 1) + side * (even + turn - turn.mean(-1, keepdim=True)).cumsum(-1)
        way = length.unsqueeze(-1) * torch.stack((course.cos(), course.sin()), -1)  # to each gate
        way = way - way.mean(2, keepdim=True)
        place = way.cumsum(2)
        place, length, after = place - place.mean(2, keepdim=True), way.norm(dim=-1), way.roll(-1, 2)
        follows = (way * after).sum(-1) >= math.cos(self.turn) * length * after.norm(dim=-1)
        apart = torch.cdist(place, place) + 2.0 * low * torch.eye(k).to(place) >= low
        fits = (follows & (length <= high) & apart.all(-1) & (place.norm(dim=-1) <= self.reach)).all(-1)
        fits[:, -1] = True
        chosen = torch.arange(n, device=place.device), fits.to(torch.uint8).argmax(1)
        along = normalize(way[chosen], dim=-1) + normalize(after[chosen], dim=-1)
        height = 0.5 * (uniform(n, k, 1) + 1.0) * (self.heights[1] - self.heights[0]) + self.heights[0]
        if len(self.heights) > 2:
            height = torch.tensor(self.heights).to(place).reshape(1, k, 1).expand(n, k, 1)
        half = 0.5 * (torch.atan2(along[..., 1], along[..., 0]) + self.yaw * uniform(n, k))
        none = torch.zeros_like(half)
        return torch.cat((place[chosen], height), -1), torch.stack((half.cos(), none, none, half.sin()), -1)


def load_track(track: str | Path | Mapping = "visfly", **settings: Any) -> dict[str, Any]:
    """Read a track: by name, from a file, or from a mapping.

    Files of these projects are known by what they hold: uzh-rpg's agile_flight (``position``, ``rotation`` and
    ``scale`` of gates by name) and rpg_time_optimal (points, ``initial`` and ``end``), utiasDSL's lsy_drone_racing
    (TOML), the ``track_config`` of isaac_drone_racer (``pos`` and ``yaw`` of gates by name), and flights of TII's
    drone racing dataset (CSV).

    Args:
        track: the name of one in the package, the path of a YAML or TOML file, or a mapping; one with ``file`` changes
            what that file says.
        **settings: what the file does not say, or says otherwise, named as on the page of :class:`RacingEnv`. Also
            ``axis``, "x", "-x", "y" or "-y", along which agile_flight's gates are flown, where their order does not
            show it; and ``lift`` [m], from ``pos`` of isaac_drone_racer up to the centre of the opening.

    Returns:
        ``gates``, points [m], or mappings with ``position`` [m], ``rotation`` (w, x, y, z), and ``width`` and
        ``height`` or ``radius`` [m]; ``starts``, a point before each [m]; ``gate_radius`` [m] of points; what else the
        track says; and ``notes`` on what was assumed of a file of another project.

    Raises:
        ValueError: a key is unknown or missing, or a value is not what :class:`RacingEnv` takes.
        FileNotFoundError: there is no such file.
    """
    source, values = _read(track, settings)
    values = own_format(source, values)
    if unknown := [key for key in values if key not in _PARTS]:
        other = " The help of load_track lists the other formats that it reads."
        more = "" if {"gates", "random"} & set(values) else other
        raise UserValueError(f"{source}: unknown key {shown(unknown[0])}. Allowed: {', '.join(_PARTS)}.{more}")
    found = {key: check_value(f"{source}: {key}", values[key], *_KEYS[key]) for key in _KEYS if key in values}
    found |= {key: values[key] for key in ("scene", "notes") if key in values}
    shape = {key: found.pop(key) for key in _OPENING if key in found}
    raw, floor = values.get("gates"), found.get("floor", 0.0)
    if "box" in values:
        found["box"] = _points(source, "box", values["box"], -1e4)
        if len(found["box"]) != 2 or not all(a < b for a, b in zip(*found["box"], strict=True)):
            raise UserValueError(f"{source}: box must be its lowest and its highest corner, [x, y, z] each.")
        if "floor" in found:
            raise UserValueError(f"{source}: floor has no effect beside box, whose lowest z it is. Leave floor out.")
        floor = found["box"][0][2]
    if "random" in values:
        course = _course(source, values["random"] or {}, found, floor)
        rules = {key: x for key, x in asdict(course).items() if key != "yaw" or "gate_radius" not in found}
        found |= {**shape, "random": rules}
        raw = _drawn(course, lambda *size: torch.zeros(size, dtype=torch.float64), found)
    directed = turned = None
    if any(isinstance(gate, Mapping) for gate in _rows(raw)):
        directed = _directed(source, _rows(raw), shape, "gate_radius" in found)
        raw, turned = ([gate[key] for gate in directed] for key in ("position", "rotation"))
        turned = torch.tensor(turned, dtype=torch.float64)
    elif _rows(raw) and (extra := [x for x in (*shape, "frame", "rotation_jitter") if x in {**shape, **found}]):
        raise UserValueError(f"{source}: {extra[0]} is of gates with a direction; these are points with a gate_radius.")
    gates = _points(source, "gates", raw, floor)
    if not 2 <= len(gates) <= MAX_GATES:
        raise UserValueError(f"{source}: a track has 2 to {MAX_GATES} gates, got {len(gates)}.")
    if directed:
        found["gates"] = [{**gate, "position": point} for gate, point in zip(directed, gates, strict=True)]
    else:
        found |= {"gates": gates, "gate_radius": float(found.get("gate_radius", 0.3))}
    before = found["gates"][-1:] if found.get("closed", True) else [None]
    if k := next((i for i, gate in enumerate(found["gates"], 1) if gate == [*before, *found["gates"]][i - 1]), 0):
        raise UserValueError(f"{source}: gates {k - 1 or len(gates)} and {k} are equal, and in a row. Leave one out.")
    usual = starts_before(torch.tensor(gates, dtype=torch.float64), turned, floor).tolist()
    found["starts"] = _points(source, "starts", values.get("starts", usual), floor)
    if (given := len(found["starts"])) != len(gates):
        raise UserValueError(f"{source}: there must be one start before each gate, got {given} for {len(gates)}.")
    if "start" in values:
        found["starts"][:1] = _points(source, "start", [values["start"]], floor)
    if "random" in values:
        stand = [gate.get("position") if isinstance(gate, Mapping) else gate for gate in _rows(values.get("gates"))]
        is_own = str(stand) == str(gates)  # what this function returned
        if "start" in values or (not is_own and {"gates", "starts"} & set(values)):
            raise UserValueError(f"{source}: random draws gates and their starts. Leave out gates, start and starts.")
    return found


def random_track(seed: int, **settings: Any) -> dict[str, Any]:
    """Draw a track for :class:`RacingEnv`. ``track="random"`` draws another in each episode, by the same rules.

    Args:
        seed: the same seed gives the same track.
        **settings: rules, as of :class:`~torchrl_quad.envs.track.Course`, and what else a track says, such as
            ``width`` and ``height``, 1.5 m each, ``radius``, or the ``gate_radius`` of spheres.

    Returns:
        as :func:`load_track`.

    Raises:
        ValueError: a setting is unknown or out of its range.
    """
    rules = {field.name: settings.pop(field.name) for field in fields(Course) if field.name in settings}
    track = load_track("random", random=rules, **settings)
    generator = torch.Generator().manual_seed(check_value("seed", seed, Seed))

    def uniform(*shape: int) -> Tensor:
        return 2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1.0

    gates = _drawn(Course(**track.pop("random")), uniform, track)
    return load_track({key: x for key, x in track.items() if key != "starts"} | {"gates": gates})


def _read(track: Any, settings: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """What a track says, with the settings that change it, and its name in errors."""
    values, source = dict(settings), "track"
    for _ in range(MAX_FILES):
        is_flight = isinstance(track, str | Path) and str(track).lower().endswith(".csv")
        source, said = (str(track), flown_track(Path(track))) if is_flight else presets.read("track", track, _TRACKS)
        replaced = {name for key in values for name in _REPLACES.get(key, ())}
        said = {key: x for key, x in said.items() if key not in replaced}
        if replaced.issuperset(_SIZES) and (gates := _rows(said.get("gates"))):
            own = (({k: x for k, x in g.items() if k not in _SIZES} if isinstance(g, Mapping) else g) for g in gates)
            said["gates"] = list(own)
        values = {**said, **values}
        if "file" not in values:
            return source, values
        track = values.pop("file")
    raise UserValueError(f"{source}: {MAX_FILES} tracks name each other as file; does one name itself?")


def starts_before(gates: Tensor, rotations: Tensor | None, floor: float) -> Tensor:
    """A start before each gate (*, k, 3) [m]: half way from the gate before; before a gate with a direction, against
    that, half as far away as the gate before, and at most 3 m."""
    before = gates.roll(1, -2)
    if rotations is None:
        return 0.5 * (before + gates)
    start = gates - (0.5 * (gates - before).norm(dim=-1, keepdim=True)).clamp_max(RUN_UP) * forward(rotations)
    return torch.cat((start[..., :2], start[..., 2:].clamp_min(floor + LOWEST_START)), -1)


def forward(rotations: Tensor) -> Tensor:
    """The direction (*, 3) in which gates with these rotations (*, 4) are flown."""
    return quaternion.rotate(rotations, 0.0 * rotations[..., 1:] + rotations.new_tensor([1.0, 0.0, 0.0]))


def _course(source: str, rules: Any, found: Mapping[str, Any], floor: float) -> Course:
    """The rules of a random track, inside its box."""
    if "gate_radius" in found and isinstance(rules, Mapping) and "yaw" in rules:
        raise UserValueError(f"{source}: random: yaw has no effect on gates that are spheres. Leave it out.")
    course = build(Course, f"{source}: random", rules)
    if "box" in found:
        sides = np.abs(found["box"])[:, :2] - np.array(found.get("position_jitter", (0.0, 0.0, 0.0)))[:2]
        reach = min(course.reach, max(0.0, float(sides.min())))
        course = build(Course, f"{source}: random", {**asdict(course), "reach": reach})
    if min(course.heights) <= floor:
        got = shown(course.heights)
        raise UserValueError(f"{source}: random: heights must be above the floor at {floor:g} m; got {got}.")
    return course


def _directed(source: str, raw: Sequence[Any], shape: Mapping[str, Any], has_radius: bool) -> list[dict[str, Any]]:
    """Gates with a direction, those that do not say how far they are open as far as all."""
    if not all(isinstance(gate, Mapping) for gate in raw):
        raise UserValueError(f"{source}: gates must be all points, or all mappings with a position and a yaw.")
    if has_radius:
        mend = "Give radius, or width and height."
        raise UserValueError(f"{source}: gate_radius is of gates that are points; these have a direction. {mend}")
    if shape and all(set(gate) & set(_OPENING) for gate in raw):
        what = f"each gate says how far it is open, so {', '.join(shape)} of the track has no effect"
        raise UserValueError(f"{source}: {what}. Leave it out.")
    raw = [{k: x.tolist() if isinstance(x, Tensor | np.ndarray) else x for k, x in gate.items()} for gate in raw]
    own = [gate if set(gate) & set(_OPENING) else {**gate, **shape} for gate in raw]
    gates = [build(Gate, f"{source}: gate {i}", gate).entries() for i, gate in enumerate(own, 1)]
    check_order(source, [gate["rotation"] for gate in gates])
    if len({"radius" in gate for gate in gates}) > 1:
        raise UserValueError(f"{source}: all gates have a width and a height, or all have a radius.")
    return gates


def _rows(gates: Any) -> Sequence[Any]:
    return gates if isinstance(gates, Sequence) and not isinstance(gates, str) else ()


def _drawn(course: Course, uniform: Callable[..., Tensor], track: Mapping[str, Any]) -> list[Any]:
    """The gates of a course as a track lists them, as points where it has a ``gate_radius``."""
    centres, rotations = course.draw(1, uniform)
    return centres[0].tolist() if "gate_radius" in track else posed(centres[0], rotations[0])


def _points(source: str, name: str, value: Any, floor: float) -> Any:
    try:
        points = presets.as_array(value.tolist() if isinstance(value, Tensor) else value)
    except (ValueError, RecursionError):
        points = np.zeros(0)
    is_list = points.ndim == 2 and points.shape[-1] == 3
    if not (is_list and (abs(points) < 1e4).all() and (points[..., -1] > floor).all()):
        where = "ground" if floor == 0.0 else f"the floor at {floor:g} m"
        raise UserValueError(
            f"{source}: {name} must be a list of points [x, y, z] in metres above {where}, within 10 km; got "
            f"{shown(value)}."
        )
    return points.tolist()
