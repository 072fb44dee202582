"""What mappings of other projects say of a drone, and what all importers share."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.airframe import listed
from torchrl_quad.dynamics import presets
from torchrl_quad.dynamics.parameters import FIELDS
from torchrl_quad.errors import UserValueError, one_line, shown

Array = NDArray[np.float64]
Found = dict[str, tuple[Any, str]]  # of a field: its value, None where there is none, and a note
RPM = math.pi / 30.0  # [rad/s]
READABLE = (
    "These can be read: URDF, SDF, MJCF (.xml), YAML of Flightmare, Agilicious, RotorS and OmniDrones, TOML of "
    "drone-models and Crazyflow, JSON of VisFly, of l2f (rl-tools) and of RotorPy's quad_params, and our own YAML and "
    "TOML."
)
AXES = ("xx", "yy", "zz", "xy", "xz", "yz")
GIVEN = "given, not in the file"


def read_text(path: Path) -> str:
    """The content of a file of a reasonable size."""
    if not path.is_file():  # which a pipe or a device is not, whose reading may never end
        what = "it is a folder" if path.is_dir() else "there is none"
        raise FileNotFoundError(f"No drone file at {path}: {what}. Give the path of a file that exists.")
    with path.open("rb") as file:
        content = file.read(presets.MAX_BYTES + 1)
    if len(content) > presets.MAX_BYTES:
        raise UserValueError(f"{path}: has more than {presets.MAX_BYTES:,} bytes. A drone needs less.")
    return content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", "replace")


def read_json(path: Path) -> Any:
    """The content of a JSON file."""
    text = read_text(path)
    try:
        return json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise UserValueError(f"{path}: not JSON that can be read: {one_line(error)}.") from None


def _once(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    if len(found := dict(pairs)) < len(pairs):
        raise ValueError(f"{shown([key for key, _ in pairs])} has a name twice")
    return found


class Said:
    """The numbers of a mapping, by name; ``unread`` are the names that nobody has asked for, but for the drone's own.

    Fields that are ``given`` beside the file count instead of its own, also for what follows from them.
    """

    def __init__(self, data: Mapping[str, Any], source: str, given: Found) -> None:
        self.data, self.source, self.given = data, source, given
        self.unread = {str(x): None for x in data if x != "name"}

    def __call__(self, name: str, *shape: int | str) -> Any:
        """An array of this shape, in which "n" is any length; or None, where the mapping has no such name."""
        self.unread.pop(name, None)
        if (value := self.data.get(name)) is None:
            return None
        value = list(value.values()) if isinstance(value, Mapping) else value  # of rotors, r1, r2 and so on
        try:
            array = presets.as_array(value)
        except (ValueError, RecursionError) as error:
            raise UserValueError(f"{self.source}: {name!r}: {one_line(error)}.") from None
        if shape[:1] == ("n",) and array.shape == shape[1:]:  # one for all rotors
            array = array[None]
        if not _fits(array, shape):
            want = ", ".join(map(str, shape))
            raise UserValueError(f"{self.source}: {name!r} has shape {array.shape}; it must be ({want}).")
        return array

    def fields(self, **names: str) -> Found:
        """Fields that the mapping has under other names, as they are."""
        return {field: (self(name, *_shape(field)), "") for field, name in names.items()} | self.given


def usable(given: Mapping[str, Any]) -> Found:
    """Of the fields that are given beside a file, those from whose numbers others can follow."""
    found: Found = {}
    for name, value in given.items():
        with contextlib.suppress(ValueError, TypeError, RecursionError, KeyError):
            array = presets.as_array(value)
            if array.size and _fits(array, _shape(name)):
                found[name] = array, GIVEN
    return found


def _shape(field: str) -> tuple[int | str, ...]:
    return () if FIELDS[field]["shape"] == (1,) else FIELDS[field]["shape"]


def _fits(array: Array, shape: Sequence[int | str]) -> bool:
    return len(shape) == array.ndim and all(n in ("n", m) for n, m in zip(shape, array.shape, strict=True))


def placed(positions: Array | None, directions: Array | None = None, note: str = "") -> Found:
    """Where rotors (n, 3) are, and where they point if they are tilted; of upright ones the height does not count."""
    if positions is None:
        return {}
    if directions is None or np.allclose(directions, [0.0, 0.0, 1.0], atol=1e-6):
        return {"rotor_positions": (positions[:, :2], note)}
    return {"rotor_positions": (positions, note), "rotor_direction": (directions, "")}


def diagonal(matrix: Any, note: str = "") -> Found:
    """The diagonal of an inertia (3, 3), if its axes are nearly the principal ones."""
    if matrix is None or not matrix.any():
        return {}
    products = abs(matrix - np.diag(np.diag(matrix))).max()
    if products > 0.05 * np.diag(matrix).min():
        why = f"its products of inertia are not small, {products:.2g} kg m2, beside {listed(np.diag(matrix))}"
        return {"inertia": (None, f"{why}; give it about principal axes")}
    left = f"products of inertia up to {products:.2g} kg m2 left out" if products > 1e-6 * matrix.max() else ""
    return {"inertia": (np.diag(matrix), "; ".join(x for x in (note, left) if x))}


def symmetric(xx: Any, yy: Any, zz: Any, xy: Any, xz: Any, yz: Any) -> Array:
    """An inertia (3, 3), from its moments and products."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], float)


