"""Does a log mean what its columns claim, as each follows from others, and which pieces of it are in flight?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from torchrl_quad.identification.errors import GapsTooLarge, NoFlight, WrongFrame, WrongQuaternion, WrongUnit
from torchrl_quad.identification.layouts import G
from torchrl_quad.identification.signals import Array, Mask, Signal, body_rates, runs, slope, smooth
from torchrl_quad.rotations import conjugate, rotate, rotate_inverse

MAX_LAG = 0.3  # [s] between streams
CALM = 0.1  # [rad/s]: slower rotations are lost in the noise of motion capture
SURE = 0.05  # how much better a hypothesis must correlate than the log as it is given
OFF = 0.02  # mean command of motors that stand
_CHUNK = 20_000  # samples whose medians are taken together
REST = 0.2  # [s] and [m/s]: how long and how slowly a drone stands
FRD = np.array([1.0, -1.0, -1.0])
_FIXES = {  # by what may be wrong
    "from world to body": "conjugate it: Columns(names, scale=(1, -1, -1, -1)), whose second to fourth are x y z",
    "scalar last": "name its columns in the order w x y z",
    "scalar first": "name its columns in the order x y z w, as the convention in use expects them",
}
_FULL = {101.0: "scale=1 / 100", 2600.0: "scale=1e-3, offset=1000", 65535.5: "scale=1 / 65535"}  # by the largest


def check_motors(signal: Signal) -> list[str]:
    """Refuse motor commands that are counts, pulses or percents; commands just outside of 0 to 1 get a note."""
    low, high = signal.values.min(), signal.values.max()
    if low >= -0.01 and high <= 1.01:
        return [f"{signal} reaches {low:.3f} to {high:.3f}: clipped to 0 to 1"] if low < 0.0 or high > 1.0 else []
    guess = next((text for full, text in _FULL.items() if high <= full), "scale=1 / FULL")
    raise WrongUnit(
        f"{signal} runs from {low:.4g} to {high:.4g}, and must run from 0 to 1, the full command. "
        f'Write columns={{"motor_command": Columns({signal.columns!r}, {guess})}}.'
    )


def check_quaternion(signal: Signal) -> list[str]:
    """Refuse quaternions that are not of unit length; a note if only some are, as of a tracker that lost the drone."""
    norm = np.linalg.norm(signal.values, axis=-1)
    off = np.abs(norm - 1.0) > 0.05
    if off.mean() > 0.01:
        raise WrongQuaternion(
            f"{off.mean():.0%} of {signal} are not of length 1; the median is {np.median(norm):.3g}. Name the four "
            "columns of one quaternion, scalar first, or scale them."
        )
    return [f"{off.sum()} samples of {signal} are not of length 1; they count as missing"] if off.any() else []


def check_velocity(at: Mapping[str, Array], signals: Mapping[str, Signal], dt: float, moving: Mask) -> None:
    """Refuse a position or velocity in other units, and a velocity that is not the derivative of the position."""
    derived = smooth(slope(at["position"], dt), dt)
    speed = np.linalg.norm(derived[moving], axis=-1)
    place = signals["position"]
    if np.percentile(speed, 99) > 100.0:
        raise WrongUnit(
            f"By {place} the drone flies at {np.percentile(speed, 99):.3g} m/s. Is it in millimetres? Then write "
            f'columns={{"position": Columns({place.columns!r}, scale=1e-3)}}, and the same for the velocity.'
        )
    signal = signals.get("velocity")
    if signal is None or speed.std() + speed.mean() < 0.05:
        return
    given = smooth(at["velocity"], dt)
    fit, factor, _ = _compare(given, derived, dt, moving)
    if not 0.5 < factor < 2.0:
        what = "millimetres" if factor < 0.01 else "other units"
        raise WrongUnit(
            f"{signal} is {factor:.3g} times the derivative of {place}: one of them, or the clock, is in {what}. Write "
            f'columns={{"position": Columns({place.columns!r}, scale=1e-3)}} for millimetres.'
        )
    body, _, _ = _compare(smooth(rotate(at["quaternion"], at["velocity"]), dt), derived, dt, moving)
    if body > fit + 0.02 and body > 0.9:
        raise WrongFrame(
            f"{signal} fits the derivative of {place} in the body frame (correlation {body:.2f}) and not in the world "
            f'frame ({fit:.2f}). Name it "velocity_body" in columns: it is then turned into the world frame.'
        )
    if fit < 0.7:
        raise WrongFrame(
            f"{signal} does not follow {place}: its correlation with the derivative is {fit:.2f}. Name columns of one "
            "world frame, or leave the velocity out: it is then derived from the position."
        )


def check_specific_force(at: Mapping[str, Array], signals: Mapping[str, Signal], moving: Mask) -> None:
    """Refuse an accelerometer in g, or of a body with z down."""
    if "acceleration" not in at:
        return
    signal, force = signals["acceleration"], at["acceleration"][moving]
    length = float(np.median(np.linalg.norm(force, axis=-1)))
    if not 4.0 < length < 40.0:
        scale = "9.80665" if 0.4 < length < 4.0 else "9.80665e-3" if 400.0 < length < 4000.0 else "..."
        raise WrongUnit(
            f"In flight {signal} has a median length of {length:.3g} m/s^2, and a drone that hovers measures 9.8. "
            f'Is it in g? Then write columns={{"acceleration": Columns({signal.columns!r}, scale={scale})}}.'
        )
    if np.median(force[:, 2]) < -0.5 * G:
        raise WrongFrame(
            f"In flight {signal} measures {np.median(force[:, 2]):.2f} m/s^2 along z, and in our body frame, z up, a "
            "drone that hovers measures +9.8. If the log is in NED and FRD, write convention=frames.px4()."
        )


def check_rates(at: Mapping[str, Array], signals: Mapping[str, Signal], dt: float, moving: Mask) -> str:
    """Compare the gyro with the derivative of the attitude under every convention, and note how late it is."""
    q, given = at["quaternion"], signals["quaternion"]
    last, first = np.roll(q, 1, -1), np.roll(q, -1, -1)
    hypotheses = {
        "as given": q,
        "from world to body": conjugate(q),
        "scalar last": last,
        "scalar last, from world to body": conjugate(last),
        "scalar first": first,
        "scalar first, from world to body": conjugate(first),
    }
    if "angular_velocity" not in signals:
        _check_by_thrust(at, given, hypotheses, dt, moving)
        return "no gyro: angular_velocity was derived from the attitude"
    signal, gyro = signals["angular_velocity"], at["angular_velocity"]
    right = smooth(body_rates(q, dt), dt)
    turning = float(np.sqrt((right[moving] ** 2).mean()))
    calm = f"{signal} was not checked: the flight turns too slowly ({turning:.2f} rad/s)"
    if turning < CALM / 5.0:
        return calm
    trials = {name: (smooth(body_rates(h, dt), dt), smooth(gyro, dt)) for name, h in hypotheses.items()}
    trials["body y right, z down"] = (right, smooth(gyro * FRD, dt))
    trials["in the world frame"] = (right, smooth(rotate_inverse(q, gyro), dt))
    fits = {name: _compare(b, a, dt, moving) for name, (a, b) in trials.items()}
    fit, factor, lag = fits["as given"]
    best = max(fits, key=lambda name: fits[name][0])
    if fits[best][0] > max(0.5, fit + SURE):
        told = f"{signal} correlates with the derivative of {given} by {fit:.2f} as given, and by {fits[best][0]:.2f}"
        if best in hypotheses:
            raise WrongQuaternion(
                f"{told} if the quaternion is {best}. We need w x y z, from body to world: {_fix(best)}."
            )
        if best == "in the world frame":
            raise WrongFrame(f"{told} if the gyro is in the world frame. Name the body rates, or leave them out.")
        raise WrongFrame(
            f"{told} if the gyro is of a body with y right and z down. Write scale=(1, -1, -1) in its Columns, or "
            "convention=frames.px4() if all of the log is in NED and FRD."
        )
    for unit, size, scale in (("degrees", 57.3, "np.pi / 180"), ("milliradians", 1000.0, "1e-3")):
        if size / 3.0 < factor < 3.0 * size and fit > 0.2:
            raise WrongUnit(
                f"{signal} is {factor:.3g} times the derivative of {given}: it is in {unit}/s. Write "
                f'columns={{"angular_velocity": Columns({signal.columns!r}, scale={scale})}}.'
            )
    if turning < CALM:
        return calm
    if fit < 0.5:
        raise WrongFrame(
            f"{signal} does not follow {given}: their correlation is {fit:.2f} at best, also if the quaternion is "
            "scalar last or inverse, or the gyro in another frame. Name columns that belong together."
        )
    if not 1.0 / 3.0 < factor < 3.0:
        raise WrongUnit(
            f"{signal} is {factor:.3g} times the derivative of {given}. Give its unit by Columns(names, scale=...)."
        )
    return f"{signal} fits the attitude: correlation {fit:.2f}, {1000.0 * lag:+.0f} ms late"


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
    if lean[best] + fits[best] > lean["as given"] + fits["as given"] + 6.0 * SURE and lean[best] > 0.5:
        raise WrongQuaternion(
            f"{given} leans where the drone accelerates if it is {best} (correlation {lean[best]:.2f}), and not as "
            f"given ({lean['as given']:.2f}). We need w x y z, from body to world: {_fix(best)}."
        )


def _fix(hypothesis: str) -> str:
    return ", and ".join(_FIXES[part] for part in hypothesis.split(", "))


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


def motors_on(motors: Array, dt: float, name: str) -> tuple[Mask, Mask]:
    """When the motors carry the drone, and when they stand or idle for longer than a moment."""
    level = motors.mean(-1)
    full = float(np.percentile(level, 95))
    if full < OFF:
        raise NoFlight(
            f"{name} is not a flight: the mean motor command is below {OFF:g} for 95 % of the time. Give the log of a "
            "flight, or name the right motor columns."
        )
    idle = _long(level < max(OFF, 0.3 * full), REST, dt)
    return ~idle, idle


def find_pieces(
    at: Mapping[str, Array], valid: Mask, dt: float, name: str, clearance: float, min_duration: float
) -> tuple[tuple[tuple[int, int], ...], list[str]]:
    """Pieces (start, stop) in flight without gaps, and notes.

    The drone flies where its motors run and it is more than ``clearance`` above where it stood, or will stand next.
    """
    carried, idle = motors_on(at["motor_command"], dt, name)
    z = at["position"][:, 2]
    resting = _long(idle & (np.linalg.norm(at["velocity"], axis=-1) < REST), REST, dt)
    flying = carried & ~_near_ground(z, resting, clearance, name)
    if not flying.any():
        rise = (z - np.median(z[resting])).max()
        raise NoFlight(
            f"{name} is not a flight: it rises {rise:.3f} m at most above where it stood, and never {clearance:g} m. "
            "Give the log of a flight, or a smaller clearance."
        )
    cut, notes = broken(at, flying, dt)
    airborne = flying & ~cut
    pieces = tuple((int(start), int(stop)) for start, stop in runs(airborne & valid, min_duration, dt))
    if not pieces:
        if len(runs(airborne, min_duration, dt)):
            raise GapsTooLarge(
                f"{name}: gaps leave no piece of {min_duration:g} s of its {airborne.sum() * dt:.1f} s in flight. Give "
                "a log with fewer gaps, a larger max_gap, or a smaller min_duration."
            )
        raise NoFlight(
            f"{name} is not a flight: in the air for {airborne.sum() * dt:.2f} s in all, and never for "
            f"{min_duration:g} s at a time. Give the log of a longer flight, or a smaller min_duration."
        )
    first, last = pieces[0][0], pieces[-1][1]
    if resting[:first].any():
        notes.append(f"take-off: cut out up to {first * dt:.2f} s, {clearance:g} m above the ground")
    if resting[last:].any():
        notes.append(f"landing: cut out from {last * dt:.2f} s, {clearance:g} m above the ground")
    if not resting.any():
        notes.append("the log holds no stand on the ground, so contact with it could not be looked for by height")
    low = (~flying)[first:last].sum() * dt
    if low:
        notes.append(f"{low:.2f} s between take-off and landing are within {clearance:g} m of the ground: cut out")
    total = sum(stop - start for start, stop in pieces) * dt
    short = (airborne & valid).sum() * dt - total
    if short > dt / 2.0:
        notes.append(f"{short:.2f} s in flight were left out: they come in pieces shorter than {min_duration:g} s")
    notes.append(f"{total:.2f} s of {len(z) * dt:.2f} s are in flight, in {len(pieces)} piece(s)")
    return pieces, notes


def _near_ground(z: Array, resting: Mask, clearance: float, name: str) -> Mask:
    """From each stand until the drone has risen by ``clearance``, back from the next one likewise, and in between
    whenever it is that near to the lower of the two."""
    low = resting.copy()
    stands = runs(resting)
    heights = [float(np.median(z[start:stop])) for start, stop in stands]
    begins, ends = [0, *(stop for _, stop in stands)], [*(start for start, _ in stands), len(z)]
    away = []
    for k, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        around = heights[max(k - 1, 0) : k + 1]
        part = z[begin:end]
        if not around or not len(part):
            continue
        low[begin:end] = part < min(around) + clearance
        stood = [(heights[k - 1], 1)] if k else []
        stood += [(heights[k], -1)] if k < len(stands) else []
        for height, order in stood:
            rise = part[::order] - height
            left = np.flatnonzero(np.abs(rise) > clearance)
            away += [rise[left[0]] > 0.0] if len(left) else []
            up = np.flatnonzero(rise > clearance)
            low[begin:end][::order][: up[0] if len(up) else len(part)] = True
    if away and not any(away):
        raise WrongFrame(
            f"{name}: z falls when the drone takes off, from {heights[0]:.2f} to {z.min():.2f} m, so z points down. If "
            "the log is in NED and FRD, write convention=frames.px4()."
        )
    return low


def broken(at: Mapping[str, Array], flying: Mask, dt: float) -> tuple[Mask, list[str]]:
    """Around spikes of the specific force, which no rotor makes, and where the tracker or the estimator jumps; and
    what was found."""
    cut = np.zeros(len(flying), bool)
    notes: list[str] = []
    if not flying.any():
        return cut, notes
    half = max(1, round(0.05 / dt))
    for name, least, unit, what, after in (
        ("acceleration", 15.0, " m/s^2", "an impact", 0.3),
        # From sample to sample, beyond what a drone that accelerates by 50 m/s^2 or 200 rad/s^2 adds.
        ("position", 0.05 + 50.0 * dt**2, " m", "a jump of the position", 0.1),
        ("quaternion", 0.1 + 100.0 * dt**2, "", "a jump of the quaternion", 0.1),
    ):
        if name not in at:
            continue
        x = at[name] if name == "acceleration" else np.diff(at[name], axis=0, prepend=at[name][:1])
        windows = sliding_window_view(np.pad(x, ((half, half), (0, 0)), mode="edge"), 2 * half + 1, 0)
        middle = [np.median(windows[k : k + _CHUNK], -1) for k in range(0, len(x), _CHUNK)]  # which copies its windows
        spike = np.linalg.norm(x - np.concatenate(middle), axis=-1)
        limit = max(least, 10.0 * 1.4826 * float(np.median(spike[flying])))
        end = 0
        for start, stop in runs(flying & (spike > limit)):
            if start >= end:
                notes.append(f"{what}, of {spike[start:stop].max():.2g}{unit}, at {start * dt:.2f} s: cut out")
            end = stop + round(after / dt)
            cut[max(0, start - round(0.1 / dt)) : end] = True
    return cut, notes


def _long(mask: Mask, shortest: float, dt: float) -> Mask:
    kept = np.zeros_like(mask)
    for start, stop in runs(mask, shortest, dt):
        kept[start:stop] = True
    return kept
