"""Drones from files of any kind: our own, and those of other projects, of which every assumption is named."""

from __future__ import annotations

import json
import math
import re
import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_quad.dynamics import presets
from torchrl_quad.dynamics.control import FlightController
from torchrl_quad.dynamics.gains import suggest_gains
from torchrl_quad.dynamics.parameters import FIELDS, QuadrotorParams, read_drone, read_fields
from torchrl_quad.errors import UserValueError, one_line, shown

Array = NDArray[np.float64]
Found = dict[str, tuple[Any, str]]  # of a field: its value, and what there is to say of it
RPM = math.pi / 30.0  # [rad/s]
READS = (
    "URDF, SDF, YAML of Flightmare and Agilicious, TOML of drone-models and Crazyflow, JSON of l2f (rl-tools) and of "
    "RotorPy's quad_params, and our own YAML or TOML"
)
CONVERT = {  # what is a program that writes such a file, and how to run it
    ".xacro": "Expand it first, by xacro FILE.xacro > FILE.urdf.",
    ".jinja": "Let its project write the .sdf first.",
    ".py": "For RotorPy, write its parameters as JSON first: json.dump(quad_params, file, default=list).",
}
ASKED = {  # what no drone flies without and nobody can guess, as a user could give it
    "mass": "0.5",
    "inertia": "[2e-3, 2e-3, 4e-3]",
    "rotor_positions": "[[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]]",
    "rotor_spin": "[1, -1, 1, -1]",
    "yaw_torque_coefficient": "0.016",
    "thrust_map": "[2e-6, 0, 0]",
    "rotor_speed_max": "1500",
    "motor_time_constant": "0.03",
    "linear_drag": "[0.1, 0.1, 0.1]",
}


def load_drone(
    drone: str | Path | Mapping = "visfly", dtype: torch.dtype = torch.float32, *, entry: str | None = None, **fields: Any
) -> QuadrotorParams:
    """A preset by its name (:func:`available_drones`), a file by its path, or a mapping of fields to numbers.

    Args:
        drone: a YAML file of ours, or a file of another project as in :func:`import_drone`, for example.
        dtype: of its tensors.
        entry: which drone of a file that has several.
        **fields: fields of :class:`QuadrotorParams` that count instead of, or beside, what the drone says.

    Raises:
        ValueError: the preset is unknown, a field is missing, unknown, of the wrong shape, or out of its range, or the
            dtype is none of floating point. All that a file of another project lacks is named at once.
        FileNotFoundError: the path does not exist.
    """
    source, kind, found, _ = _read(drone, entry)
    if kind:
        found = _completed(source, kind, found, fields)
    return read_drone({k: v for k, (v, _) in found.items()} | fields, dtype, source)


def import_drone(path: str | Path, *, entry: str | None = None, **fields: Any) -> str:
    """The YAML of a drone from a file of another project, with comments on what is not from that file.

    It reads URDF, with the attributes of gym-pybullet-drones or the motors of RotorS; SDF, with Gazebo's motors or
    without; YAML of Flightmare and Agilicious; TOML of drone-models and Crazyflow; JSON of l2f, and of RotorPy's
    ``quad_params``. Frames become ours. All links count as one rigid body, with its principal axes along x, y and z.

    Args:
        path: of that file.
        entry: which drone of a file that has several.
        **fields: what the file does not say, in SI units, such as ``motor_time_constant=0.03``. Only gains and limits
            of the rates are chosen where nobody says them (:func:`suggest_gains`).

    Raises:
        ValueError: it cannot be read, or lacks fields that are not given; all of them are named.
        FileNotFoundError: the path does not exist.
    """
    source, kind, found, unread = _read(Path(path), entry)
    if not kind:
        raise UserValueError(f"{source} is a drone of ours already: load_drone reads it as it is. {_readable()}")
    found = _completed(source, kind, found, fields)
    read_drone({k: v for k, (v, _) in found.items()}, source=source)  # which refuses what cannot be
    name = f"{Path(path).name}, {entry}" if entry else Path(path).name
    lines = [f"# Source: {one_line(name)} ({kind})."]
    if unread:
        lines += textwrap.wrap(f"Not read: {', '.join(map(one_line, unread))}.", 118, initial_indent="# ", subsequent_indent="#   ")
    for field in (x for x in FIELDS if x in found):
        value, note = np.asarray(found[field][0], float), "; ".join(x for x in (FIELDS[field]["unit"], found[field][1]) if x)
        text = "\n".join(["", *(f"  - {_flow(row)}" for row in value)]) if value.ndim > 1 else f" {_flow(value)}"
        head, *rest = text.split("\n")
        lines.append("\n".join([f"{field}:{head}{'  # ' * bool(note)}{note}", *rest]))
    return "\n".join(lines) + "\n"


