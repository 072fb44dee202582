"""Which pieces of a log are in flight: the ground, take-off, landing, impacts and gaps are cut out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from torchrl_quad.identification.errors import GapsTooLarge, NoFlight, WrongFrame
from torchrl_quad.identification.streams import Array

Mask = NDArray[np.bool_]
OFF = 0.02  # mean command of motors that stand
REST = 0.2  # [s] and [m/s]: how long and how slowly a drone stands


def motors_on(motors: Array, dt: float, name: str) -> tuple[Mask, Mask]:
    """When the motors carry the drone, and when they stand or idle for longer than a moment.

    Raises:
        NoFlight: they never turn.
    """
    level = motors.mean(-1)
    full = float(np.percentile(level, 95))
    if full < OFF:
        raise NoFlight(
            f"{name} is no flight: the mean motor command is below {OFF:g} for 95 % of the time. Give the log of a "
            "flight, or name the right motor columns."
        )
    idle = _long(level < max(OFF, 0.3 * full), REST, dt)
    return ~idle, idle


def find_pieces(
    at: Mapping[str, Array],
    valid: Mask,
    dt: float,
    name: str,
    clearance: float,
    min_duration: float,
) -> tuple[tuple[tuple[int, int], ...], list[str]]:
    """Pieces (start, stop) in flight without gaps, and notes.

    The drone stands where its motors idle and it does not move. It flies where its motors run and it is more than
    ``clearance`` above the place where it stood before or will stand next, whichever is nearer in time.

    Raises:
        NoFlight: it never does.
        WrongFrame: it goes down from where it stood.
        GapsTooLarge: it does, but never for ``min_duration`` without a gap.
    """
    carried, idle = motors_on(at["motor_command"], dt, name)
    z = at["position"][:, 2]
    resting = _long(idle & (np.linalg.norm(at["velocity"], axis=-1) < REST), REST, dt)
    flying = carried
    if resting.any():
        floor = _floor(z, resting)
        if np.median((z - floor)[carried]) < -0.2:
            raise WrongFrame(
                f"{name}: z falls from {np.median(floor):.2f} to {z[carried].min():.2f} m when the motors run, so z "
                "points down. If the log is in NED and FRD, write convention=frames.px4()."
            )
        flying = carried & (z > floor + clearance)
        if not flying.any():
            raise NoFlight(
                f"{name} is no flight: it rises {(z - floor).max():.3f} m at most above where it stood, and never "
                f"{clearance:g} m. Give the log of a flight, or a smaller clearance."
            )
    notes: list[str] = []
    airborne = flying & ~_impacts(at.get("acceleration"), flying, dt, notes)
    pieces = _runs(airborne & valid, min_duration, dt)
    if not pieces:
        if _runs(airborne, min_duration, dt):
            raise GapsTooLarge(
                f"{name}: gaps leave no piece of {min_duration:g} s of its {airborne.sum() * dt:.1f} s in flight. Give "
                "a log with fewer gaps, a larger max_gap, or a smaller min_duration."
            )
        raise NoFlight(
            f"{name} is no flight: in the air for {airborne.sum() * dt:.2f} s in all, and never for {min_duration:g} s "
            "at a time. Give the log of a longer flight, or a smaller min_duration."
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


def _floor(z: Array, resting: Mask) -> Array:
    """The height where the drone stands at the nearest rest in time."""
    runs = _runs(resting, 0.0, 1.0)
    heights = np.array([np.median(z[start:stop]) for start, stop in runs])
    # Between two rests the nearer one counts: half of the way each.
    borders = [(runs[k][1] + runs[k + 1][0]) // 2 for k in range(len(runs) - 1)]
    return heights[np.searchsorted(np.array(borders, int), np.arange(len(z)), side="right")]


def _impacts(force: Array | None, flying: Mask, dt: float, notes: list[str]) -> Mask:
    """A tenth of a second before to three after each spike of the specific force, which no rotor makes."""
    hit = np.zeros(len(flying), bool)
    if force is None or not flying.any():
        return hit
    half = max(1, round(0.05 / dt))
    windows = sliding_window_view(np.pad(force, ((half, half), (0, 0)), mode="edge"), 2 * half + 1, 0)
    spike = np.linalg.norm(force - np.median(windows, -1), axis=-1)
    limit = max(15.0, 10.0 * 1.4826 * float(np.median(spike[flying])))
    for start, stop in _runs(flying & (spike > limit), 0.0, dt):
        low, high = max(0, start - round(0.1 / dt)), stop + round(0.3 / dt)
        if not hit[low:high].any():
            notes.append(f"impact of {spike[start:stop].max():.0f} m/s^2 at {start * dt:.2f} s: cut out")
        hit[low:high] = True
    return hit


def _runs(mask: Mask, shortest: float, dt: float) -> tuple[tuple[int, int], ...]:
    """Where the mask holds without a break, as (start, stop), for ``shortest`` [s] or longer."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))).reshape(-1, 2)
    return tuple((int(a), int(b)) for a, b in edges if (b - a) * dt >= shortest - 1e-9)


def _long(mask: Mask, shortest: float, dt: float) -> Mask:
    kept = np.zeros_like(mask)
    for start, stop in _runs(mask, shortest, dt):
        kept[start:stop] = True
    return kept
