"""What files of other projects say of a drone: mappings, and URDF and SDF, whose links are one rigid body."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.dynamics import presets
from torchrl_quad.dynamics.parameters import FIELDS
from torchrl_quad.errors import UserValueError, one_line, shown

Array = NDArray[np.float64]
Found = dict[str, tuple[Any, str]]  # of a field: its value, None where there is none, and a note
RPM = math.pi / 30.0  # [rad/s]
READABLE = (
    "These can be read: URDF, SDF, YAML of Flightmare and Agilicious, TOML of drone-models and Crazyflow, JSON of l2f "
    "(rl-tools) and of RotorPy's quad_params, and our own YAML and TOML."
)
AXES = ("xx", "yy", "zz", "xy", "xz", "yz")
DEPTH = 20  # of models, joints and frames within each other
Links = dict[str, tuple[float, Array, Array]]  # of each: its mass, the frame of its centre of mass, its inertia there


def read_text(path: Path) -> str:
    """The content of a file of a reasonable size."""
    if not path.is_file():  # which a pipe or a device is not, whose reading may never end
        raise FileNotFoundError(f"No drone file at {path}. Give the path of a file that exists.")
    with path.open("rb") as file:
        content = file.read(presets.MAX_BYTES + 1)
    if len(content) > presets.MAX_BYTES:
        raise UserValueError(f"{path}: has more than {presets.MAX_BYTES:,} bytes. A drone needs less.")
    return content.decode("utf-8-sig", "replace")


def read_json(path: Path) -> Any:
    """The content of a JSON file."""
    text = read_text(path)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserValueError(f"{path}: not a JSON file: {one_line(error)}.") from None


class Said:
    """The numbers of a mapping, by name; it keeps account of the names that were asked for."""

    def __init__(self, data: Mapping[str, Any], source: str) -> None:
        self.data, self.source, self.asked = data, source, set[str]()

    def __call__(self, name: str, *shape: int | None) -> Any:
        """An array of this shape, in which None is any length; or None, where the mapping has no such name."""
        self.asked.add(name)
        if (value := self.data.get(name)) is None:
            return None
        value = list(value.values()) if isinstance(value, Mapping) else value  # of rotors, r1, r2 and so on
        try:
            array = presets.as_array(value)
        except (ValueError, RecursionError) as error:
            raise UserValueError(f"{self.source}: {name!r}: {one_line(error)}.") from None
        if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
            want = ", ".join("n" if n is None else str(n) for n in shape)
            raise UserValueError(f"{self.source}: {name!r} has shape {array.shape}; it must be ({want}).")
        return array

    def fields(self, **names: str) -> Found:
        """Fields that the mapping has under other names, as they are."""
        shapes = {x: () if FIELDS[x]["shape"] == (1,) else FIELDS[x]["shape"] for x in names}
        return {x: (self(name, *(None if n == "n" else n for n in shapes[x])), "") for x, name in names.items()}


def placed(positions: Array, directions: Array | None = None, note: str = "") -> Found:
    """Where rotors (n, 3) are, and where they point if they are tilted; of upright ones the height does not count."""
    if directions is None or np.allclose(directions[:, :2], 0.0, atol=1e-6):
        return {"rotor_positions": (positions[:, :2], note)}
    return {"rotor_positions": (positions, note), "rotor_direction": (directions, "")}


def diagonal(matrix: Any, note: str = "") -> Found:
    """The diagonal of an inertia (3, 3), if its axes are nearly the principal ones."""
    if matrix is None or not matrix.any():
        return {}
    products = abs(matrix - np.diag(np.diag(matrix))).max()
    if products > 0.05 * np.diag(matrix).min():
        return {
            "inertia": (
                None,
                f"its products of inertia are not small, {products:.2g} kg m2; give it about principal axes",
            )
        }
    left = f"products of inertia up to {products:.2g} kg m2 left out" if products > 1e-6 * matrix.max() else ""
    return {"inertia": (np.diag(matrix), "; ".join(x for x in (note, left) if x))}


def symmetric(xx: Any, yy: Any, zz: Any, xy: Any, xz: Any, yz: Any) -> Array:
    """An inertia (3, 3), from its moments and products."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], float)


def same(values: Any, what: str) -> tuple[Any, str]:
    """The value that all rotors have; none, with the reason, if they differ."""
    values = np.asarray(values, float)
    same = np.allclose(values, values[:1], rtol=1e-6, atol=0.0)
    return (values[0], "") if same else (None, f"rotors differ in {what}, and must not")