def _flow(value: Array) -> str:
    return f"{value:.7g}" if value.ndim == 0 else f"[{', '.join(f'{x:.7g}' for x in value)}]"


def _readable() -> str:
    return f"These can be read: {READS}."


# -- what no file says -------------------------------------------------------------------------------------------------


def _completed(source: str, kind: str, found: Found, fields: Mapping[str, Any]) -> Found:
    """What a file and a user say, and what is ours; an error names all that is still missing."""
    found = found | {k: (v, "given, not in the file") for k, v in fields.items()}
    if missing := [name for name in ASKED if name not in found or found[name][0] is None]:
        why = (f" ({found[x][1]})" if x in found else "" for x in missing)
        names = ", ".join(f"{x} [{FIELDS[x]['unit'] or '1'}]{y}" for x, y in zip(missing, why, strict=True))
        like = ", ".join(f"{x}={ASKED[x]}" for x in missing)
        raise UserValueError(
            f"{source} ({kind}) does not say: {names}. Give your own numbers, in SI units and our frames, as in "
            f"load_drone({source!r}, {like}), or as arguments of recipes/import_drone.py."
        )
    ours = {
        "rotor_speed_min": (0.0, "assumed: rotors may stop"),
        "quadratic_drag": ([0.0] * 3, "not in the file"),
        "gravity": (9.81, "of the Earth, not in the file"),
    }
    found = {**ours, **found}
    plain = {"rate_gain": [1.0] * 3, "rate_damping": [0.0] * 3, "max_thrust_to_weight": 1.5, "max_body_rate": [6.0] * 3}
    drone = read_drone(plain | {k: v for k, (v, _) in found.items()}, torch.float64, source)
    rotors = FlightController(drone)
    most = (rotors.middle + rotors.half_span) / (drone.mass * drone.gravity)
    reached = rotors.spare_torque() / drone.inertia * torch.tensor([0.1, 0.1, 0.5])  # within as many seconds
    rates = reached.minimum(torch.tensor([6.0, 6.0, 2.0])).clamp_min(0.1)
    limits = {
        "max_body_rate": ((rates * 10.0).floor() / 10.0, "chosen here: 6, 6, 2, or what takes 0.1 s, 0.1 s, 0.5 s from hover"),
        "max_thrust_to_weight": (most.clamp(1.1, 5.0).mul(10.0).floor().item() / 10.0, "chosen here: 5, or what the rotors reach"),
    }
    found = {**limits, **found}
    gains = suggest_gains({k: v for k, (v, _) in found.items()})
    chosen = {k: (v.numpy(), "chosen here, by suggest_gains for steps of 5 ms") for k, v in gains.items()}
    return {**chosen, **found}


# -- files -------------------------------------------------------------------------------------------------------------


