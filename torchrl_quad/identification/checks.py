"""Does a log mean what its columns claim, as each follows from others?"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from torchrl_quad.deploy.frames import Convention, px4
from torchrl_quad.identification.errors import NotOneDrone, Remedy, WrongFrame, WrongQuaternion, WrongUnit, in_units
from torchrl_quad.identification.layouts import G
from torchrl_quad.identification.signals import Array, Mask, Signal, body_rates, slope, smooth
from torchrl_quad.rotations import continuous, multiply, rotate, rotate_inverse

MAX_LAG = 0.3  # [s] between streams
CALM = 0.1  # [rad/s]: slower rotations are lost in the noise of motion capture
LEAN = 0.05 * G  # [m/s^2]: what accelerates less may do so by the wind
SURE = 0.05  # how much better a hypothesis must correlate than the log as it is given
FRD = np.array([1.0, -1.0, -1.0])
_CONJUGATE = (1.0, -1.0, -1.0, -1.0)
_LAST, _FIRST = (3, 0, 1, 2), (1, 2, 3, 0)  # where w x y z stand in a quaternion that is read a place off
_QUATERNIONS: dict[str, Remedy] = {  # what a quaternion may be, and what mends it
    "as given": {},
    "from world to body": {"factor": _CONJUGATE},
    "scalar last": {"order": _LAST},
    "scalar last, from world to body": {"order": _LAST, "factor": _CONJUGATE},
    "scalar first": {"order": _FIRST},
    "scalar first, from world to body": {"order": _FIRST, "factor": _CONJUGATE},
}
_NED: Remedy = {"convention": px4(), "when": "all of the log is in NED and FRD"}
_DOWN: Remedy = {  # the quaternion times (0, 1, 0, 0)
    "quantity": "quaternion",
    "order": (1, 0, 3, 2),
    "factor": (-1.0, 1.0, 1.0, -1.0),
    "when": "the body of the attitude has y right and z down",
}
_BACKWARD = {"when": "x of the attitude's body points backward"}
BACKWARD: list[Remedy] = [  # the quaternion times (0, 0, 0, 1), or yaw by half a turn
    {"quantity": "quaternion", "order": (3, 2, 1, 0), "factor": (-1.0, 1.0, -1.0, 1.0), **_BACKWARD},
    {"quantity": "euler", "factor": (-1.0, -1.0, 1.0), "offset": (0.0, 0.0, np.pi), **_BACKWARD},
]
_EULER: list[Remedy] = [  # angles as in aviation, beside positions with z up
    {"quantity": "euler", "factor": (1.0, -1.0, -1.0), "when": "the angles are of a body with y right and z down"},
]
_EULER += [{**_EULER[0], "offset": (0.0, 0.0, np.pi / 2.0), "when": f"{_EULER[0]['when']}, and yaw counts from north"}]
_AXES = ("roll", "pitch", "yaw")
_LENGTHS = {"millimetres": 1e-3, "centimetres": 1e-2, "feet": 0.3048}  # [m]


def check_angles(signal: Signal) -> None:
    """Refuse Euler angles in degrees."""
    values = signal.values
    if np.abs(values).max() > 2.0 * np.pi + 0.1:
        said = f"{signal} reach {np.abs(values).max():.3g}, and are angles in rad."
        raise WrongUnit(said, *in_units("euler", "they are in", degrees=np.pi / 180.0))


def check_quaternion(signal: Signal) -> list[str]:
    """Refuse quaternions that are not of unit length; a note if only some are, as of a tracker that lost the drone."""
    norm = np.linalg.norm(signal.values, axis=-1)
    off, lost = np.abs(norm - 1.0) > 0.05, norm == 0.0  # which trackers write for what they do not see
    if (off & ~lost).mean() > 0.01 or lost.mean() > 0.5:
        raise WrongQuaternion(
            f"{off.mean():.0%} of {signal} are not of length 1; the median is {np.median(norm):.3g}. Name the four "
            "columns of one quaternion.",
            {"quantity": "quaternion", "factor": float(f"{1.0 / max(np.median(norm), 1e-9):.3g}")},
        )
    return [f"{off.sum()} samples of {signal} are not of length 1; they count as missing"] if off.any() else []


def check_voltage(signal: Signal) -> None:
    """Refuse the voltage of a battery in other units."""
    usual = float(np.median(signal.values[signal.values > 0.0]))
    if usual > 100.0:
        said = f"{signal} is {usual:.4g} in the median, and is in V."
        drop: Remedy = {"quantity": signal.field, "drop": True, "when": "it is no voltage"}
        units = {k: x for k, x in (("millivolts", 1e-3), ("centivolts", 1e-2)) if 2.0 < usual * x < 60.0}
        raise WrongUnit(said, *in_units(signal.field, "it is in", **units), drop)


def check_velocity(at: Mapping[str, Array], signals: Mapping[str, Signal], dt: float, moving: Mask) -> None:
    """Refuse a position or velocity in other units, and a velocity that is not the derivative of the position."""
    derived = smooth(slope(at["position"], dt), dt)
    speed = np.linalg.norm(derived[moving], axis=-1)
    place = signals["position"]
    apart = [float(np.median(np.linalg.norm(place.values[n:] - place.values[:-n], axis=-1))) for n in range(1, 9)]
    if apart[0] > 0.05 and min(apart[1:]) < 0.2 * apart[0]:
        raise NotOneDrone(
            f"{place} jumps to and fro from row to row, by {apart[0]:.3g} m in the median: are there rows of several "
            "drones? Keep those of one."
        )
    if np.percentile(speed, 99) > 100.0:
        said = f"By {place} the drone flies at {np.percentile(speed, 99):.3g} m/s."
        raise WrongUnit(said, *in_units("position", "the position is in", millimetres=1e-3, centimetres=1e-2))
    signal = signals.get("velocity") or signals.get("velocity_body")
    if signal is None or speed.std() + speed.mean() < 0.05:
        return
    given = smooth(at["velocity"], dt)
    fit, factor, _ = _compare(given, derived, dt, moving)
    if not 0.6 < factor < 1.6 or (fit > 0.99 and not 0.8 < factor < 1.25):
        size = "position" if factor < 1.0 else signal.field
        ratio = min(factor, 1.0 / factor)
        units = _LENGTHS | ({"km/h": 1 / 3.6, "knots": 0.5144} if size == signal.field else {})
        near = [item for item in units.items() if 0.8 < ratio / item[1] < 1.25]
        near.sort(key=lambda item: abs(np.log(ratio / item[1])))
        raise WrongUnit(
            f"{signal} is {factor:.3g} times the derivative of {place}: they, or the clock, are in different units.",
            *in_units(size, f"the {size.partition('_')[0]} is in", **dict(near)),
            *([] if 0.6 < factor < 1.6 else [_clock(factor)]),
            {"quantity": signal.field, "drop": True, "when": "the position is right"},
        )
    frames = ("world", "body") if signal.field == "velocity" else ("body", "world")
    turn, name = (rotate, "velocity_body") if frames[0] == "world" else (rotate_inverse, "velocity")
    other, _, _ = _compare(smooth(turn(at["quaternion"], at["velocity"]), dt), derived, dt, moving)
    if other > 0.9 and (other > fit + 0.02 or 1.0 - other < 0.4 * (1.0 - fit)):
        raise WrongFrame(
            f"{signal} fits the derivative of {place} in the {frames[1]} frame (correlation {other:.3f}) and not in "
            f"the {frames[0]} frame ({fit:.3f}).",
            {"quantity": signal.field, "name": name},
        )
    still = np.maximum(given[moving].std(0), derived[moving].std(0)) < 0.15
    sides = [1.0 if still[k] else _compare(given[:, [k]], derived[:, [k]], dt, moving)[0] for k in range(3)]
    if fit < 0.7 or min(sides) < 0.2:
        flip = tuple(-1.0 if side < 0.2 else 1.0 for side in sides)
        raise WrongFrame(
            f"{signal} does not follow {place}: correlations with the derivative are "
            f"{', '.join(f'{side:.2f}' for side in sides)} along x, y, z.",
            {"quantity": signal.field, "factor": flip, "when": "an axis of the velocity points the other way"},
            {"quantity": "position", "factor": flip, "when": "an axis of the position points the other way"},
            {"quantity": signal.field, "drop": True, "when": "it shall be derived from the position"},
        )


def check_specific_force(at: Mapping[str, Array], signals: Mapping[str, Signal], dt: float, moving: Mask) -> None:
    """Refuse an accelerometer that does not measure the acceleration of the motion and gravity, in m/s^2."""
    if "acceleration" not in at:
        return
    signal, q = signals["acceleration"], at["quaternion"]
    force = smooth(at["acceleration"], dt)[moving]
    speeding = smooth(slope(at["velocity"], dt), dt)
    free = rotate_inverse(q, speeding)[moving]
    due = rotate_inverse(q, speeding + (0.0, 0.0, G))[moving]
    size, usual = (float(np.sqrt((x * x).sum(-1).mean())) for x in (force, due))
    fit = float((force * due).sum(-1).mean()) / max(size * usual, 1e-12)
    if fit > 0.5 and 0.5 < size / usual < 2.0:
        return
    said = f"In flight {signal} has a mean length of {size:.3g}, and the motion asks for {usual:.3g} m/s^2"
    drop: Remedy = {"quantity": "acceleration", "drop": True}
    if fit > 0.5:
        units = {"g": G, "thousandths of g": 1e-3 * G, "m/s^2": 1.0 / G}  # which a preset may take for g
        found = {unit: x for unit, x in units.items() if 0.5 < x * size / usual < 2.0}
        remedies = in_units("acceleration", "the accelerometer is in", **found)
        raise WrongUnit(f"{said} along it. It is in another unit.", *remedies, drop)
    if size < 0.7 * usual and size > 0.0 and (force * free).sum() > 0.5 * np.linalg.norm(force) * np.linalg.norm(free):
        raise WrongUnit(f"{said}: it lacks gravity, which accelerometers measure.", drop)
    if fit >= -0.5:
        raise WrongFrame(f"{said} (correlation {fit:.2f}).", drop)
    flips = {(1, -1, -1): "its axes point forward, right and down", (1, 1, -1): "its z axis points down"}
    flips[-1, -1, -1] = "all its axes point the other way"
    likely = sorted(flips, key=lambda flip: -(force * flip * due).sum())
    remedies = [{"quantity": "acceleration", "factor": flip, "when": flips[flip]} for flip in likely]
    raise WrongFrame(f"{said} along the other direction (correlation {fit:.2f}).", _NED, *remedies, drop)


def check_rates(
    at: Mapping[str, Array], signals: Mapping[str, Signal], dt: float, moving: Mask, convention: Convention
) -> str:
    """Compare the gyro with the derivative of the attitude under every convention, and note how late it is."""
    q, given, theirs = at["quaternion"], signals["quaternion"], replace(convention, xyzw=False)
    logged = theirs.to({"quaternion": q})["quaternion"]
    hypotheses = {}
    for name, remedy in _QUATERNIONS.items():
        read = logged[:, remedy.get("order", (0, 1, 2, 3))] * remedy.get("factor", 1.0)
        hypotheses[name] = theirs.back({"quaternion": read})["quaternion"]
    if "angular_velocity" not in signals:
        _check_by_thrust(at, given, hypotheses, dt, moving)
        return "no gyro: angular_velocity was derived from the attitude"
    signal, gyro = signals["angular_velocity"], at["angular_velocity"]
    right = smooth(body_rates(q, dt), dt)
    turning = float(np.sqrt((right[moving] ** 2).mean()))
    calm = f"{signal} was not checked: the flight turns too slowly ({turning:.2f} rad/s)"
    if turning < CALM / 5.0:
        return calm
    level = smooth(gyro, dt)
    trials = {name: (smooth(body_rates(h, dt), dt), level) for name, h in hypotheses.items()}
    signs = {"if the gyro is of a body with y right and z down": FRD}
    signs |= {f"with {axis} the other way": 1.0 - 2.0 * np.eye(3)[k] for k, axis in enumerate(_AXES)}
    trials |= {name: (right, level * sign) for name, sign in signs.items()}
    trials["in the world frame"] = (right, smooth(rotate_inverse(q, gyro), dt))
    fits = {name: _compare(b, a, dt, moving) for name, (a, b) in trials.items()}
    fit, factor, lag = fits["as given"]
    best = max(fits, key=lambda name: fits[name][0])
    turn, apart = _turn(level, right, dt, moving)
    turned = _compare(level @ turn.T, right, dt, moving)[0]
    told = f"{signal} correlates with the derivative of {given} by {fit:.2f} as given, and"
    if given.field == "euler":
        other, how = _other_angles(logged, theirs, level, dt, moving)
        most = max(fits[best][0], turned)
        if other > max(0.9, most) and (other > most + SURE or (most < 0.99 and 1.0 - other < 0.3 * (1.0 - most))):
            raise WrongFrame(f"{told} by {other:.3f} if {how}. Give quaternions instead of angles.")
    if turned > max(0.8, fits[best][0] + SURE):
        raise WrongFrame(
            f"{told} by {turned:.2f} if the body of the attitude is {apart}. Bring all of the log into one body: x "
            "forward, y left, z up.",
            *(BACKWARD if turn[0, 0] < -0.9 < 0.9 < turn[2, 2] else []),
        )
    if fits[best][0] > max(0.5, fit + SURE):
        told += f" by {fits[best][0]:.2f}"
        if best in hypotheses:
            raise WrongQuaternion(
                f"{told} if the quaternion is {best}. We need w x y z, from body to world.",
                {"quantity": "quaternion", **_QUATERNIONS[best]},
            )
        if best == "in the world frame":
            also = f", or the body of the attitude {apart}: turn it back" if turned > fits[best][0] - SURE else ""
            drop = {"quantity": signal.field, "drop": True, "when": "the gyro is in the world frame" if also else ""}
            raise WrongFrame(f"{told} if the gyro is in the world frame{also}.", *(BACKWARD if also else []), drop)
        flip = {"quantity": signal.field, "factor": tuple(signs[best])}
        raise WrongFrame(f"{told} {best}.", *([_NED, *_EULER] if signs[best] is FRD else []), flip)
    said = f"{signal} is {factor:.3g} times the derivative of {given}: it is in"
    for unit, scale in (("degrees", np.pi / 180.0), ("milliradians", 1e-3)):
        if 1.0 / 3.0 < factor * scale < 3.0 and fit > 0.2:
            raise WrongUnit(f"{said} {unit}/s.", {"quantity": signal.field, "factor": scale})
    for k, axis in enumerate(_AXES):
        one, other = (x[moving, k].std() for x in (level, right))
        along = _compare(level[:, [k]], right[:, [k]], dt, moving)[0]
        counts = max(one, other) > max(3.0 * CALM, 0.3 * turning) and fit > 0.5
        if counts and (along < 0.3 or 10.0 * min(one, other) < max(one, other)):
            raise WrongFrame(
                f"About {axis} {signal} does not turn as {given}: by {one:.2g} and {other:.2g} rad/s, correlated by "
                f"{along:.2f}. Name columns of both."
            )
    if turning < CALM:
        return calm
    derive: Remedy = {"quantity": signal.field, "drop": True, "when": "the rates shall follow from the attitude"}
    if fit < 0.5:
        raise WrongFrame(
            f"{signal} does not follow {given}: their correlation is {fit:.2f} at best, also if the quaternion is "
            "scalar last or inverse, or the gyro in another frame. Name columns that belong together.",
            derive,
        )
    if not 1.0 / 3.0 < factor < 3.0 or (fit > 0.95 and not 0.7 < factor < 1.4):
        near = given.field == "euler" and 1.0 / 3.0 < factor * 180.0 / np.pi < 3.0
        degrees = in_units("euler", "the angles are in", degrees=np.pi / 180.0) if near else []
        raise WrongUnit(f"{said} an unknown unit, or the clock is wrong.", *degrees, _clock(factor), derive)
    size = f", {factor:.2f} times as large" if not 0.8 < factor < 1.25 else ""
    return f"{signal} fits the attitude: correlation {fit:.2f}, {1000.0 * lag:+.0f} ms late{size}"


def _other_angles(q: Array, theirs: Convention, level: Array, dt: float, moving: Mask) -> tuple[float, str]:
    """How well smoothed rates follow roll, pitch and yaw in the best of all other orders, and which that is."""
    w, x, y, z = q.T
    angles = [np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), np.arcsin(np.clip(2 * (w * y - x * z), -1, 1))]
    angles = np.unwrap(np.stack([*angles, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))], -1), axis=0)
    length = np.linalg.norm(angles, axis=-1, keepdims=True)
    vector = np.concatenate((np.cos(length / 2), np.sin(length / 2) * angles / length.clip(1e-9)), -1)
    found = {"the angles are a rotation vector": vector}
    halves = [np.insert(np.zeros((len(q), 3)), 0, np.cos(a / 2), axis=1) for a in angles.T]
    for k, half in enumerate(halves):
        half[:, k + 1] = np.sin(angles[:, k] / 2)
    for order in itertools.permutations(range(3)):
        name = f"the angles turn about the body's {', then '.join('xyz'[k] for k in order)}"
        found[name] = multiply(multiply(halves[order[0]], halves[order[1]]), halves[order[2]])
    fits = {}
    for name, turned in found.items():
        read = theirs.back({"quaternion": continuous(turned)})["quaternion"]
        fits[name] = _compare(level, smooth(body_rates(read, dt), dt), dt, moving)[0]
    best = max(fits, key=lambda name: fits[name])
    return fits[best], best


def _clock(factor: float) -> Remedy:
    """For what is ``factor`` times its derivative by a clock."""
    known = [y for x in (2, 3, 4, 5, 10, 20, 60, 100, 1000, 3600) for y in (x, 1.0 / x)]
    nearest = min(known, key=lambda x: abs(np.log(x * factor)))
    rounded = nearest if 0.75 < nearest * factor < 1.33 else float(f"{1.0 / factor:.2g}")
    return {"quantity": "time", "factor": rounded, "when": "time does not count seconds"}


def _turn(gyro: Array, right: Array, dt: float, moving: Mask) -> tuple[Array, str]:
    """The rotation (3, 3) that brings a gyro closest to right rates (Kabsch 1976), and how it is told."""
    speeds = [np.linalg.norm(x, axis=-1, keepdims=True) for x in (gyro, right)]
    late = _compare(speeds[0], speeds[1], dt, moving)[2]
    a, b = np.roll(gyro, -round(late / dt), 0)[moving], right[moving]
    u, _, v = np.linalg.svd(b.T @ a)
    turn = u * (1.0, 1.0, np.linalg.det(u @ v)) @ v
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = np.degrees(np.arctan2(np.linalg.norm(axis), np.trace(turn) - 1.0))
    about = ", ".join(f"{x:.1f}" for x in -axis / max(np.linalg.norm(axis), 1e-9))
    return turn, f"turned by {angle:.0f} degrees about ({about}) against the gyro's"


def _check_by_thrust(
    at: Mapping[str, Array], given: Signal, hypotheses: Mapping[str, Array], dt: float, moving: Mask
) -> None:
    """Without a gyro: thrust pulls along the body's z, so the drone must accelerate that way."""
    pull = smooth(slope(at["velocity"], dt), dt) + (0.0, 0.0, G)
    pull /= np.linalg.norm(pull, axis=-1, keepdims=True)
    up = {name: smooth(rotate(h, np.broadcast_to([0.0, 0.0, 1.0], pull.shape)), dt) for name, h in hypotheses.items()}
    fits = {name: float(np.mean((u * pull)[moving].sum(-1))) for name, u in up.items()}
    lean = {name: _compare(u[:, :2], pull[:, :2], dt, moving)[0] for name, u in up.items()}
    best = max(lean, key=lambda name: lean[name] + fits[name])
    if lean[best] + fits[best] > lean["as given"] + fits["as given"] + 6.0 * SURE and lean[best] > 0.8:
        raise WrongQuaternion(
            f"{given} leans where the drone accelerates if it is {best} (correlation {lean[best]:.2f}), and not as "
            f"given ({lean['as given']:.2f}). We need w x y z, from body to world.",
            {"quantity": "quaternion", **_QUATERNIONS[best]},
        )


