"""Drones from files: our own, and those of other projects, with a name for every assumption."""

from __future__ import annotations

import os
import re
import textwrap
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_quad.dynamics import import_formats as formats
from torchrl_quad.dynamics.control import FlightController
from torchrl_quad.dynamics.gains import suggest_gains
from torchrl_quad.dynamics.import_formats import Found
from torchrl_quad.dynamics.import_mjcf import read_mjcf
from torchrl_quad.dynamics.import_models import read_model, read_tree
from torchrl_quad.dynamics.parameters import FIELDS, QuadrotorParams, read_drone, read_fields
from torchrl_quad.errors import DroneWarning, UserValueError, one_line, shown

CONVERT = {  # programs that write such files, and how to run them
    ".xacro": "Expand it first: xacro FILE.xacro > FILE.urdf.",
    ".py": "Of RotorPy, write the parameters as JSON first: "
    "json.dump(quad_params, file, default=lambda x: x.tolist()).",
}


def load_drone(
    drone: str | Path | Mapping = "visfly",
    dtype: torch.dtype = torch.float32,
    *,
    entry: str | None = None,
    **fields: Any,
) -> QuadrotorParams:
    """A preset by its name (:func:`available_drones`), a file by its path, or a mapping of fields to numbers.

    Args:
        drone: the file may be of another project, as in :func:`import_drone`. A warning names what is not read of it.
        dtype: of its tensors.
        entry: which drone, of a file that has several.
        **fields: of :class:`QuadrotorParams`, which count instead of those that the drone says.

    Raises:
        ValueError: the preset is unknown, a field is missing, unknown, of the wrong shape, or out of its range, or the
            dtype is none of floating point. What a file of another project lacks is named all at once.
        FileNotFoundError: the path does not exist.
    """
    source, kind, found, unread = _read(drone, entry, fields)
    found = _completed(source, kind, found, fields, unread, entry) if kind else found
    if unread:
        warnings.warn(f"{source} ({kind}){_left(unread)}. import_drone shows what is.", DroneWarning, stacklevel=2)
    return read_drone({k: v for k, (v, _) in found.items()} | fields, dtype, source)


def import_drone(path: str | Path, *, entry: str | None = None, **fields: Any) -> str:
    """The YAML of a drone from a file of another project, with comments on all that the file does not say.

    It reads URDF, with the attributes of gym-pybullet-drones or the motors of RotorS; SDF, with Gazebo's motors or
    without; MJCF, whose actuators push at sites, through MuJoCo; YAML of Flightmare, Agilicious, RotorS and OmniDrones;
    TOML of drone-models and Crazyflow; JSON of VisFly, of l2f, and of RotorPy's ``quad_params``. Frames become ours,
    and all links one rigid body with principal axes along x, y and z. Drag that grows with rotor speed is that at
    hover. Only gains and limits of the rates are chosen where nobody says them.

    Args:
        path: of that file.
        entry: which drone, of a file that has several.
        **fields: what the file does not say, in SI units, such as ``motor_time_constant=0.03``.

    Raises:
        ValueError: it cannot be read, or lacks fields that are not given; all of them are named.
        FileNotFoundError: the path does not exist.
    """
    if not Path(path).is_file():  # a preset is no file
        formats.read_text(Path(path))
    if unknown := [x for x in fields if x not in (*FIELDS, "motor_command")]:
        raise UserValueError(f"{shown(unknown[0])} is no field of a drone. Choose from: {', '.join(FIELDS)}.")
    source, kind, found, unread = _read(Path(path), entry, fields)
    if not kind:
        ours = f"{source} has fields of our own format, which load_drone reads, and no others that are known"
        raise UserValueError(f"{ours}. {formats.READABLE}")
    found = _completed(source, kind, found, fields, unread, entry)
    name = one_line(Path(path).name + (f", {entry}" if entry else ""))
    text = [f"Source: {name} ({kind})."] + ([f"Not read: {', '.join(map(one_line, unread))}."] if unread else [])
    lines = [line for x in text for line in textwrap.wrap(x, 120, initial_indent="# ", subsequent_indent="# ")]
    for field in (x for x in FIELDS if x in found):
        value, note = np.asarray(found[field][0], float), found[field][1]
        comment = "; ".join(x for x in (FIELDS[field]["unit"], note) if x)
        rows = value if value.ndim > 1 else [value]
        rows = [f"{x:.7g}" if x.ndim == 0 else f"[{', '.join(f'{y:.7g}' for y in x)}]" for x in rows]
        lines.append(f"{field}:{' ' + rows[0] if value.ndim < 2 else ''}{'  # ' + comment if comment else ''}")
        lines += [f"  - {row}" for row in rows] if value.ndim > 1 else []
    lines += [f"motor_command: {found['motor_command'][0]}"] if "motor_command" in found else []
    return "\n".join(lines) + "\n"