def _read(drone: Any, entry: str | None) -> tuple[str, str, Found, list[str]]:
    """Of a drone: its source, the kind of file if it is no drone of ours, what it says, and what of it was not read."""
    suffix = Path(drone).suffix.lower() if isinstance(drone, str | Path) else ""
    if suffix in CONVERT:
        raise UserValueError(f"{drone}: a {suffix} file has to run before anybody can read it. {CONVERT[suffix]}")
    if suffix in (".urdf", ".sdf", ".xml"):
        path = Path(drone)
        root = _xml(path)
        said = _urdf(root, str(path)) if root.tag == "robot" else _sdf(root, path) if root.tag in ("sdf", "model") else None
        if said is None:
            raise UserValueError(f"{path}: XML with the root <{one_line(root.tag)}> is no URDF or SDF. {_readable()}")
        return str(path), "URDF" if root.tag == "robot" else "SDF", said, []
    if suffix == ".json":
        source, text = str(drone), _text(Path(drone))
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise UserValueError(f"{source}: not a JSON file: {one_line(error)}.") from None
    elif isinstance(drone, Path) and suffix not in ("", ".yaml", ".yml", ".toml"):
        raise UserValueError(f"{drone}: no drone can be read from a {suffix} file. {_readable()}")
    else:
        source, data = read_fields(drone)
    kinds = [(kind, reader, keys) for kind, (reader, *keys) in MAPPINGS.items()]
    parts = {"": data, **data} if isinstance(data, Mapping) else {}
    drones = {
        name: (kind, reader, part)
        for name, part in parts.items()
        for kind, reader, keys in kinds
        if isinstance(part, Mapping) and any(key in part for key in keys)
    }
    if suffix == ".json" and not drones:
        raise UserValueError(f"{source}: this JSON is of none of the kinds that are known. {_readable()}")
    if not drones:
        return source, "", {k: (v, "") for k, v in data.items()}, []
    if (entry is None and len(drones) > 1) or (entry is not None and entry not in drones):
        raise UserValueError(f"{source} has several drones. Choose by entry, from: {', '.join(drones)}. Got {entry!r}.")
    kind, reader, part = drones[entry if entry is not None else next(iter(drones))]
    said = Said(part, source)
    found = {k: v for k, v in reader(said).items() if v[0] is not None or v[1]}
    return source, kind, found, [str(key) for key in part if key not in said.asked]


def _text(path: Path) -> str:
    if not path.is_file():  # which a pipe or a device is not, whose reading may never end
        raise FileNotFoundError(f"No drone file at {path}. Give the path of a file that exists.")
    with path.open("rb") as file:
        content = file.read(presets.MAX_BYTES + 1)
    if len(content) > presets.MAX_BYTES:
        raise UserValueError(f"{path}: has more than {presets.MAX_BYTES:,} bytes. A drone needs less.")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise UserValueError(f"{path}: not in UTF-8 (byte {error.start}). Save it as UTF-8.") from None


class Said:
    """The numbers of a mapping, by name; it keeps account of what was asked for."""

    def __init__(self, data: Mapping[str, Any], source: str) -> None:
        self.data, self.source, self.asked = data, source, set[str]()

    def __call__(self, name: str, *shape: int | None) -> Any:
        """An array of this shape, in which None is any length, or None if the mapping has no such name."""
        self.asked.add(name)
        if (value := self.data.get(name)) is None:
            return None
        if isinstance(value, Mapping):  # of rotors: r1, r2, ...
            value = list(value.values())
        try:
            value = presets.as_array(value)
        except (ValueError, RecursionError) as error:
            raise UserValueError(f"{self.source}: {name!r}: {one_line(error)}.") from None
        if value.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, value.shape, strict=True)):
            want = ", ".join("n" if n is None else str(n) for n in shape)
            raise UserValueError(f"{self.source}: {name!r} has shape {value.shape}; it must be ({want}).")
        return value


def _placed(positions: Any, directions: Any, note: str = "") -> Found:
    """Where rotors (n, 3) are, and where they point if they are tilted; of upright ones the height does not count."""
    if positions is None:
        return {}
    tilted = directions is not None and not np.allclose(directions[:, :2], 0.0, atol=1e-6)
    found: Found = {"rotor_positions": (positions if tilted else positions[:, :2], note)}
    return found | ({"rotor_direction": (directions, "")} if tilted else {})


def _inertia(matrix: Any, note: str = "") -> Found:
    """The diagonal of an inertia (3, 3), if its axes are nearly the principal ones."""
    if matrix is None:
        return {}
    diagonal = np.diag(matrix)
    products = abs(matrix - np.diag(diagonal)).max()
    products = products if products > 1e-6 * diagonal.min() else 0.0  # rounding
    if products > 0.05 * diagonal.min():
        return {"inertia": (None, f"its products of inertia, of {products:.3g} kg m2, are no small ones: give principal axes")}
    left = f"products of inertia up to {products:.2g} kg m2 left out" if products > 0.0 else ""
    return {"inertia": (diagonal, "; ".join(x for x in (note, left) if x))}


def _same(values: Any, what: str) -> tuple[Any, str]:
    """The one value that all rotors have; None, with a reason, if they differ."""
    values = np.asarray(values, float)
    same = np.allclose(values, values[:1], rtol=1e-6, atol=0.0)
    return (values[0], "") if same else (None, f"its rotors differ in {what}, and here they are all alike")


