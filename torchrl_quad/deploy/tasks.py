"""What a task computes outside the network, for one drone, in numpy: where the target is, and how the flight goes on.

A rule is built from the section ``task`` of a contract. :class:`~torchrl_quad.deploy.Bundle` resets it, advances it
once in each control step after the first, and asks it for its entries of the observation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_quad.errors import UserValueError, shown

Vector = NDArray[np.float64]
MOST = 1e6  # of a number that says where a flight starts in the task


class Rule(Protocol):
    """The protocol of all rules. ``reset`` takes by name where a flight starts in the task."""

    def reset(self) -> None:
        """Start anew."""

    def advance(self, before: Vector | None, position: Vector | None) -> None:
        """One control step later; from where the drone was to where it is (3) [m], None where that is unknown."""

    def inputs(self, position: Vector) -> dict[str, Vector]:
        """What the task adds to the observation of a drone at a position (3) [m]: vectors by name, world frame."""


class Target:
    """A target that stays where it is: hovering and landing."""

    def __init__(self, task: Mapping[str, Any]) -> None:
        self.task = task
        self.reset()

    def reset(self, target: ArrayLike | None = None) -> None:
        """Start anew, with a target (3) [m] of your own, or that of the contract."""
        self.target = _point("target", self.task["target"] if target is None else target)

    def advance(self, before: Vector | None, position: Vector | None) -> None:
        """Nothing changes."""

    def inputs(self, position: Vector) -> dict[str, Vector]:
        """``to_target``: target - position (3) [m]."""
        return {"to_target": self.target - position}


class Course:
    """A target to fly to at a commanded speed: the forest."""

    def __init__(self, task: Mapping[str, Any]) -> None:
        self.task = task
        self.reset()

    def reset(self, target: ArrayLike | None = None, speed: float | None = None) -> None:
        """Start anew, with a target (3) [m] and a speed [m/s] of your own, or those of the contract."""
        target = _point("target", self.task["target"] if target is None else target)
        speed = _number("speed", self.task["speed"] if speed is None else speed, "a positive number [m/s]")
        if not speed > 0.0:
            raise UserValueError(f"speed must be a positive number [m/s], got {shown(speed)}.")
        self.target, self.speed = target, speed

    def advance(self, before: Vector | None, position: Vector | None) -> None:
        """Nothing changes."""

    def inputs(self, position: Vector) -> dict[str, Vector]:
        """``command`` (3) [m/s]: the speed, in the direction of the target, and less within 1 m of it."""
        way = self.target - position
        return {"command": self.speed / max(math.sqrt(float(way @ way)), 1.0) * way}


class Curve:
    """A point that moves along a periodic curve: tracking.

    The curve is a sum of harmonics of the phase: offset + sum over k of cosine[k] cos(k phase) + sine[k] sin(k phase).
    """

    def __init__(self, task: Mapping[str, Any]) -> None:
        self.offset = np.array(task["offset"], float)
        self.amplitudes = np.array([*task["cosine"], *task["sine"]], float).reshape(-1, 3)
        self.harmonics = np.arange(1, len(task["cosine"]) + 1)
        self.rate = 2 * math.pi / task["period"]
        self.step = self.rate * task["control_dt"]
        self.ahead = self.rate * task["lookahead_interval"] * np.arange(1, task["lookahead"] + 1)
        self.reset()

    def reset(self, phase: float = 0.0) -> None:
        """Start anew, where the point has a phase [rad]."""
        self.phase = _number("phase", phase, "a finite number [rad]") % (2 * math.pi)

    def advance(self, before: Vector | None, position: Vector | None) -> None:
        """The point moves on, whatever the drone does."""
        self.phase = (self.phase + self.step) % (2 * math.pi)

    def points(self, phase: Vector) -> Vector:
        """The points (n, 3) [m] of the curve at phases (n) [rad]."""
        angles = np.multiply.outer(phase, self.harmonics)
        return self.offset + np.concatenate((np.cos(angles), np.sin(angles)), -1) @ self.amplitudes

    def inputs(self, position: Vector) -> dict[str, Vector]:
        """``to_points``: the next points of the curve - position (3 n) [m], nearest first."""
        return {"to_points": (self.points(self.phase + self.ahead) - position).ravel()}


class Gates:
    """Gates that are passed in their order, round after round: racing.

    A gate is passed when the straight line between the positions of two control steps comes nearer to its centre than
    its radius. In flight these are the measured positions; an environment counts from the true ones.
    """

    def __init__(self, task: Mapping[str, Any]) -> None:
        self.gates, self.radius = np.array(task["gates"], float), float(task["gate_radius"])
        self.reset()

    def reset(self, gate: int = 0) -> None:
        """Start anew, with the index of the gate to pass first."""
        wanted = f"a whole number from 0 to {len(self.gates) - 1}"
        number = _number("gate", gate, wanted)
        if number not in range(len(self.gates)):
            raise UserValueError(f"gate must be {wanted}, got {shown(gate)}.")
        self.gate, self.passed = int(number), 0

    def advance(self, before: Vector | None, position: Vector | None) -> None:
        """Count a gate that was passed on the way."""
        if before is None or position is None:
            return
        line, centre = position - before, self.gates[self.gate]
        length = max(float(line @ line), 1e-12)
        fraction = min(max(float((centre - before) @ line) / length, 0.0), 1.0)
        gap = before + fraction * line - centre
        if float(gap @ gap) < self.radius**2:
            self.gate, self.passed = (self.gate + 1) % len(self.gates), self.passed + 1

    def inputs(self, position: Vector) -> dict[str, Vector]:
        """``to_gate`` and ``to_gate_after`` (3) [m]: centre of the next gate, and of the one after it, - position."""
        after = (self.gate + 1) % len(self.gates)
        return {"to_gate": self.gates[self.gate] - position, "to_gate_after": self.gates[after] - position}


# By rule: what ``reset`` takes, entries of the environment's state and of a bundle's starts.
PROGRESS = {"target": ("target",), "curve": ("phase",), "gates": ("gate",), "course": ("target", "speed")}
RULES: dict[str, type[Target] | type[Course] | type[Curve] | type[Gates]] = {
    "target": Target,
    "course": Course,
    "curve": Curve,
    "gates": Gates,
}


def progress_of(rule: str, start: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """What the ``reset`` of a rule takes, from the entries of one start: vectors, and numbers."""
    return {name: start[name] if start[name].size > 1 else start[name].item() for name in PROGRESS[rule]}


def _number(name: str, value: Any, wanted: str) -> float:
    if isinstance(value, int | float | np.number) and not isinstance(value, bool) and abs(value) <= MOST:
        return float(value)
    raise UserValueError(f"{name} must be {wanted}, got {shown(value)}.")


def _point(name: str, value: ArrayLike) -> Vector:
    try:
        point = np.array(value)
        fits = point.dtype.kind in "fiu" and point.shape == (3,) and bool((np.abs(point) <= MOST).all())
    except Exception:  # whatever the conversion of somebody else's type raises
        fits = False
    if not fits:
        raise UserValueError(f"{name} must be three finite numbers [m], of at most {MOST:g}, got {shown(value)}.")
    return point.astype(float)
