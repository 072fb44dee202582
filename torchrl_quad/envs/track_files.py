"""Tracks in the formats of other projects, as mappings in our own."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.dynamics.presets import as_array
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.rotations import from_euler, multiply, rotate

BELOW = 4.0  # [m], from the lowest gate down to the end of the box, where gates are below z = 0
_YAWS = {"x": 0.0, "y": 0.5 * math.pi, "-x": math.pi, "-y": -0.5 * math.pi}
AXES = {name: from_euler(np.array([0.0, 0.0, yaw])) for name, yaw in _YAWS.items()}  # what turns the x axis there
# Of lsy_drone_racing, in the comments of its files: "0.72m wide (outer dimensions of the frame) with a 0.4m wide
# opening", and obstacles are "cylinders with a diameter of 0.03m", whose position is that of their top. In its first
# versions the bars of gates are 0.09 m wide, and gates are flown along y.
LSY_OPENING, LSY_FRAMES, LSY_POLE = 0.4, {"x": 0.16, "y": 0.09}, 0.015
LSY_RUN_UP = 0.25  # [m], from a start to its gate, before which poles stand


def own_format(source: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """A track in our own format, from that of any project that is known.

    Raises:
        UserValueError: what a file must say is missing, or not of the right form.
    """
    values = dict(values)
    if isinstance(values.get("track_config"), Mapping):  # of isaac_drone_racer
        values = {**values.pop("track_config"), **values}
    gates = values.get("gates")
    by_name = gates if isinstance(gates, Mapping) else values
    named = {name: x for name, x in by_name.items() if isinstance(x, Mapping) and name not in ("scene", "random")}
    try:
        if isinstance(values.get("env"), Mapping):
            return lsy_drone_racing(source, values)
        if named and isinstance(gates, Mapping) and all({"position", "rotation"} <= set(x) for x in named.values()):
            return agile_flight(source, values, _in_order(named))
        if named and all({"pos", "yaw"} <= set(gate) for gate in named.values()):
            return isaac_drone_racer(source, {k: x for k, x in values.items() if k not in named}, _in_order(named))
        if {"initial", "end", "ring"} & set(values):
            return time_optimal(source, values)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        if isinstance(error, UserValueError):
            raise
        why = f"it does not say {error}" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
        raise UserValueError(f"{source}: cannot be read as a track of another project: {why}.") from error
    if isinstance(gates, Mapping):
        raise UserValueError(
            f"{source}: its gates have names, and {shown(gates)} is of no format that is known. Write gates as a list "
            "of points, or of mappings with position, yaw, width and height; load_track names the formats it reads."
        )
    return values


def agile_flight(source: str, values: dict[str, Any], gates: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Of uzh-rpg/agile_flight: gates by name, the drone's start, and the goal. ``scale`` has no unit, and is not read.

    The axis of gates along which they are flown differs from file to file.
    """
    centres, rotations = (as_array([gate[key] for gate in gates]) for key in ("position", "rotation"))
    if missing := [key for key in ("start_pos", "goal_pos") if key not in values]:
        raise UserValueError(f"{source}: does not say {missing[0]}. Give load_track(..., {missing[0]}=[x, y, z]).")
    start, goal = as_array(values["start_pos"]), as_array(values["goal_pos"])
    is_lap = np.linalg.norm(goal - centres[0]) < np.linalg.norm(goal - centres[-1])
    check_order(source, rotations)
    axis = _axis(source, values.get("axis"), start, centres, rotations, is_lap)
    notes = [
        f"gates are flown along their {axis} axis",
        "a lap: the goal is nearer to the first gate" if is_lap else "no lap: the goal is nearer to the last gate",
        "scale and uncertainty are not read",
    ]
    turned, floor = multiply(rotations, AXES[axis]), {}
    if centres[:, 2].min() <= 0.0 and "box" not in values:
        floor["floor"] = float(centres[:, 2].min()) - BELOW
        notes.append(f"gates are below z = 0: the floor is {BELOW:g} m below the lowest")
    own = {key: x for key, x in values.items() if key not in ("start_pos", "goal_pos", "render_offset", "axis")}
    found = {**floor, "closed": bool(is_lap), "start": start.tolist(), **own}
    return {**found, "gates": posed(centres, turned), "notes": notes}