def speed_at(force: Any, curve: Sequence[float]) -> float:
    """Of a rotor that thrusts with a force [N], by a thrust map."""
    k2, k1, k0 = curve
    root = math.sqrt(max(k1 * k1 + 4.0 * k2 * (force - k0), 0.0))
    return float(2.0 * (force - k0) / max(k1 + root, 1e-12))


def add_drag(found: Found, sides: float | None, up: float | None) -> None:
    """The linear drag of rotors whose drag grows with their speed [N s2/(m rad)], at hover."""
    mass, curve, places = (found.get(x, (None,))[0] for x in ("mass", "thrust_map", "rotor_positions"))
    if sides is not None and mass and curve is not None and places is not None:
        total = len(places) * speed_at(9.81 * mass / len(places), curve)
        found["linear_drag"] = total * np.array([sides, sides, up or 0.0]), "the rotors', at hover"


# -- mappings ----------------------------------------------------------------------------------------------------------


def _flightmare(said: Said) -> Found:
    names = {"yaw_torque_coefficient": "kappa", "motor_time_constant": "motor_tau", "max_body_rate": "omega_max"}
    names |= {"rotor_speed_min": "motor_omega_min", "rotor_speed_max": "motor_omega_max"}
    found = said.fields(mass="mass", inertia="inertia", thrust_map="thrust_map", **names)
    mass, speed, most, arm = found["mass"][0], found["rotor_speed_max"][0], said("thrust_max"), said("arm_l")
    drags = [said("aero_coeff_1", 3), said("body_drag_1", 3), *(said(f"aero_coeff_{axis}_1") for axis in "xyz")]
    if drags[2] is not None and drags[3] is not None:
        drags.append(np.array([drags[2], drags[3], drags[4] or 0.0]))
    found["linear_drag"] = next((x for x in drags if x is not None and x.ndim), None), ""
    if found["thrust_map"][0] is None and most is not None and speed is not None:
        found["thrust_map"] = [most / speed**2, 0.0, 0.0], "from thrust_max at motor_omega_max, as the square of speed"
    places = [said(f"tbm_{where}", 3) for where in ("fr", "bl", "br", "fl")]
    if all(x is not None for x in places):
        found |= placed(np.stack(places), note="front right, back left, back right, front left")
        found["rotor_spin"] = [-1, -1, 1, 1], "of Agilicious's allocation, not in the file"
    elif arm is not None:
        found |= placed(
            arm * math.sqrt(0.5) * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]), note="arm_l at 45 degrees"
        )
        found["rotor_spin"] = [1, -1, 1, -1], "of Flightmare's allocation, not in the file"
        if found["inertia"][0] is None and mass is not None:
            found["inertia"] = mass / 12.0 * arm**2 * np.array([4.5, 4.5, 7.0]), "of mass and arm_l, as in Flightmare"
    return found


def _l2f(said: Said) -> Found:
    gravity, curves = said("gravity", 3), said("rotor_thrust_coefficients", None, 3)
    turn = np.array([1.0, -1.0, -1.0]) if gravity is not None and gravity[2] > 0.0 else np.ones(3)  # z points down
    names = ("rotor_positions", "rotor_thrust_directions", "rotor_torque_directions")
    places, up, torque = (None if (x := said(name, None, 3)) is None else x * turn for name in names)
    limit, kappa = said("action_limit", None), said("rotor_torque_constants", None)
    times = [said(f"rotor_time_constants_{name}", None) for name in ("rising", "falling")]
    said.asked |= {"J_inv", "hovering_throttle_relative"}
    found = said.fields(mass="mass") | diagonal(said("J", 3, 3)) | ({} if places is None else placed(places, up))
    if up is not None and torque is not None:
        found["rotor_spin"] = np.sign((up * torque).sum(-1)), ""
    if gravity is not None:
        found["gravity"] = np.linalg.norm(gravity), ""
    if kappa is not None:
        found["yaw_torque_coefficient"] = same(kappa, "rotor_torque_constants")
    if times[0] is not None and times[1] is not None:
        found["motor_time_constant"] = same(np.stack(times, -1), "their time constants")
    if curves is not None and limit is not None and limit.size == 2:
        scale, note = (1000.0, "of a throttle of 0 to 1, times 1000") if max(limit) <= 1.0 else (1.0, "")
        curve, why = same(curves, "rotor_thrust_coefficients")
        found["thrust_map"] = (None, why) if curve is None else (curve[::-1] / [scale**2, scale, 1.0], note)
        found |= {f"rotor_speed_{end}": (scale * x, note) for end, x in zip(("min", "max"), sorted(limit), strict=True)}
    return found