def _left(unread: Sequence[str]) -> str:
    return f"; not read: {one_line(', '.join(unread))}" if unread else ""


def _completed(
    source: str, kind: str, found: Found, fields: Mapping[str, Any], unread: Sequence[str], entry: str | None
) -> Found:
    """What a file and a user say, and what is ours; an error names all that is missing."""
    if "rotor_positions" in fields and "rotor_direction" not in fields:
        found = {k: x for k, x in found.items() if k != "rotor_direction"}  # of the file's places
    curve, slowest = (found.get(x, (None,))[0] for x in ("thrust_map", "rotor_speed_min"))
    if curve is not None and slowest is not None and curve[1] + 2.0 * curve[0] * slowest < 0.0:
        found = found | {"rotor_speed_min": (None, f"thrust falls with speed up to {-0.5 * curve[1] / curve[0]:.4g}")}
    known, found = found | formats.usable(fields), found | {k: (v, formats.GIVEN) for k, v in fields.items()}
    examples = _examples(known)
    if missing := [x for x in examples if found.get(x, (None,))[0] is None]:
        why = [f": {found[x][1]}" if x in found and found[x][1] else "" for x in missing]
        names = ", ".join(f"{x} [{FIELDS[x]['unit'] or '1'}]{y}" for x, y in zip(missing, why, strict=True))
        follow = [x for x in missing if x in found and found[x][1].startswith("it follows")]
        like = ", ".join(f"{x}={y}" for x, y in examples.items() if x in missing and x not in follow)
        like = f"entry={entry!r}, {like}" if entry is not None else like
        raise UserValueError(
            f"{source} ({kind}) does not say {names}{_left(unread)}. Give your own numbers, in SI units and our frame, "
            f"such as load_drone({source!r}, {like}), or the same as arguments of recipes/import_drone.py."
        )
    drags = [one_line(x) for x in unread if re.search("drag|aero", x) and "linear" not in x]
    ours = {
        "rotor_speed_min": (0.0, "assumed: rotors may stop"),
        "quadratic_drag": ([0.0] * 3, f"left out: {', '.join(drags)}" if drags else "not in the file"),
        "gravity": (9.81, "not in the file"),
    }
    found = ours | {k: v for k, v in found.items() if v[0] is not None}
    plain = {"rate_gain": [1.0] * 3, "rate_damping": [0.0] * 3, "max_thrust_to_weight": 1.5, "max_body_rate": [6.0] * 3}
    drone = read_drone(plain | {k: v for k, (v, _) in found.items()}, torch.float64, source)
    try:
        rotors = FlightController(drone)
    except UserValueError as error:
        raise UserValueError(str(error).replace("drone:", f"{source}:", 1)) from None
    most = (10.0 * rotors.reach().clamp(1.1, 5.0)).floor().item() / 10.0
    rates = rotors.spare_torque() / drone.inertia * torch.tensor([0.1, 0.1, 0.5])
    rates = (10.0 * rates.minimum(torch.tensor([6.0, 6.0, 2.0])).clamp_min(0.1)).floor() / 10.0
    found = {
        "max_body_rate": (rates, "chosen here: at most what hovering rotors reach in 0.1, 0.1, 0.5 s"),
        "max_thrust_to_weight": (most, "chosen here: at most what the rotors reach"),
    } | found
    gains = suggest_gains({k: v for k, (v, _) in found.items()})
    return {k: (v.numpy(), "chosen here: suggest_gains, for steps of 5 ms") for k, v in gains.items()} | found


