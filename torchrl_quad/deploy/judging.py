"""Judge flights as the package's own evaluation does, from the contract and the trajectory, in numpy.

A flight is a mapping of arrays: ``position`` and ``velocity`` (n, time + 1, 3), of which the first is the start, and
the ``target`` (n, 3), ``phase`` (n, 1) or ``gate`` (n, 1) that it starts with, by the rule of the contract's task.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy.tasks import Curve
from torchrl_quad.errors import UserValueError

Array = NDArray[np.float64]
Flight = Mapping[str, NDArray[Any]]

# By task: the metric that says how precisely it was done, how it is summed up over episodes, its unit and its scale.
PRECISION = {
    "hovering": ("position_error", np.nanmedian, "cm", 100.0),
    "tracking": ("tracking_rmse", np.nanmedian, "cm", 100.0),
    "landing": ("landing_speed", np.nanmean, "m/s", 1.0),
    "racing": ("gates_passed", np.nanmean, "gates", 1.0),
}


def endings(
    contract: Mapping[str, Any], position: Array, velocity: Array
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which states (..., 3) are crashes, and which end the episode because the task is done; each (...)."""
    box, task = contract["safety"]["position"], contract["task"]
    (x0, y0, z0), (x1, y1, z1) = box["low"], box["high"]
    x, y, z = np.moveaxis(position, -1, 0)
    inside = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1) & (z > z0) & (z < z1)  # nothing that is not a number
    done = np.zeros(inside.shape, bool)
    if task["name"] == "landing":
        limits = task["criteria"]
        aside = np.abs((position - task["target"])[..., :2]).max(-1)
        slow = np.linalg.norm(velocity, axis=-1) <= limits["speed"]
        done = (z <= limits["height"]) & (aside <= limits["radius"]) & slow
    return ~inside & ~done, done


def episode_steps(contract: Mapping[str, Any], flight: Flight) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The number of control steps of each first episode (n), and whether it ended in a crash (n)."""
    crash, done = endings(contract, flight["position"][:, 1:], flight["velocity"][:, 1:])
    over = crash | done
    most = min(over.shape[1], contract["task"]["max_episode_steps"])
    over[:, most - 1] = True
    last = over.argmax(1)
    return last + 1, np.take_along_axis(crash, last[:, None], 1)[:, 0]


def targets(contract: Mapping[str, Any], flight: Flight) -> tuple[Array, NDArray[np.bool_]]:
    """What the drone flies to (n, time + 1, 3) [m] in each state, and in which it has just passed a gate."""
    task, position = contract["task"], flight["position"]
    n, states, _ = position.shape
    passed = np.zeros((n, states), bool)
    if task["rule"] == "target":
        return np.broadcast_to(flight["target"][:, None], position.shape), passed
    if task["rule"] == "curve":
        curve = Curve(task | {"control_dt": contract["control_dt"]})
        phase = flight["phase"] + curve.step * np.arange(states)
        return curve.points(phase), passed
    gates, gate = np.array(task["gates"], float), flight["gate"][:, 0].astype(int)
    target = np.empty_like(position, float)
    target[:, 0] = gates[gate]
    for t in range(1, states):
        start, line = position[:, t - 1], position[:, t] - position[:, t - 1]
        length = np.maximum((line * line).sum(1), 1e-12)
        fraction = np.clip(((target[:, t - 1] - start) * line).sum(1) / length, 0.0, 1.0)
        miss = np.linalg.norm(start + fraction[:, None] * line - target[:, t - 1], axis=1)
        passed[:, t] = miss < task["gate_radius"]
        gate = (gate + passed[:, t]) % len(gates)
        target[:, t] = gates[gate]
    return target, passed


def judge(contract: Mapping[str, Any], flight: Flight) -> dict[str, Array]:
    """Judge the first episode of each drone as ``episode_metrics`` of the environment does.

    Returns:
        by name, each (n): ``solved`` and ``crash``, 0 or 1; and the metrics of the task that are in SI units:
        ``position_error``, ``tracking_rmse``, ``landing_speed``, ``gates_passed`` and ``lap_time``, of those it has.

    Raises:
        ValueError: the task has obstacles, which nobody can judge without them.
    """
    task, limits = contract["task"], contract["task"]["criteria"]
    if task["name"] not in PRECISION:
        raise UserValueError(f"judge knows the tasks {', '.join(PRECISION)}; {task['name']!r} has obstacles to hit.")
    steps, crash = episode_steps(contract, flight)
    target, passed = targets(contract, flight)
    number = np.arange(flight["position"].shape[1])  # of each state, 0 at the start
    flown = (number > 0) & (number <= steps[:, None])
    gap = flight["position"] - target
    distance = np.linalg.norm(gap, axis=-1)
    rows = np.arange(len(steps))
    if task["name"] == "hovering":
        window = flown & (number > steps[:, None] - round(limits["window"] / contract["control_dt"]))
        error = np.where(window, distance, 0.0).sum(1) / window.sum(1)
        metrics = {"position_error": error}
        solved = error < limits["radius"]
    elif task["name"] == "tracking":
        settled = round(limits["settling_time"] / contract["control_dt"])
        window = flown & (number > np.where(steps > settled, settled, 0)[:, None])
        error = np.sqrt(np.where(window, distance**2, 0.0).sum(1) / window.sum(1))
        metrics = {"position_error": distance[rows, steps], "tracking_rmse": error}
        solved = error < limits["radius"]
    elif task["name"] == "landing":
        speed = np.linalg.norm(flight["velocity"][rows, steps], axis=-1)
        came_down = flight["position"][rows, steps, 2] <= limits["height"]
        error = np.linalg.norm(gap[rows, steps, :2], axis=-1)
        metrics = {"position_error": error, "landing_speed": np.where(came_down, speed, math.nan)}
        _, solved = endings(contract, flight["position"][rows, steps], flight["velocity"][rows, steps])
    else:
        counted, laps = passed & flown, len(task["gates"])
        times = [np.flatnonzero(row) * contract["control_dt"] for row in counted]
        lap = [at[-1] - at[-1 - laps] if len(at) > laps else math.nan for at in times]
        metrics = {"gates_passed": counted.sum(1).astype(float), "lap_time": np.array(lap)}
        solved = metrics["gates_passed"] >= limits["gates"]
    return {"solved": (solved & ~crash).astype(float), "crash": crash.astype(float), **metrics}