def _axis(source: str, axis: Any, start: Any, centres: Any, rotations: Any, is_lap: Any, known: Any = AXES) -> str:
    """The axis of gates along which each is flown in their order, on the ways to it and from it together."""
    path = np.vstack((start, centres, centres[:1] if is_lap else centres[-1:]))
    ways = np.diff(path, axis=0)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True).clip(1e-9)
    flown = {name: rotate(multiply(rotations, AXES[name]), [1.0, 0.0, 0.0]) for name in known}
    fit = [name for name, along in flown.items() if ((ways[:-1] + ways[1:]) * along).sum(1).min() > 1e-3]
    if axis is None and len(fit) != 1:
        raise UserValueError(
            f"{source}: its gates are flown along one of their axes, and their order does not show which. Give axis="
            f"{' or '.join(map(repr, known))}. Rotations are read as w, x, y, z, or as roll, pitch and yaw."
        )
    if axis is not None and axis not in [*known]:
        raise UserValueError(f"{source}: axis must be one of {', '.join(known)}; got {shown(axis)}.")
    return axis or fit[0]


def time_optimal(source: str, values: dict[str, Any]) -> dict[str, Any]:
    """Of uzh-rpg/rpg_time_optimal: points, from ``initial`` to ``end``; several rounds stand there one by one."""
    if "gate_radius" not in values:
        raise UserValueError(f"{source}: how near to a gate counts is not said. Give gate_radius [m].")
    own = {key: x for key, x in values.items() if key not in ("initial", "end", "ring")}
    points = as_array(values["gates"]).tolist()
    if end := (values.get("end") or {}).get("position"):
        points.append(as_array(end).tolist())
    rounds = (k for k in range(2, len(points) // 2 + 1) if points[k:] == points[:-k])
    lap = next(rounds, None)
    closed = bool(values.get("ring", False)) or lap is not None
    notes = [f"the gates repeat: a lap of {lap}"] if lap else ["a ring" if closed else "no lap: end is the last gate"]
    if start := (values.get("initial") or {}).get("position"):
        own.setdefault("start", as_array(start).tolist())
    return {"closed": closed, **own, "gates": points[:lap], "notes": [*notes, "only positions of the ends are read"]}


def lsy_drone_racing(source: str, values: dict[str, Any]) -> dict[str, Any]:
    """Of utiasDSL/lsy_drone_racing: gates, flown along their x axis, in the first versions along y; poles; and how both
    are drawn."""
    track = values["env"]["track"]
    centres, angles = (as_array([gate[name] for gate in track["gates"]]) for name in ("pos", "rpy"))
    drones = track["drones"] if "drones" in track else [track["drone"]]  # in the first versions
    if not len(centres) or abs(angles).max() > 2.0 * math.pi:
        raise UserValueError(f"{source}: needs gates, whose rpy is in radians; got {shown(angles.tolist())}.")
    start, limits = as_array(drones[0]["pos"]).tolist(), track.get("safety_limits")
    if limits is None and "box" not in values:
        raise UserValueError(
            f"{source}: does not say safety_limits. Give box=[[x, y, z], [x, y, z]], the least and the greatest [m]."
        )
    box = values.get("box") or [limits["pos_limit_low"], limits["pos_limit_high"]]
    box = as_array(box).tolist()
    given = {key: x for key, x in values.items() if key not in ("controller", "deploy", "sim", "env", "axis")}
    order = track.get("gate_order") or [*range(1, len(centres) + 1)]
    gates = [abs(x) - 1 for x in order]
    if any(x not in range(len(centres)) for x in gates):
        raise UserValueError(f"{source}: gate_order names gates from 1 to {len(centres)}; got {shown(order)}.")
    centres, rotations = centres[gates], from_euler(angles)[gates]
    back = from_euler(np.array([0.0, 0.0, math.pi]))  # a negative number is a gate that is flown backwards
    rotations = np.where(np.array(order)[:, None] < 0, multiply(rotations, back), rotations)
    of_today = limits is not None or "gate_order" in track
    axis = values.get("axis") or ("x" if of_today else None)
    axis = _axis(source, axis, start, centres, rotations, False, LSY_FRAMES)
    rotations, size = multiply(rotations, AXES[axis]), track.get("gate_size") or {}
    own = {"width": size.get("width", LSY_OPENING), "height": size.get("height", LSY_OPENING)}
    own |= {"frame": LSY_FRAMES[axis], "closed": False, "box": box, "start_range": 0.05, **given}
    notes = [
        f"gates are flown along their {axis} axis",
        f"they are open {shown(own['width'])} x {shown(own['height'])} m, with frames of {shown(own['frame'])} m",
        "the drone hovers above its start; drone, sensors and disturbances are not read",
    ]
    notes += [f"{len(drones)} drones race there: the first is read"] if len(drones) > 1 else []
    own["notes"] = notes
    if track.get("randomize", False) or "random" in values:  # of positions it says nothing but the limits
        low, high = box
        reach = min(high[i] - low[i] for i in (0, 1)) / 2.0
        rules = {"gates": len(centres), "spacing": [1.0, 1.1 * reach], "heights": centres[:, 2].tolist()}
        own["random"] = {**rules, "turn": 2.2, "yaw": 0.75, **(values.get("random") or {})}
        notes.append("gates stand anew in each episode, by the rules of random tracks; no poles")
        return own
    spreads = values["env"].get("randomizations") or values["env"].get("randomization") or {}
    drawn = {x: _spread(source, spreads[x]) for x in ("gate_pos", "gate_rpy", "obstacle_pos") if x in spreads}
    if len(set(gates)) < len(gates) and {"gate_pos", "gate_rpy"} & drawn.keys():
        raise UserValueError(
            f"{source}: its gate_order passes a gate twice, and gates are moved at random, each passage by itself. "
            "Take the randomizations out."
        )
    middle, spread = drawn.get("gate_pos", (np.zeros(3), None))
    centres = centres + middle
    own["gates"] = posed(centres, rotations)
    before = (centres - LSY_RUN_UP * rotate(rotations, [1.0, 0.0, 0.0])).tolist()
    own |= {"position_jitter": spread.tolist()} if spread is not None else {}
    if "gate_rpy" in drawn:  # about the file's axes
        roll, pitch, yaw = drawn["gate_rpy"][1].tolist()
        own["rotation_jitter"] = [roll, pitch, yaw] if axis == "x" else [pitch, roll, yaw]
    if "gates" not in given:
        own["starts"] = [[*start[:2], max(start[2], box[0][2] + 0.25)], *before[1:]]
    notes.append("poles are 0.03 m thick, and end at their position")
    tops = as_array([pole["pos"] for pole in track.get("obstacles", [])]).reshape(-1, 3)
    middle, spread = drawn.get("obstacle_pos", (np.zeros(3), np.zeros(3)))
    low, high = (np.c_[tops[:, :2] + middle[:2] + sign * spread[:2], 0.0 * tops[:, 2]].tolist() for sign in (-1, 1))
    poles = [{"radius": LSY_POLE, "height": z} for z in tops[:, 2].tolist()]
    for pole, z, least, most in zip(poles, tops[:, 2] + middle[2], low, high, strict=True):
        ends = {"count": 1, "low": least, "high": most, "height": [float(z - spread[2]), float(z + spread[2])]}
        pole |= ends if spread.any() else {"base": least}
    return {**own, **({"scene": {"cylinders": poles}} if poles else {}), **given}


def isaac_drone_racer(source: str, values: dict[str, Any], gates: list[Mapping[str, Any]]) -> dict[str, Any]:
    """The ``track_config`` of kousheekc/isaac_drone_racer: positions of its gates' models, flown along their x axis."""
    if "lift" not in values:
        raise UserValueError(f"{source}: how high above pos its gates are open is not said. Give lift [m].")
    own = {key: x for key, x in values.items() if key not in ("lift", "gates")}
    listed = [{"position": [*gate["pos"][:2], gate["pos"][2] + values["lift"]], "yaw": gate["yaw"]} for gate in gates]
    return {**own, "gates": listed, "notes": ["gates are flown along their x axis, and round after round"]}


def flown_track(path: Path) -> dict[str, Any]:
    """Of TII's drone racing dataset (Bosello et al. 2024, arXiv:2311.02667), from a flight's CSV: it has the inner
    corners of the gates, and the drone's path shows their order, their directions, and when a lap repeats."""
    if not path.is_file():
        raise FileNotFoundError(f"No flight at {path}. Give the path of a ..._500hz_freq_sync.csv that exists.")
    axes, rows = "xyz", []
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        reader = csv.DictReader(file)
        has = set(reader.fieldnames or ())
        count = next(k for k in range(100) if f"gate{k + 1}_marker1_x" not in has)
        corners = [f"gate{i + 1}_marker{j + 1}_{axis}" for i in range(count) for j in range(4) for axis in axes]
        wanted = [*(f"drone_{axis}" for axis in axes), *corners]
        if lacking := [name for name in (*wanted, *([] if count else ["gate1_marker1_x"])) if name not in has]:
            raise UserValueError(
                f"{path}: a CSV is read as a flight of TII's drone racing dataset, and has no column {lacking[0]}. "
                "Write your own track in YAML: gates, a list of [x, y, z]."
            )
        for row in reader:
            try:
                rows.append([float(row[name] or "nan") for name in wanted])
            except ValueError as error:
                raise UserValueError(f"{path}, line {reader.line_num}: {error}. Leave out this row.") from None
    table = np.array(rows).reshape(-1, len(wanted))
    flown = table[np.isfinite(table[:, :3]).all(1), :3]
    if len(flown) < 2 or not np.isfinite(table[:, 3:]).any(0).all():
        raise UserValueError(f"{path}: the drone or a corner of a gate was never seen.")
    passed: list[tuple[float, dict[str, Any]]] = []  # when, and the gate as it was flown
    for corner in np.nanmedian(table[:, 3:], 0).reshape(count, 4, 3):
        centre = corner.mean(0)
        ahead = np.linalg.svd(corner - centre)[2][2]  # what the corners' plane is normal to
        left = np.cross([0.0, 0.0, 1.0], ahead)
        left /= np.linalg.norm(left).clip(1e-9)
        within = np.stack((left, np.cross(ahead, left)), 1)
        half = np.abs((corner - centre) @ within).mean(0)
        width, height = (2.0 * half).tolist()
        place = {"position": centre.tolist(), "width": width, "height": height}
        side = (flown - centre) @ ahead
        for k in np.flatnonzero((side[:-1] < 0.0) != (side[1:] < 0.0)):
            share = side[k] / (side[k] - side[k + 1])
            if (np.abs((flown[k] + share * (flown[k + 1] - flown[k]) - centre) @ within) < half).all():
                x, y, z = ahead if side[k] < 0.0 else -ahead
                passed.append((k + share, {**place, "yaw": math.atan2(y, x), "pitch": math.asin(z)}))
    order = [gate for _, gate in sorted(passed, key=lambda x: x[0])]
    enough = range(2, len(order) - len(order) // 3)  # half a lap, at least, must come again
    lap = next((k for k in enough if order[k:] == order[:-k]), None)
    if lap is None:
        raise UserValueError(f"{path}: the drone passed {len(order)} gates, and no lap twice. Give a longer flight.")
    notes = [f"a lap of {lap} gates, flown {len(order) / lap:.1f} times", "openings lie between the inner corners"]
    return {"gates": order[:lap], "closed": True, "notes": [*notes, "gates stand where they were seen in the median"]}


def check_order(source: str, rotations: Any) -> None:
    """Refuse rotations (k, 4) of gates that all stand upright as x, y, z, w, and lie or lean as w, x, y, z."""
    read, other = (rotate(q, [0.0, 0.0, 1.0])[:, 2] for q in (rotations, np.roll(rotations, 1, 1)))  # 1: upright
    if (other > 0.999).all() and (abs(read) < 0.9).any():  # -1: an opening upside down
        raise UserValueError(
            f"{source}: its gates lie or lean if rotations are w, x, y, z, and all stand upright if they are x, y, z, "
            "w. Write w first."
        )


def posed(centres: Any, rotations: Any) -> list[dict[str, Any]]:
    """Gates as a track lists them, of centres (k, 3) [m] and rotations (k, 4)."""
    return [{"position": p, "rotation": q} for p, q in zip(centres.tolist(), rotations.tolist(), strict=True)]


def _in_order(gates: Mapping[str, Mapping]) -> list[Mapping[str, Any]]:
    """Gates by the number in their name: Gate10 comes after Gate2."""
    numbers = {name: re.findall(r"\d+", str(name)) for name in gates}
    if unnumbered := [name for name, found in numbers.items() if not found]:
        raise UserValueError(f"The name of gate {shown(unnumbered[0])} has no number. Number them in order.")
    return [gates[name] for name in sorted(gates, key=lambda name: int(numbers[name][-1]))]


def _spread(source: str, spec: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The middle of what is drawn uniformly, and how far it goes to both sides."""
    law = spec["fn"] if "fn" in spec else spec["type"]  # in the first versions
    if law != "uniform":
        raise UserValueError(f"{source}: what is drawn must be uniform; got {shown(law)}.")
    ends = (spec["kwargs"]["minval"], spec["kwargs"]["maxval"]) if "kwargs" in spec else (spec["low"], spec["high"])
    low, high = (as_array(x) + np.zeros(3) for x in ends)
    return 0.5 * (low + high), 0.5 * (high - low)