def _drone_models(said: Said) -> Found:
    found = said.fields(mass="mass", yaw_torque_coefficient="thrust2torque", motor_time_constant="thrust_tau")
    found |= diagonal(said("J", 3, 3))
    arm, mix, gravity = said("L"), said("mixing_matrix", 3, None), said("gravity_vec", 3)
    force, torque = said("rpm2thrust", 3), said("rpm2torque", 3)
    curve = None if force is None else force[::-1] / [RPM**2, RPM, 1.0]
    found["thrust_map"] = curve, ""
    if gravity is not None:
        found["gravity"] = np.linalg.norm(gravity), ""
    if mix is not None and arm is not None:
        found |= placed(arm * np.stack([-mix[1], mix[0]], -1), note="L times the mixing matrix")
        found["rotor_spin"] = np.sign(mix[2]), ""
    ends = (("rotor_speed_min", said("thrust_min")), ("rotor_speed_max", said("thrust_max")))
    for end, newton in ends:
        if newton is not None and curve is not None:
            found[end] = speed_at(newton, curve), f"at {newton:g} N"
    mass = found["mass"][0]
    known = curve is not None and not any(x is None for x in (mass, mix, torque))
    if known and found["yaw_torque_coefficient"][0] is None:
        powers = (speed_at(9.81 * mass / mix.shape[1], curve) / RPM) ** np.arange(3)
        found["yaw_torque_coefficient"] = torque @ powers / (force @ powers), "rpm2torque per rpm2thrust, at hover"
    return found


def _rotorpy(said: Said) -> Found:
    names = {x: x for x in ("mass", "rotor_speed_min", "rotor_speed_max")}
    found = said.fields(motor_time_constant="tau_m", rotor_spin="rotor_directions", **names)
    moments, drag = [said(f"I{axes}") for axes in AXES], [said(f"c_D{axis}") for axis in "xyz"]
    k2, torque, places = said("k_eta"), said("k_m"), said("rotor_pos", None, 3)
    said.asked.add("num_rotors")
    found |= {} if places is None else placed(places)
    if all(x is not None for x in moments[:3]):
        found |= diagonal(symmetric(*(x or 0.0 for x in moments)))
    if all(x is not None for x in drag):
        found["quadratic_drag"] = np.array(drag), ""
    if k2 is not None:
        found["thrust_map"] = [k2, 0.0, 0.0], ""
        found["yaw_torque_coefficient"] = (None if torque is None else torque / k2), "k_m per k_eta"
        add_drag(found, said("k_d"), said("k_z"))
    return found


MAPPINGS: dict[str, tuple[Any, ...]] = {  # by kind: how it is read, and names that no other kind has
    "Flightmare or Agilicious": (_flightmare, "tbm_fr", "arm_l", "motor_omega_max", "motor_tau"),
    "l2f": (_l2f, "rotor_thrust_coefficients", "rotor_torque_directions"),
    "drone-models": (_drone_models, "rpm2thrust", "mixing_matrix"),
    "RotorPy": (_rotorpy, "k_eta", "rotor_pos"),
}


# -- URDF and SDF ------------------------------------------------------------------------------------------------------