def _examples(found: Found) -> dict[str, str]:
    """What could be given for each field: spins that alternate around the drone, and three times its weight."""
    mass, speed, places = (found.get(x, (None,))[0] for x in ("mass", "rotor_speed_max", "rotor_positions"))
    n, spin, arm = 4, "[1, -1, 1, -1]", 0.14
    if places is not None:
        around = np.arctan2(*np.asarray(places, float).T[1::-1]).argsort().argsort()
        n, spin = len(around), str([1 - 2 * int(k % 2) for k in around])
        arm = np.linalg.norm(np.asarray(places, float)[:, :2], axis=1).max()
    usual = ((mass, 0.5), (speed, 1500.0))
    heavy, fast = (float(np.max(x)) if isinstance(x, float | int | np.ndarray) else y for x, y in usual)
    force, curve = 3.0 * 9.81 * heavy / n, found.get("thrust_map", (None,))[0]
    axes = re.search(r"beside (\[.*?\])", found.get("inertia", (None, ""))[1])  # whose products are not small
    examples = {  # of what nobody can guess
        "mass": "0.5",
        "inertia": axes[1] if axes else str([float(f"{share * heavy * arm**2:.2g}") for share in (0.3, 0.3, 0.5)]),
        "rotor_positions": "[[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]]",
        "rotor_spin": spin,
        "yaw_torque_coefficient": "0.016",
        "thrust_map": f"[{force / max(fast, 1.0) ** 2:.2g}, 0, 0]",
        "rotor_speed_max": "1500" if curve is None else f"{formats.speed_at(force, curve):.4g}",
        "motor_time_constant": "0.03",
        "linear_drag": str([float(f"{0.3 * heavy:.2g}")] * 3),
    }
    if curve is not None and curve[1] < 0.0 < curve[0]:  # thrust falls at first, so that rotors must not stand
        examples["rotor_speed_min"] = f"{-0.55 * curve[1] / curve[0]:.3g}"  # a tenth beyond the lowest thrust
    if "rotor_direction" in found and found["rotor_direction"][0] is None:
        examples["rotor_direction"] = str([[0, 0, 1]] * n)
    return {name: example.replace(" ", "") for name, example in examples.items()}  # one word of a command line


def _read(drone: Any, entry: str | None, fields: Mapping[str, Any]) -> tuple[str, str, Found, list[str]]:
    """Of a drone: its source, the kind of file if it is no drone of ours, what it says, and what of it was not read."""
    suffix = Path(drone).suffix.lower() if isinstance(drone, str | Path) else ""
    if suffix in CONVERT:
        why = f"a {suffix} file has to be run before its numbers can be read"
        raise UserValueError(f"{drone}: {why}. {CONVERT[suffix]}")
    if suffix in (".urdf", ".sdf", ".world", ".xml", ".jinja"):
        if entry is not None:
            raise UserValueError(f"{drone} holds one drone. Leave out entry={shown(entry)}.")
        root = read_tree(Path(drone))
        if root.tag == "mujoco":
            return read_mjcf(Path(drone), formats.usable(fields))
        return read_model(root, Path(drone), formats.usable(fields))
    if suffix == ".json":
        source, data = str(drone), formats.read_json(Path(drone))
        data = data if isinstance(data, Mapping) else {}
    elif suffix not in ("", ".yaml", ".yml", ".toml") and os.path.isfile(drone):
        raise UserValueError(f"{drone}: no drone can be read from a {suffix} file. {formats.READABLE}")
    else:
        source, data = read_fields(drone)
    drones = {
        str(name): (kind, reader, part)
        for name, part in {"": data, **data}.items()
        for kind, (reader, *keys) in formats.MAPPINGS.items()
        if isinstance(part, Mapping) and any(key in part for key in keys)
    }
    if entry is not None and not drones:
        raise UserValueError(f"{source}: has no drones by name. Leave out entry={shown(entry)}.")
    if (entry is None and len(drones) > 1) or (entry is not None and entry not in drones):
        names = f"entry={next(iter(drones))!r} or another of {shown(list(drones))}"
        raise UserValueError(f"{source}: choose one drone of the file, by {names}; got {shown(entry)}.")
    own = set(FIELDS) & set(data)
    own = own if own - {"mass", "inertia", "gravity"} or (own and own == set(data)) else set()  # others, too, say these
    if any(isinstance(part, Mapping) and "rpy_coef" in part for part in (data, *data.values())):
        raise UserValueError(
            f"{source}: a model fitted to attitude commands (so_rpy of drone-models) has no rotors. Give the "
            "params.toml that has them, with mass and rpm2thrust."
        )
    if not drones and not isinstance(drone, Mapping) and not (own and 2 * len(own) > len(data)):
        raise UserValueError(f"{source}: this file is of no kind that is known. {formats.READABLE}")
    if not drones:
        return source, "", {k: (v, "") for k, v in data.items()}, []
    kind, reader, part = drones[entry] if entry is not None else next(iter(drones.values()))
    said = formats.Said(part, source, formats.usable(fields))
    found = reader(said)
    return source, kind, found, [*said.unread]