def check_lean(at: Mapping[str, Array], signals: Mapping[str, Signal], dt: float, moving: Mask) -> None:
    """Refuse an attitude that does not lean where the drone accelerates: thrust pulls along the body's z, and the rest
    of what accelerates it follows its velocity, as drag does, or is the wind's, which may hide all."""
    speed, force = smooth(at["velocity"], dt), smooth(slope(at["velocity"], dt), dt)
    up = smooth(rotate(at["quaternion"], np.broadcast_to([0.0, 0.0, 1.0], force.shape)), dt)
    thrust = force + (0.0, 0.0, G)
    along = float(np.median((up * thrust).sum(-1) / np.linalg.norm(thrust, axis=-1).clip(1e-9)))
    if along < 0.7:
        raise WrongFrame(
            f"By {signals['quaternion']} and {signals['position']} the drone does not thrust along its z axis: the "
            f"cosine between them is {along:.2f} in the median. z must point up in the world and in the body. Bring "
            "all of the log into such frames.",
            *([_NED, _DOWN] if along < -0.7 else []),
        )
    lean, rows = G * up[:, :2] / up[:, 2:].clip(0.5), np.flatnonzero(moving & (up[:, 2] > 0.5))
    if len(rows) * dt < 3.0:
        return
    tilt, pull = (np.array(x[:, :2]) for x in (lean, force))
    for k in (0, 1):
        by = np.stack((np.ones(len(speed)), speed[:, k]), -1)
        for x in (tilt, pull):
            x[:, k] -= by @ np.linalg.lstsq(by[rows], x[rows, k], rcond=None)[0]
    parts = (rows, rows[: len(rows) // 2], rows[len(rows) // 2 :])  # what is chance in one half is not in the other
    moves, leans = (x[rows].std(0).max() >= LEAN for x in (pull, tilt))
    fits = {}  # of directions, as complex numbers: turned by an angle, also after the y axis was mirrored
    for side in (1.0, -1.0):
        for shift in range(-round(MAX_LAG / dt), round(MAX_LAG / dt) + 1, max(1, round(0.02 / dt))):
            a, b = np.roll(tilt, shift, 0) @ [1.0, side * 1j], pull @ [1.0, 1j]
            fits[side, shift] = np.array(
                [np.vdot(a[x], b[x]) / max(np.linalg.norm(a[x]) * np.linalg.norm(b[x]), 1e-12) for x in parts]
            )
    side, shift = max(fits, key=lambda key: abs(fits[key][0]))
    best, given = fits[side, shift], np.max([fit.real for (side, _), fit in fits.items() if side > 0.0], 0)
    said = f"By {signals['quaternion']} the drone leans {{}} than it accelerates by {signals['position']}: "
    if moves and (abs(best) > np.maximum(0.6, given + 0.15)).all() and abs(np.angle(best[1] / best[2])) < 0.5:
        a, b = (x[rows] - x[rows].mean(0) for x in (np.roll(lean, shift, 0), force[:, :2]))  # with what drag explains
        angle = np.degrees(np.angle(np.vdot(a @ [1.0, side * 1j], b @ [1.0, 1j])))
        turned = f"turned by {angle:.0f} degrees about z" if abs(angle) > 20.0 else ""
        how = " and ".join(x for x in ("mirrored in y" if side < 0.0 else "", turned) if x)
        raise WrongFrame(
            f"{said.format('another way')}the correlation is {given[0]:.2f} as given, and {abs(best[0]):.2f} if the "
            f"world of position and velocity is {how}. Bring both and the attitude into one world, with z up.",
            _NED,
            *_EULER,
        )
    swing, speeding = (float(x[rows].std(0).max()) for x in (tilt, pull))
    if swing > 4.0 * LEAN and speeding < 0.2 * swing:
        raise WrongFrame(
            f"By {signals['quaternion']} the drone leans to and fro by {np.degrees(np.arctan(swing / G)):.0f} degrees, "
            f"and by {signals['position']} it hardly accelerates: the position stands still, or the clock is too slow. "
            "Give a log in which both were measured."
        )
    sides = [_compare(tilt[:, [k]], pull[:, [k]], dt, moving)[0] for k in (0, 1)]
    apart = any(x < 0.3 and min(tilt[rows, k].std(), pull[rows, k].std()) >= LEAN for k, x in enumerate(sides))
    if apart or (moves and leans and (given < 0.5).all()):
        raise WrongFrame(
            f"{said.format('another way')}the correlation is {min(given[0], *sides):.2f} at best, also if one is "
            "turned about z, mirrored, or up to 0.3 s late. Name columns of one world, with z up, and of one clock."
        )
    gain = float(pull[rows].std(0).max() / max(tilt[rows].std(0).max(), 1e-12))
    carried = rows[thrust[rows, 2] > 0.3 * G]  # where rotors turn: the thrust leans as the drone does
    slopes = [np.linalg.norm(x[carried, :2] / x[carried, 2:], axis=-1) for x in (thrust, up)]
    steep = slopes[1] > (0.1 if (slopes[1] > 0.1).sum() * dt > 1.0 else -1.0)
    ratio = float(np.median(slopes[0][steep]) / max(np.median(slopes[1][steep]), 1e-12)) if steep.any() else 1.0
    sure = given.min() > (0.6 if moves else 0.85) and not 0.5 < ratio < 2.0
    if (moves or leans) and sure and not 0.4 < gain < 2.5:
        near = {k: x for k, x in _LENGTHS.items() if 0.6 < gain * x < 1.7}
        degrees = in_units("euler", "the angles are in", degrees=np.pi / 180.0) if gain < 0.1 else []
        raise WrongUnit(
            f"{said.format('less' if gain > 1.0 else 'more')}{gain:.3g} times as much acceleration as tilt.",
            *in_units("position", "the position is in", **near),
            *degrees,
        )


def _compare(late: Array, early: Array, dt: float, moving: Mask) -> tuple[float, float, float]:
    """How well ``late`` follows ``early``, at the best lag: correlation over all axes, factor, and the lag [s]."""
    reach = round(MAX_LAG / dt)
    early = np.where(moving[:, None], early - early[moving].mean(0), 0.0)
    late = np.where(moving[:, None], late - late[moving].mean(0), 0.0)
    sizes = np.linalg.norm(late), np.linalg.norm(early)
    if min(sizes) == 0.0:
        return 0.0, 1.0, 0.0
    padded = np.pad(late, ((reach, reach), (0, 0)))
    products = np.sum([np.convolve(padded[:, k], early[::-1, k], "valid") for k in range(late.shape[1])], 0)
    best = int(np.argmax(products))
    shift = 0.0
    if 0 < best < len(products) - 1:  # the top of the parabola through three values
        a, b, c = products[best - 1 : best + 2]
        shift = 0.5 * (a - c) / (a - 2.0 * b + c) if a - 2.0 * b + c < 0.0 else 0.0
    return float(products[best] / (sizes[0] * sizes[1])), float(sizes[0] / sizes[1]), float((best - reach + shift) * dt)