def read_xml(path: Path) -> tuple[str, str, Found, list[str]]:
    """Of a URDF or SDF: its path, its kind, what it says, and which of its attributes were not read."""
    root, links, plugins = _xml(path), Links(), list[ET.Element]()
    model = root if root.tag == "model" else root.find("model")
    if root.tag == "robot":
        _add_urdf(root, links, str(path))
        plugins += root.iter("plugin")
    elif model is not None:
        _add_sdf(model, np.eye(4), path, links, plugins)
    else:
        raise UserValueError(
            f"{path}: XML with the root <{one_line(root.tag)}> is no URDF or SDF with a model. {READABLE}"
        )
    motors = sorted(
        (x for x in plugins if x.find("motorConstant") is not None), key=lambda x: _digits(x.findtext("motorNumber"))
    )
    short = {re.split("/|::", name)[-1]: name for name in links}
    rotors = [short.get(re.split("/|::", (x.findtext("linkName") or "").strip())[-1], "") for x in motors]
    for word in ("rotor", "prop", "motor"):
        rotors = rotors or sorted((x for x in links if re.search(rf"{word}\D*\d+", x.lower())), key=_digits)
    if "" in rotors:
        raise UserValueError(f"{path}: the linkName of a motor is that of no link with an <inertial>. Add it.")
    found = _body(links, rotors)
    _add_motors(found, motors, str(path))
    if (said := root.find("properties")) is not None and root.tag == "robot":
        numbers = Said({name: presets.parse(text.encode(), name) for name, text in said.attrib.items()}, str(path))
        _add_attributes(found, numbers, root.get("name", ""))
        return str(path), "URDF of gym-pybullet-drones", found, [x for x in said.attrib if x not in numbers.asked]
    return str(path), "URDF" if root.tag == "robot" else "SDF", found, []


def _digits(name: str | None) -> list[int]:
    return [int(x) for x in re.findall(r"\d+", name or "")]


def _xml(path: Path) -> ET.Element:
    text = read_text(path)
    text = text[max(text.find("<?xml"), 0) :]  # before which Gazebo allows comments
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # a few lines of which can mean billions of characters
        raise UserValueError(f"{path}: it declares entities or a type. Write the values out instead.")
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise UserValueError(f"{path}: not an XML file: {one_line(error)}.") from None


def _numbers(text: str | None, n: int, source: str) -> Array:
    """So many numbers; zeros where there is nothing."""
    try:
        values = np.array((text or "").split() or [0.0] * n, float)
    except ValueError:
        values = np.empty(0)
    if len(values) != n:
        raise UserValueError(f"{source}: expected {n} number{'s' * (n > 1)}, got {shown(text)}.")
    return values