def same(values: Any, what: str) -> tuple[Any, str]:
    """The value that all rotors have; none, with the reason, if they differ."""
    if values is None:
        return None, ""
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
    elif sides is not None:
        found["linear_drag"] = None, "it follows from the drag of the rotors once mass, thrust and places are known"


# -- mappings ----------------------------------------------------------------------------------------------------------


def _flightmare(said: Said) -> Found:
    names = {"yaw_torque_coefficient": "kappa", "motor_time_constant": "motor_tau", "max_body_rate": "omega_max"}
    names |= {"rotor_speed_min": "motor_omega_min", "rotor_speed_max": "motor_omega_max"}
    found = said.fields(mass="mass", inertia="inertia", thrust_map="thrust_map", **names)
    mass, speed, most, curve = found["mass"][0], found["rotor_speed_max"][0], said("thrust_max"), found["thrust_map"][0]
    arm = said("arm_length" if "linear_drag_coeffs" in said.data else "arm_l")  # of VisFly, or of Flightmare
    drags = {name: said(name, 3) for name in ("aero_coeff_1", "body_drag_1", "linear_drag_coeffs")}
    for name in ("aero_coeff_{}_1", "linear_drag_coeff_{}"):
        x, y, z = (said(name.format(axis)) for axis in "xyz")
        part = "" if z is not None else "; 0 along z, of which it says nothing"
        drags[name.format("x") + part] = None if x is None or y is None else np.array([x, y, z or 0.0])
    drags = {name: x for name, x in drags.items() if x is not None}
    named = next((name for name, x in drags.items() if x.any()), next(iter(drags), ""))  # zeros where all are
    other = "linear_drag_coeff is not read" if "linear_drag_coeff" in said.data else ""
    found["linear_drag"] = drags.get(named), "; ".join(filter(None, (named, other)))
    if curve is None and most is not None and speed is not None:
        found["thrust_map"] = [most / speed**2, 0.0, 0.0], "from thrust_max at motor_omega_max, as the square of speed"
    elif curve is not None and most is not None and speed is not None and speed_at(most, curve) < speed:
        found["rotor_speed_max"] = speed_at(most, curve), "at thrust_max, before motor_omega_max"
    if all(said.data.get(x) is not None for x in ("quad_drag_coeffs", "cross_sections")):
        square = 0.5 * 1.225 * said("quad_drag_coeffs", 3) * said("cross_sections", 3)
        found["quadratic_drag"] = square, "of quad_drag_coeffs and cross_sections, in air"
    if (gravity := said("gravity", *[3] * isinstance(said.data.get("gravity"), list))) is not None:
        found["gravity"] = np.linalg.norm(gravity), ""
    said.unread.pop("rotors_config", None)
    places = [said(f"tbm_{where}", 3) for where in ("fr", "bl", "br", "fl")]
    if all(x is not None for x in places):
        found |= placed(np.stack(places), note="front right, back left, back right, front left")
        found["rotor_spin"] = [-1, -1, 1, 1], "of Agilicious's allocation, not in the file"
    elif (config := said.data.get("rotors_config", "cross")) != "cross":
        found |= dict.fromkeys(("rotor_positions", "rotor_spin"), (None, f"rotors_config is {shown(config)}"))
    elif arm is not None:
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        found |= placed(arm * math.sqrt(0.5) * corners, note="the arm at 45 degrees")
        found["rotor_spin"] = [1, -1, 1, -1], "of Flightmare's allocation, not in the file"
        if found["inertia"][0] is None and mass is not None:
            found["inertia"] = mass / 12.0 * arm**2 * np.array([4.5, 4.5, 7.0]), "of mass and arm, as in Flightmare"
    return found