def _hover_speed(mass: Any, thrust: Any, n: int) -> Any:
    """Of n rotors with this thrust map [rad/s]; None if something is not said."""
    if mass is None or thrust is None or not n or not thrust[0] > 0.0:
        return None
    k2, k1, k0 = thrust
    return (-k1 + math.sqrt(max(k1 * k1 - 4.0 * k2 * (k0 - 9.81 * mass / n), 0.0))) / (2.0 * k2)


def _rotor_drag(sides: Any, up: Any, speed: Any, n: int) -> Found:
    """The linear drag of n rotors whose drag grows with their speed [N s2/m/rad], at hover."""
    if sides is None or speed is None:
        return {}
    per_rotor = n * speed * np.array([sides, sides, 0.0 if up is None else up])
    return {"linear_drag": (per_rotor, "the rotors' at hover, where it grows with their speed")}


# -- mappings ----------------------------------------------------------------------------------------------------------


def _flightmare(said: Said) -> Found:
    mass, arm, limits = said("mass"), said("arm_l"), said("omega_max", 3)
    inertia, thrust, speed = said("inertia", 3), said("thrust_map", 3), said("motor_omega_max")
    most, places = said("thrust_max"), [said(f"tbm_{where}", 3) for where in ("fr", "bl", "br", "fl")]
    drag = next((x for x in (said("aero_coeff_1", 3), said("body_drag_1", 3)) if x is not None), None)
    if drag is None and (x := said("aero_coeff_x_1")) is not None and (y := said("aero_coeff_y_1")) is not None:
        drag = np.array([x, y, said("aero_coeff_z_1") or 0.0])
    found = {
        "mass": (mass, ""),
        "inertia": (inertia, ""),
        "yaw_torque_coefficient": (said("kappa"), ""),
        "thrust_map": (thrust, ""),
        "rotor_speed_min": (said("motor_omega_min"), ""),
        "rotor_speed_max": (speed, ""),
        "motor_time_constant": (said("motor_tau"), ""),
        "linear_drag": (drag, ""),
        "max_body_rate": (limits, ""),
    }
    if thrust is None and most is not None and speed is not None:
        found["thrust_map"] = [most / speed**2, 0.0, 0.0], "from thrust_max at motor_omega_max, as the square of speed"
    if all(x is not None for x in places):
        found |= _placed(np.stack(places), None, "front right, back left, back right, front left")
        found["rotor_spin"] = [-1, -1, 1, 1], "of Agilicious's allocation, not in the file"
    elif arm is not None:
        corners = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
        found |= _placed(arm * math.sqrt(0.5) * corners, None, "arm_l at 45 degrees, as in Flightmare's allocation")
        found["rotor_spin"] = [1, -1, 1, -1], "of Flightmare's allocation, not in the file"
        if inertia is None and mass is not None:
            found["inertia"] = mass / 12.0 * arm**2 * np.array([4.5, 4.5, 7.0]), "Flightmare's, from mass and arm_l"
    return found


def _l2f(said: Said) -> Found:
    gravity, limit, thrust = said("gravity", 3), said.data.get("action_limit"), said("rotor_thrust_coefficients", None, 3)
    ours = np.array([1.0, -1.0, -1.0]) if gravity is not None and gravity[2] > 0.0 else np.ones(3)  # z may point down
    places, up, torque = (
        None if (x := said(f"rotor_{name}", None, 3)) is None else x * ours
        for name in ("positions", "thrust_directions", "torque_directions")
    )
    said.asked |= {"action_limit", "J_inv", "hovering_throttle_relative"}
    limits = Said(limit if isinstance(limit, Mapping) else {}, said.source)
    low, high = limits("min"), limits("max")
    found = {"mass": (said("mass"), "")} | _placed(places, up) | _inertia(said("J", 3, 3))
    if up is not None and torque is not None:
        found["rotor_spin"] = np.sign((up * torque).sum(-1)), ""
    if gravity is not None:
        found["gravity"] = np.linalg.norm(gravity), ""
    if (kappa := said("rotor_torque_constants", None)) is not None:
        found["yaw_torque_coefficient"] = _same(kappa, "rotor_torque_constants")
    times = [said(f"rotor_time_constants_{name}", None) for name in ("rising", "falling")]
    if all(x is not None for x in times):
        found["motor_time_constant"] = _same(np.stack(times, -1), "their time constants")
    if thrust is not None and high is not None:
        per, note = (1000.0 / high, "of a throttle up to 1: the scale is free") if high <= 1.0 else (1.0, "")
        curve, why = _same(thrust, "rotor_thrust_coefficients")
        found["thrust_map"] = (curve[::-1] / [per**2, per, 1.0], note) if curve is not None else (None, why)
        found |= {"rotor_speed_min": (per * (low or 0.0), note), "rotor_speed_max": (per * high, note)}
    return found


