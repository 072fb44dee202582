"""Do the motors of a log hold commands, and in which order?"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_quad.identification.checks import BACKWARD, MAX_LAG
from torchrl_quad.identification.errors import WrongMotors, WrongUnit
from torchrl_quad.identification.pieces import OFF
from torchrl_quad.identification.signals import Array, Signal, convolved, slope, smooth

LEAST_HOVER = 0.1  # of the full command: one that hovers with less has ten times the thrust that it needs, or more
_THRUSTS = ". If they are thrusts, put sqrt(thrust / full thrust) into the file instead, and leave battery_voltage out"
_COMMANDS = (  # factor, offset, least, largest, and what they are
    (0.01, 0.0, 0.0, 101.0, "percents"),
    (1e-3, 1000.0, 700.0, 2600.0, "pulses from 1000 to 2000 us"),
    (1.0 / 255.0, 0.0, 0.0, 255.5, "counts of 8 bits"),
    (5e-4, 0.0, 0.0, 2000.5, "DShot commands up to 2000"),
    (1.0 / 1999.0, 48.0, 48.0, 2047.5, "DShot values from 48 to 2047"),
    (1.0 / 65535.0, 0.0, 0.0, 65535.5, "counts of 16 bits"),
)
_X = np.array([[1, 1, -1, -1], [-1, 1, 1, -1], [1, -1, 1, -1]])  # roll, pitch, yaw by our motors, yaw either way
_PLUS = np.array([[0, 1, 0, -1], [-1, 0, 1, 0], [1, -1, 1, -1]])  # of rotors in front, left, behind and right
_ORDERS = list(itertools.permutations(range(4)))
_CORNERS = ("front left", "back left", "back right", "front right")


def check_motors(signal: Signal) -> list[str]:
    """Refuse motor commands that are counts, pulses, percents or speeds; a note on some just outside of 0 to 1."""
    low, high = float(signal.values.min()), float(signal.values.max())
    full = float(np.percentile(signal.values.mean(-1), 95))
    below = signal.values < -0.01
    if -1.01 < low < -0.01 and high <= 1.03 and np.ptp(signal.values[below]) < 1e-3 and full > LEAST_HOVER:
        return [f"{signal} is {low:.3g} in {below.mean():.0%} of its samples, as where motors are disarmed: taken as 0"]
    if low >= -0.01 and high <= 1.03:
        if OFF < full < LEAST_HOVER:
            raise WrongUnit(
                f"{signal} reaches {high:.3g} at most, and must run from 0 to 1, the full command: no drone flies with "
                f"so little of it. Name the commands, or say by Columns(names, scale=...) what is full{_THRUSTS}."
            )
        clipped = [f"{signal} reaches {low:.3f} to {high:.3f}: clipped to 0 to 1"] if low < 0.0 or high > 1.0 else []
        thrusts = re.search("thrust|force|newton", " ".join(signal.columns).lower())  # their course does not tell
        return clipped + ([f"{signal} count as commands, 0 to 1{_THRUSTS}"] if thrusts else [])
    begun = float(signal.values.min(where=signal.values > 0.0, initial=high))  # some are 0 until they are armed
    remedies = [
        {"quantity": signal.field, "factor": factor, "offset": offset, "when": f"they are {what}"}
        for factor, offset, least, most, what in _COMMANDS
        if least <= (begun if low == 0.0 else low) and high <= most and (full - offset) * factor > 2.0 * LEAST_HOVER
    ]
    if _turn_one_way(signal.values) and np.abs(signal.values).max() > 50.0:
        remedies.append({"quantity": signal.field, "name": "rotor_speed", "when": "they are rotor speeds in rad/s"})
    like = " or ".join(x["when"].removeprefix("they are ") for x in remedies)
    said = f"may be {like}" if like else "is like neither percents, pulses, DShot, counts nor speeds of rotors"
    said += _THRUSTS if low >= 0.0 and begun < 700.0 and high < 5000.0 else ""  # gram-force
    raise WrongUnit(
        f"{signal} runs from {low:.4g} to {high:.4g}, and must run from 0 to 1, the full command. It {said}.", *remedies
    )


def check_speeds(signal: Signal, most: float) -> list[str]:
    """Refuse rotor speeds that are none."""
    values = signal.values[np.isfinite(signal.values).all(-1)]
    if not len(values) or (_turn_one_way(values) and 20.0 < np.abs(values).max() <= most):
        return []
    raise WrongUnit(
        f"{signal} runs from {values.min():.4g} to {values.max():.4g}: speeds of rotors [rad/s] keep their sign, and "
        f"reach 20 to {most:g}.",
        {"quantity": "rotor_speed", "factor": np.pi / 30.0, "when": "they are revolutions per minute"},
    )


def _turn_one_way(values: Array) -> bool:
    least, most = values.min(0), values.max(0)
    return bool((np.minimum(np.abs(least), np.abs(most)) * (least * most < 0.0) <= 0.02 * np.abs(values).max()).all())


def check_order(
    at: Mapping[str, Array], signals: Mapping[str, Signal], dt: float, pieces: Sequence[tuple[int, int]]
) -> str:
    """Refuse motors in another order than the one in which they turn the drone, as far as the flight tells it."""
    signal, rows = signals["motor_command"], np.concatenate([np.arange(start, stop) for start, stop in pieces])
    parts = (rows, rows[: len(rows) // 2], rows[len(rows) // 2 :])  # what is chance in one half is not in the other

    command = at["motor_command"][rows]
    spread, alike = command.std(0), np.ptp(command, 1).max() < 1e-6
    turns = slope(at["angular_velocity"], dt)[rows].std(0).max() > 1.0  # which takes motors that differ
    if turns and not spread.any():
        raise WrongMotors(f"In flight {signal} never changes. Name the commands of the motors.")
    if spread.max() > 0.01 and (alike or spread.min() < 1e-3 * spread.max()):
        which = "are the same for all motors" if alike else f"do not change for the motor {_CORNERS[spread.argmin()]}"
        raise WrongMotors(f"In flight {signal} {which}. Name the commands of all four.")

    def worth_of(signs: Array, late: int = 0) -> Array:
        fits = turning_fits(np.roll(at["angular_velocity"], -late, 0), at["motor_command"], dt, parts, signs)
        return fits[..., 0] + fits[..., 1] + np.abs(fits[..., 2])  # yaw: which turn alike, not which way

    worth = worth_of(_X)
    best = int(worth[0].argmax())
    if worth[:, best].min() < 0.4:
        return f"the order of {signal} was not checked: the flight hardly tells it ({worth[0, best]:.2f} of 3)"
    plus = worth_of(_PLUS)
    if (plus.max(1) > worth.max(1) + 0.3).all():
        raise WrongMotors(
            f"{signal} turn the drone as rotors in front, left, behind and right do (correlations add up to "
            f"{plus[0].max():.2f}, and in an X to {worth[0, best]:.2f}): only rotors in an X are read."
        )
    if (worth[:, best] > worth[:, 0] + 0.15).all() and worth[0, best] > worth[0, 0] + 0.2:
        reach, step = round(MAX_LAG / dt), max(1, round(0.02 / dt))
        shifts = range(-reach, reach + 1, step)
        apart = np.array([worth_of(_X, k)[0] for k in shifts])  # a gyro on another clock
        if apart.max(0).argmax() == 0:
            late = 1000.0 * dt * shifts[int(apart[:, 0].argmax())]
            when = f"{abs(late):.0f} ms {'late' if late > 0.0 else 'early'}"
            return f"the order of the motors fits how the drone turns if its rates are {when}"
        turn = _ORDERS[best][0] if "angular_velocity" not in signals else 0  # by how many quarters, if it is a turn
        turn *= _ORDERS[best] == tuple((turn + k) % 4 for k in range(4))
        named = f"motors are named from the {_CORNERS[-turn]} on"
        points = f"x of the attitude's body points {('', 'left', 'backward', 'right')[turn]}, and must point forward"
        raise WrongMotors(
            f"{signal} explain how the drone turns less in the order front left, back left, back right, front right "
            f"(correlations about roll, pitch and yaw add up to {worth[0, 0]:.2f}) than in another "
            f"({worth[0, best]:.2f}){f': {named}, or {points}' if turn else ''}.",
            *(BACKWARD if turn == 2 else []),
            {"quantity": signal.field, "order": _ORDERS[best], "when": named if turn else ""},
        )
    others = float(np.delete(worth[0], 0).max())
    return (
        f"the order of the motors fits how the drone turns: {worth[0, 0]:.2f} of 3, and {others:.2f} in another order"
    )


def turning_fits(rates: Array, command: Array, dt: float, parts: Sequence[NDArray[np.int_]], signs: ArrayLike) -> Array:
    """How well the motors explain the angular acceleration about each axis in each order, as correlations
    (parts, 24, 3); ``signs`` (3, 4) are those of roll, pitch and yaw by each motor."""
    mixing = np.zeros((len(_ORDERS), 4, 3))  # the signs of a command in each order, about each axis
    for mix, order in zip(mixing, _ORDERS, strict=True):
        mix[list(order)] = np.transpose(signs)
    weights = np.exp(-dt / 0.04 * np.arange(max(2, round(0.2 / dt))))  # rotors follow with a lag, of 0.04 s or so
    thrusts = convolved(np.pad(command**2, ((len(weights) - 1, 0), (0, 0)), "edge"), weights / weights.sum())
    thrusts, turning = smooth(thrusts, dt, 0.08), slope(rates, dt)
    fits = []
    for rows in parts:
        late, turned = (x[rows] - x[rows].mean(0) for x in (thrusts, turning))
        size = np.einsum("pka,kl,pla->pa", mixing, late.T @ late, mixing) * (turned**2).sum(0)
        fits.append(np.einsum("pka,ka->pa", mixing, late.T @ turned) / np.sqrt(np.maximum(size, 1e-24)))
    return np.array(fits)