def _l2f(said: Said) -> Found:
    gravity, curves = said("gravity", 3), said("rotor_thrust_coefficients", "n", 3)
    turn = np.array([1.0, -1.0, -1.0]) if gravity is not None and gravity[2] > 0.0 else np.ones(3)  # z points down
    names = ("rotor_positions", "rotor_thrust_directions", "rotor_torque_directions")
    places, up, torque = (None if (x := said(name, "n", 3)) is None else x * turn for name in names)
    limit, kappa = said("action_limit", "n"), said("rotor_torque_constants", "n")
    times = [said(f"rotor_time_constants_{name}", "n") for name in ("rising", "falling")]
    said.unread.pop("hovering_throttle_relative", None)
    inertia, inverse = said("J", 3, 3), said("J_inv", 3, 3)
    found = said.fields(mass="mass") | diagonal(inertia) | placed(places, up)
    if inertia is not None and inverse is not None:
        is_one = np.allclose(inertia @ inverse, np.eye(3), atol=0.05)
        exact = diagonal(np.linalg.inv(inverse), "the inverse of J_inv, which has more digits") if is_one else {}
        found |= exact or {"inertia": (None, "J_inv is not the inverse of J")}
    if up is not None and torque is not None:
        found["rotor_spin"] = np.sign((up * torque).sum(-1)), ""
    if gravity is not None:
        found["gravity"] = np.linalg.norm(gravity), ""
    found["yaw_torque_coefficient"] = same(kappa, "rotor_torque_constants")
    if times[0] is not None and times[1] is not None:
        found["motor_time_constant"] = same(np.stack(times, -1), "their time constants")
    if curves is not None and limit is not None and limit.size == 2:
        scale, note = (1000.0, "of a throttle of 0 to 1, times 1000") if max(limit) <= 1.0 else (1.0, "taken as rad/s")
        curve, why = same(curves, "rotor_thrust_coefficients")
        found["thrust_map"] = (None, why) if curve is None else (curve[::-1] / [scale**2, scale, 1.0], note)
        found |= {f"rotor_speed_{end}": (scale * x, note) for end, x in zip(("min", "max"), sorted(limit), strict=True)}
    return found


def _drone_models(said: Said) -> Found:
    lag = "rotor_tau" if "rotor_tau" in said.data else "thrust_tau"
    found = said.fields(mass="mass", yaw_torque_coefficient="thrust2torque", motor_time_constant=lag)
    found |= diagonal(said("J", 3, 3))
    arm, mix, gravity = said("L"), said("mixing_matrix", 3, "n"), said("gravity_vec", 3)
    force = said("rpm2thrust", 3)
    curve = None if force is None else force[::-1] / [RPM**2, RPM, 1.0]
    found["thrust_map"] = curve, ""
    if gravity is not None:
        found["gravity"] = np.linalg.norm(gravity), ""
    if mix is not None and arm is not None:
        found |= placed(arm * np.stack([-mix[1], mix[0]], -1), note="L times the mixing matrix")
        found["rotor_spin"] = np.sign(mix[2]), ""
        if not np.allclose(abs(mix[2]), 1.0):
            what = f"the third row of mixing_matrix is {listed(mix[2])}, and must be 1 or -1"
            raise UserValueError(f"{said.source}: {what}. Write the rest of it into thrust2torque or rpm2torque.")
    ends = (("rotor_speed_min", said("thrust_min")), ("rotor_speed_max", said("thrust_max")))
    for end, newton in ends:
        if newton is not None and curve is not None:
            found[end] = speed_at(newton, curve), f"at {newton:g} N"
    mass = found["mass"][0]
    if (drag := said("drag_matrix", 3, 3)) is not None:
        part = ", its diagonal alone" if np.count_nonzero(drag - np.diag(np.diag(drag))) else ""
        found.setdefault("linear_drag", (np.abs(np.diag(drag)), f"drag_matrix{part}"))
    if curve is None or mass is None or mix is None:
        return found
    hover = speed_at(9.81 * mass / mix.shape[1], curve) / RPM
    if found["yaw_torque_coefficient"][0] is None and (torque := said("rpm2torque", 3)) is not None:
        powers = hover ** np.arange(3)
        found["yaw_torque_coefficient"] = torque @ powers / (force @ powers), "rpm2torque per rpm2thrust, at hover"
    if found["motor_time_constant"][0] is None and (lags := said("rotor_dyn_coef", 4)) is not None:
        # of speed and of its square, up and down
        found["motor_time_constant"] = 1.0 / (lags[::2] + 2.0 * hover * lags[1::2]), "rotor_dyn_coef, about hover"
    return found