def _drone_models(said: Said) -> Found:
    mass, arm, mix, gravity = said("mass"), said("L"), said("mixing_matrix", 3, None), said("gravity_vec", 3)
    curve, torque, kappa = said("rpm2thrust", 3), said("rpm2torque", 3), said("thrust2torque")
    low, high = said("thrust_min"), said("thrust_max")
    found = {"mass": (mass, ""), "motor_time_constant": (said("thrust_tau"), "thrust_tau")} | _inertia(said("J", 3, 3))
    thrust = None if curve is None else curve[::-1] / [RPM**2, RPM, 1.0]
    found |= {"thrust_map": (thrust, ""), "yaw_torque_coefficient": (kappa, "")}
    if gravity is not None:
        found["gravity"] = np.linalg.norm(gravity), ""
    if mix is not None and arm is not None:
        found |= _placed(arm * np.stack([-mix[1], mix[0], 0.0 * mix[0]], -1), None, "L times the mixing matrix")
        found["rotor_spin"] = np.sign(mix[2]), ""
        if (speed := _hover_speed(mass, thrust, mix.shape[1])) and torque is not None and kappa is None:
            powers = (speed / RPM) ** np.arange(3)
            found["yaw_torque_coefficient"] = torque @ powers / (curve @ powers), "rpm2torque per rpm2thrust at hover"
    for field, newton in (("rotor_speed_min", low), ("rotor_speed_max", high)):
        if newton is not None and thrust is not None:
            found[field] = _hover_speed(newton / 9.81, thrust, 1), f"at {newton:g} N"
    return found


def _rotorpy(said: Said) -> Found:
    mass, k2, torque, places = said("mass"), said("k_eta"), said("k_m"), said("rotor_pos", None, 3)
    moments = [said(f"I{axes}") for axes in ("xx", "yy", "zz", "xy", "xz", "yz")]
    drag, n = [said(f"c_D{axis}") for axis in "xyz"], 0 if places is None else len(places)
    said.asked |= {"num_rotors"}
    found = {"mass": (mass, ""), "motor_time_constant": (said("tau_m"), ""), "rotor_spin": (said("rotor_directions", None), "")}
    found |= {f"rotor_speed_{end}": (said(f"rotor_speed_{end}"), "") for end in ("min", "max")} | _placed(places, None)
    if all(x is not None for x in moments[:3]):
        found |= _inertia(_symmetric(*(0.0 if x is None else x for x in moments)))
    if k2 is not None:
        found["thrust_map"] = [k2, 0.0, 0.0], ""
        found |= {"yaw_torque_coefficient": (torque / k2, "k_m per k_eta")} if torque is not None else {}
        found |= _rotor_drag(said("k_d"), said("k_z"), _hover_speed(mass, [k2, 0.0, 0.0], n), n)
    return found | ({"quadratic_drag": (drag, "")} if all(x is not None for x in drag) else {})


def _symmetric(xx: Any, yy: Any, zz: Any, xy: Any = 0.0, xz: Any = 0.0, yz: Any = 0.0) -> Array:
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], float)


MAPPINGS: dict[str, tuple[Any, ...]] = {  # by kind: how it is read, and names that no other kind has
    "Flightmare or Agilicious": (_flightmare, "tbm_fr", "arm_l", "motor_omega_max", "motor_tau"),
    "l2f": (_l2f, "rotor_thrust_coefficients", "rotor_torque_directions"),
    "drone-models": (_drone_models, "rpm2thrust", "mixing_matrix"),
    "RotorPy": (_rotorpy, "k_eta", "rotor_pos"),
}


# -- XML ---------------------------------------------------------------------------------------------------------------