def _frame(xyz: Array, rpy: Array) -> Array:
    """Where something stands in what holds it, (4, 4): turned about x, then y, then z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = about @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]]), xyz
    return frame


def _add_urdf(root: ET.Element, links: Links, source: str) -> None:
    def origin(element: ET.Element) -> Array:
        found = element.find("origin")
        return np.eye(4) if found is None else _frame(*(_numbers(found.get(x), 3, source) for x in ("xyz", "rpy")))

    def end(joint: ET.Element, name: str) -> str:
        return getattr(joint.find(name), "attrib", {}).get("link", "")

    joints = {end(joint, "child"): joint for joint in root.iterfind("joint")}
    for link in root.iterfind("link"):
        above, frame = link.get("name", ""), np.eye(4)
        if (inertial := link.find("inertial")) is None:
            continue
        for _ in range(DEPTH):  # up to the root; no further where they make a circle
            if above in joints:
                frame, above = origin(joints[above]) @ frame, end(joints[above], "parent")
        about = {x.tag: x.attrib for x in inertial}
        mass, *moments = (
            _numbers(about.get(tag, {}).get(name), 1, source)[0]
            for tag, name in (("mass", "value"), *(("inertia", f"i{axes}") for axes in AXES))
        )
        links[link.get("name", "")] = mass, frame @ origin(inertial), symmetric(*moments)


def _add_sdf(
    model: ET.Element, outer: Array, path: Path, links: Links, plugins: list[ET.Element], depth: int = 0
) -> None:
    """Add the links and plugins of a model and of those within it, in the frame of the outermost."""

    def own(element: ET.Element) -> Array:
        pose = _numbers(element.findtext("pose"), 6, str(path))
        in_degrees = any(x.get("degrees") in ("true", "1") for x in element.iterfind("pose"))
        return _frame(pose[:3], np.radians(pose[3:]) if in_degrees else pose[3:])

    def standing(element: ET.Element, steps: int = 0) -> Array:
        pose, child = element.find("pose"), element.findtext("child", "").strip() if element.tag == "joint" else ""
        base = ("" if pose is None else pose.get("relative_to", "")) or element.get("attached_to", "") or child
        return (standing(names[base], steps + 1) if base in names and steps < DEPTH else outer) @ own(element)

    if depth > DEPTH:
        raise UserValueError(f"{path}: more than {DEPTH} models lie within each other. Write it flatter.")

    names = {x.get("name", ""): x for x in model if x.tag in ("link", "joint", "frame", "model")}
    plugins += model.iterfind("plugin")
    for link in model.iterfind("link"):
        if (inertial := link.find("inertial")) is not None:
            mass, *moments = (
                _numbers(inertial.findtext(x), 1, str(path))[0] for x in ("mass", *(f"inertia/i{a}" for a in AXES))
            )
            name = link.get("name", "")
            while name in links:  # of another model
                name = f"other::{name}"
            links[name] = mass, standing(link) @ own(inertial), symmetric(*moments)
    for inner in model.iterfind("model"):
        _add_sdf(inner, standing(inner), path, links, plugins, depth + 1)
    for include in model.iterfind("include"):
        name = include.findtext("uri", "").strip().removeprefix("model://")
        beside = path.parent.parent / name
        places = [beside / "model.sdf", beside / f"{name}.sdf", path.parent / f"{name}.sdf"]
        file = next((x for x in places if re.fullmatch(r"[\w-]+", name) and x.is_file()), None)
        inner = None if file is None else _xml(file).find("model")
        if file is None or inner is None:
            raise UserValueError(
                f"{path} includes the model {shown(name)}: put it at {places[0]} or {places[-1]}, or take it out."
            )
        _add_sdf(inner, standing(include), file, links, plugins, depth + 1)


def _body(links: Links, rotors: Sequence[str]) -> Found:
    """All links as one rigid body, and where its rotors are from the centre of mass."""
    mass = sum(m for m, _, _ in links.values())
    centre = sum((m * frame[:3, 3] for m, frame, _ in links.values()), np.zeros(3)) / max(mass, 1e-9)
    whole = np.zeros((3, 3))
    for m, frame, inertia in links.values():
        turn, arm = frame[:3, :3], frame[:3, 3] - centre
        whole += turn @ inertia @ turn.T + m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    note = "all links together" if sum(m > 0.0 for m, _, _ in links.values()) > 1 else ""
    found: Found = ({"mass": (mass, note)} if mass > 0.0 else {}) | diagonal(whole, note)
    frames = np.array([links[x][1] for x in rotors]).reshape(-1, 4, 4).round(12)
    return found | (placed((frames[:, :3, 3] - centre).round(12), frames[:, :3, 2]) if rotors else {})


def _add_motors(found: Found, motors: Sequence[ET.Element], source: str) -> None:
    """What the motors of Gazebo and RotorS say."""

    def said(*names: str) -> tuple[Any, str]:
        if any(x.find(name) is None for x in motors for name in names):
            return None, ""
        value, why = same([[_numbers(x.findtext(name), 1, source)[0] for name in names] for x in motors], names[0])
        return (value if value is None or len(set(value)) > 1 else value[0]), why

    if not motors:
        return
    turns = [(x.findtext("turningDirection") or "").strip() for x in motors]
    if set(turns) <= {"cw", "ccw"}:
        found["rotor_spin"] = [1 if x == "cw" else -1 for x in turns], "against turningDirection"
    found["yaw_torque_coefficient"], found["rotor_speed_max"] = said("momentConstant"), said("maxRotVelocity")
    found["motor_time_constant"], (k2, why) = said("timeConstantUp", "timeConstantDown"), said("motorConstant")
    found["thrust_map"] = (None if k2 is None else [k2, 0.0, 0.0]), why
    add_drag(found, said("rotorDragCoefficient")[0], None)


def _add_attributes(found: Found, said: Said, name: str) -> None:
    """What gym-pybullet-drones says of a drone, of rotors in rpm."""
    force, torque, ratio = said("kf"), said("km"), said("thrust2weight")
    mass, places = (found.get(x, (None,))[0] for x in ("mass", "rotor_positions"))
    if places is not None and len(places) == 4:
        spin = np.array([1, -1, 1, -1]) if name == "racer" else np.array([-1, 1, -1, 1])
        found["rotor_spin"] = spin, "of the code of gym-pybullet-drones, not in the file"
    if force is not None and force > 0.0:
        found["thrust_map"] = [force / RPM**2, 0.0, 0.0], "kf"
        if torque is not None:
            found["yaw_torque_coefficient"] = torque / force, "km per kf"
        if ratio is not None and mass and places is not None:
            found["rotor_speed_max"] = (
                speed_at(ratio * 9.81 * mass / len(places), found["thrust_map"][0]),
                "of thrust2weight",
            )
        add_drag(found, said("drag_coeff_xy"), said("drag_coeff_z"))
