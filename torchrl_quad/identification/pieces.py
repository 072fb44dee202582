"""Which pieces of a log are in flight, and without gaps, impacts and jumps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from torchrl_quad.deploy.frames import px4
from torchrl_quad.identification.errors import GapsTooLarge, NoFlight, WrongFrame
from torchrl_quad.identification.signals import Array, Mask, runs

OFF = 0.02  # mean command of motors that stand
_CHUNK = 20_000  # samples whose medians are taken together
REST = 0.2  # [s] and [m/s]: how long and how slowly a drone stands


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
    at: Mapping[str, Array], valid: Mask, dt: float, name: str, clearance: float, max_gap: float, min_duration: float
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
            "Give the log of a flight.",
            *([{"clearance": round(0.5 * rise, 3)}] if rise > 0.02 else []),
        )
    cut, notes = broken(at, flying, dt)
    airborne = flying & ~cut
    pieces = tuple((int(start), int(stop)) for start, stop in runs(airborne & valid, min_duration, dt))
    if not pieces:
        longest = float(max((stop - start for start, stop in runs(airborne & valid)), default=0)) * dt
        shorter = [{"min_duration": np.floor(10.0 * longest) / 10.0}] if longest >= 0.2 else []
        if len(runs(airborne, min_duration, dt)):
            raise GapsTooLarge(
                f"{name}: gaps leave no piece of {min_duration:g} s of its {airborne.sum() * dt:.1f} s in flight. Give "
                "a log with fewer gaps.",
                *({"max_gap": x} for x in (0.1, 0.15, 0.25) if x > max_gap),
                *shorter,
            )
        raise NoFlight(
            f"{name} is not a flight: in the air for {airborne.sum() * dt:.2f} s in all, and never for "
            f"{min_duration:g} s at a time. Give the log of a longer flight.",
            *shorter,
        )
    first, last = pieces[0][0], pieces[-1][1]
    low = (~flying)[first:last].sum() * dt
    total = sum(stop - start for start, stop in pieces) * dt
    short = (airborne & valid).sum() * dt - total
    above = f"{clearance:g} m above the ground"
    told = {
        f"take-off: cut out up to {first * dt:.2f} s, {above}": resting[:first].any(),
        f"landing: cut out from {last * dt:.2f} s, {above}": resting[last:].any(),
        "the log holds no stand on the ground, so contact with it could not be looked for by height": not resting.any(),
        f"{low:.2f} s between take-off and landing are within {clearance:g} m of the ground: cut out": low,
        f"{short:.2f} s in flight were left out: they come in pieces shorter than {min_duration:g} s": short > dt / 2.0,
        f"{total:.2f} s of {len(z) * dt:.2f} s are in flight, in {len(pieces)} piece(s)": True,
    }
    return pieces, [*notes, *(note for note, holds in told.items() if holds)]


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
            f"{name}: z falls when the drone takes off, from {heights[0]:.2f} to {z.min():.2f} m, so z points down.",
            {"convention": px4(), "when": "the log is in NED and FRD"},
            {"quantity": "position", "factor": (1.0, 1.0, -1.0), "when": "only z points down"},
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