def _xml(path: Path) -> ET.Element:
    text = _text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # a few lines of entities can mean billions of characters
        raise UserValueError(f"{path}: declares a document type or entities. Write the values out instead.")
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise UserValueError(f"{path}: not an XML file: {one_line(error)}.") from None


def _floats(text: str | None, n: int, source: str, default: float | None = 0.0) -> Array:
    try:
        values = np.array((text or "").split(), float)
    except ValueError:
        values = np.empty(0)
    if text is None and default is not None:
        values = np.full(n, default)
    if len(values) != n:
        raise UserValueError(f"{source}: expected {n} numbers, got {shown(text)}.")
    return values


def _frame(xyz: Array, rpy: Array) -> Array:
    """Where something stands in what holds it, (4, 4): turned about x, then y, then z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    frame = np.eye(4)
    frame[:3, 3] = xyz
    frame[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return frame


Links = dict[str, tuple[float, Array, Array]]  # of each: its mass, where its centre of mass is, its inertia there


def _urdf(root: ET.Element, source: str) -> Found:
    joints = {}
    for joint in root.iterfind("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            joints[child.get("link", "")] = parent.get("link", ""), _origin(joint, source)
    links: Links = {}
    for link in root.iterfind("link"):
        name = above = link.get("name", "")
        frame, inertial = np.eye(4), link.find("inertial")
        for _ in joints:
            if above in joints:
                above, placed = joints[above]
                frame = placed @ frame
        if inertial is not None:
            mass, inertia = inertial.find("mass"), inertial.find("inertia")
            moments = [_floats(None if inertia is None else inertia.get(f"i{x}"), 1, source)[0] for x in AXES]
            weight = _floats(None if mass is None else mass.get("value"), 1, source)[0]
            links[name] = weight, frame @ _origin(inertial, source), _symmetric(*moments)
    about = root.find("properties")
    return _vehicle(root, links, source) if about is None else _gym_pybullet(root, links, about.attrib, source)


AXES = ("xx", "yy", "zz", "xy", "xz", "yz")


def _origin(element: ET.Element, source: str) -> Array:
    origin = element.find("origin")
    return np.eye(4) if origin is None else _frame(*(_floats(origin.get(x), 3, source) for x in ("xyz", "rpy")))


def _sdf(root: ET.Element, path: Path) -> Found:
    model = root if root.tag == "model" else root.find("model")
    if model is None:
        raise UserValueError(f"{path}: has no <model>. {_readable()}")
    links: Links = {}
    plugins = ET.Element("plugins")
    _add_model(model, np.eye(4), path, links, plugins, 0)
    return _vehicle(plugins, links, str(path))


def _add_model(model: ET.Element, frame: Array, path: Path, links: Links, plugins: ET.Element, depth: int) -> None:
    """Add the links and plugins of a model, and of those that it includes, in the frame of the outermost."""
    source = str(path)
    plugins.extend(model.iterfind("plugin"))
    for link in model.iterfind("link"):
        if (inertial := link.find("inertial")) is not None:
            moments = [_floats(inertial.findtext(f"inertia/i{x}"), 1, source)[0] for x in AXES]
            placed = frame @ _pose(link, source) @ _pose(inertial, source)
            links[link.get("name", "")] = _floats(inertial.findtext("mass"), 1, source)[0], placed, _symmetric(*moments)
    for inner in model.iterfind("model"):
        _add_model(inner, frame @ _pose(inner, source), path, links, plugins, depth)
    for include in model.iterfind("include"):
        name = (include.findtext("uri") or "").strip().removeprefix("model://")
        places = [path.parent.parent / name / "model.sdf", path.parent / f"{name}.sdf"]
        found = next((x for x in places if re.fullmatch(r"[\w-]+", name) and x.is_file()), None)
        if found is None or depth > 5:
            where = " or ".join(map(str, places))
            raise UserValueError(f"{source} includes {shown(name)}, which should be at {where}. Put it there.")
        inner = _xml(found).find("model")
        if inner is not None:
            _add_model(inner, frame @ _pose(include, source), found, links, plugins, depth + 1)


def _pose(element: ET.Element, source: str) -> Array:
    pose = _floats(element.findtext("pose"), 6, source)
    return _frame(pose[:3], pose[3:])


def _body(links: Links, rotors: Sequence[str]) -> tuple[Found, Array, Array]:
    """All links as one rigid body; where its rotors are from the centre of mass, and where they point."""
    mass = sum(link[0] for link in links.values())
    centre = sum(m * frame[:3, 3] for m, frame, _ in links.values()) / mass if mass else np.zeros(3)
    whole = np.zeros((3, 3))
    for m, frame, inertia in links.values():
        turn, arm = frame[:3, :3], frame[:3, 3] - centre
        whole += turn @ inertia @ turn.T + m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    frames = np.array([links[x][1] for x in rotors]).reshape(-1, 4, 4).round(12)
    note = "all links together" if sum(x[0] > 0 for x in links.values()) > 1 else ""
    found: Found = {"mass": (mass, note)} if mass else {}
    found |= _inertia(whole, note) if whole.any() else {}
    found |= _placed(frames[:, :3, 3] - centre, frames[:, :3, 2]) if rotors else {}
    return found, frames, whole


def _numbered(links: Links) -> list[str]:
    """The links that are rotors by their names, in the order of their numbers."""
    names = [name for name in links if re.search(r"(rotor|prop|motor)\D*\d+", name.lower())]
    return sorted(names, key=lambda name: [int(x) for x in re.findall(r"\d+", name)])


def _gym_pybullet(root: ET.Element, links: Links, said: Mapping[str, str], source: str) -> Found:
    rotors = _numbered(links)
    found, _, _ = _body(links, rotors)
    numbers = {k: _floats(said.get(k), 1, source)[0] for k in ("kf", "km", "thrust2weight", "drag_coeff_xy", "drag_coeff_z") if k in said}
    n, mass = len(rotors), found.get("mass", (None,))[0]
    if n == 4:
        spin = np.array([-1, 1, -1, 1]) * (-1 if root.get("name") == "racer" else 1)
        found["rotor_spin"] = spin, "of the code of gym-pybullet-drones, not in the file"
    if k2 := numbers.get("kf", 0.0) / RPM**2:
        found["thrust_map"] = [k2, 0.0, 0.0], "kf"
        speed = _hover_speed(mass, [k2, 0.0, 0.0], n)
        if "km" in numbers:
            found["yaw_torque_coefficient"] = numbers["km"] / numbers["kf"], "km per kf"
        if "thrust2weight" in numbers and speed:
            found["rotor_speed_max"] = speed * math.sqrt(numbers["thrust2weight"]), "from thrust2weight"
        found |= _rotor_drag(numbers.get("drag_coeff_xy"), numbers.get("drag_coeff_z"), speed, n)
    return found


def _vehicle(root: ET.Element, links: Links, source: str) -> Found:
    """A body with the motors of Gazebo or RotorS, or without."""
    motors = [x for x in root.iter("plugin") if x.find("motorConstant") is not None]
    motors.sort(key=lambda x: int(x.findtext("motorNumber") or x.findtext("actuator_number") or 0))
    short = {re.split("/|::", name)[-1]: name for name in links}
    rotors = [short.get(re.split("/|::", (x.findtext("linkName") or "").strip())[-1], "") for x in motors]
    if "" in rotors:
        raise UserValueError(f"{source}: a motor belongs to a link that has no <inertial>. Add it.")
    found, _, _ = _body(links, rotors or _numbered(links))
    if not motors:
        return found

    def all_of(*names: str) -> tuple[Any, str]:
        some = [[_floats(x.findtext(name), 1, source, None)[0] for name in names] for x in motors]
        value, why = _same(some, names[0])
        return (None if value is None else value[0] if len(set(value)) == 1 else value), why

    found["rotor_spin"] = [-1 if (x.findtext("turningDirection") or "").strip() == "ccw" else 1 for x in motors], "turningDirection"
    found["yaw_torque_coefficient"], found["rotor_speed_max"] = all_of("momentConstant"), all_of("maxRotVelocity")
    found["motor_time_constant"] = all_of("timeConstantUp", "timeConstantDown")
    k2, why = all_of("motorConstant")
    found["thrust_map"] = ([k2, 0.0, 0.0] if k2 else None), why
    speed = _hover_speed(found.get("mass", (None,))[0], [k2, 0.0, 0.0] if k2 else None, len(motors))
    return found | _rotor_drag(all_of("rotorDragCoefficient")[0], None, speed, len(motors))