def _rotorpy(said: Said) -> Found:
    names = {x: x for x in ("mass", "rotor_speed_min", "rotor_speed_max")}
    found = said.fields(motor_time_constant="tau_m", rotor_spin="rotor_directions", **names)
    moments, drag = [said(f"I{axes}") for axes in AXES], [f"c_D{axis}" for axis in "xyz"]
    k2, torque, places = said("k_eta"), said("k_m"), said("rotor_pos", "n", 3)
    said.unread.pop("num_rotors", None)
    found |= placed(places)
    if all(x is not None for x in moments[:3]):
        found |= diagonal(symmetric(*(x or 0.0 for x in moments)))
    if all(said.data.get(x) is not None for x in drag):
        each = np.array([said(x) for x in drag])
        found["quadratic_drag"] = each, "of each axis by itself; in RotorPy times the whole speed"
    if k2 is not None:
        found["thrust_map"] = [k2, 0.0, 0.0], ""
        found["yaw_torque_coefficient"] = (None if torque is None else torque / k2), "k_m per k_eta"
        found |= said.given
        sides, up = said("k_d"), said("k_z")
        add_drag(found, None if up is None else sides, up)
    return found


def _by_angles(said: Said) -> Found:
    """Of RotorS, which lists its rotors by number, and of OmniDrones, which lists their angles, and so on."""
    names = {"angle": "rotor_angles", "arm_length": "arm_lengths", "direction": "directions"}
    names |= {"rotor_force_constant": "force_constants", "rotor_moment_constant": "moment_constants"}
    rotors, inertia = (said.data.get(x) for x in ("rotor_configuration", "inertia"))
    said.unread = {x: None for x in said.unread if x not in ("rotor_configuration", "inertia")}
    by_number = isinstance(rotors, Mapping) and all(isinstance(x, Mapping) for x in rotors.values())
    if by_number:
        each = [rotors[k] for k in sorted(rotors, key=lambda k: str(k).zfill(3))] or [{}]
        rotors = {names.get(key, key): [x[key] for x in each] for key in each[0] if all(key in x for x in each)}
    part = Said(rotors if isinstance(rotors, Mapping) else {}, f"{said.source}: rotor_configuration", {})
    n = next((len(x) for x in part.data.values() if isinstance(x, list)), "n")
    angle, arm, turn, force, torque = (part(name, n) for name in names.values())
    found, fastest = said.fields(mass="mass"), part("max_rotation_velocities", n)
    if isinstance(inertia, Mapping) and None not in map(inertia.get, AXES[:3]):
        moments = Said(dict.fromkeys(AXES, 0.0) | dict(inertia), f"{said.source}: inertia", {})
        found |= diagonal(symmetric(*(moments(axes) for axes in AXES)))
    if angle is not None and arm is not None:
        found |= placed((arm * [np.cos(angle), np.sin(angle), 0.0 * angle]).T.round(9), note="arms at their angles")
    if (tilt := part("tilt_angles", n)) is not None and tilt.any():
        found["rotor_direction"] = None, "tilt_angles do not say about which axes"
    if turn is not None:
        found["rotor_spin"] = -turn, "against direction, which is 1 counter-clockwise"
    found["rotor_speed_max"] = same(fastest, "max_rotation_velocities")
    if force is not None and force.all():
        k2, why = same(force, "their force constants")
        found["thrust_map"] = (None if k2 is None else [k2, 0.0, 0.0]), why
        if torque is not None:  # of RotorS per force
            found["yaw_torque_coefficient"] = same(torque / (1.0 if by_number else force), "their moment constants")
    said.unread |= {f"{x} of rotor_configuration": None for x in part.unread if x != "num_rotors"}
    return found


MAPPINGS: dict[str, tuple[Any, ...]] = {  # by kind: how it is read, and names that no other kind has
    "Flightmare, Agilicious or VisFly": (_flightmare, "tbm_fr", "arm_l", "motor_omega_max", "motor_tau"),
    "l2f": (_l2f, "rotor_thrust_coefficients", "rotor_torque_directions"),
    "drone-models": (_drone_models, "rpm2thrust", "mixing_matrix", "gravity_vec"),
    "RotorPy": (_rotorpy, "k_eta", "rotor_pos"),
    "RotorS or OmniDrones": (_by_angles, "rotor_configuration"),
}
