"""Figures as PNG files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from tensordict import TensorDictBase

from torchrl_quad.envs import QuadrotorEnv

_INK, _BLUE, _RED = "#222222", "#2f6db5", "#c8452f"


def plot_flight(rollout: TensorDictBase, path: str | Path, *, num_envs: int = 12, control_dt: float = 0.02) -> None:
    """Draw the first episodes of a flight: paths in space with their targets, and over time how well they go.

    Args:
        rollout: (num_envs, time), of any task whose state has a ``target``; over time the metric ``gates_passed`` is
            drawn where there is one, and the distance to the target elsewhere.
        path: where the PNG file goes.
        num_envs: how many environments are drawn.
        control_dt: control step of the environment [s].
    """
    plt = _pyplot()
    flight = rollout[:num_envs].detach().cpu()
    first = QuadrotorEnv.first_episode(flight).squeeze(-1).numpy()
    position = flight["next", "state", "position"].numpy()
    start = flight["state", "position"][:, 0].numpy()
    target = flight["state", "target"].numpy()
    gates = flight.get(("next", "metrics", "gates_passed"), None)
    if gates is not None:
        label, scale, progress = "gates passed", "linear", gates.squeeze(-1).numpy()
    else:
        distance = np.linalg.norm(position - flight["next", "state", "target"].numpy(), axis=-1)
        label, scale, progress = "distance to the target [cm]", "log", 100 * distance
    time = control_dt * np.arange(1, position.shape[1] + 1)

    figure = plt.figure(figsize=(11, 4.6), layout="constrained")
    space = figure.add_subplot(1, 2, 1, projection="3d")
    over_time = figure.add_subplot(1, 2, 2)
    colors = plt.get_cmap("viridis")(np.linspace(0.05, 0.85, len(position)))
    for i, color in enumerate(colors):
        x, y, z = np.concatenate((start[i : i + 1], position[i, first[i]])).T
        space.plot(x, y, z, color=color, linewidth=1.2)
        space.scatter(*start[i], color=color, s=14)
        over_time.plot(time[first[i]], progress[i, first[i]], color=color, linewidth=1.2)
    places = np.unique(target.reshape(-1, 3).round(3), axis=0)
    if len(places) <= 64:
        space.scatter(*places.T, color=_RED, marker="*", s=140, label="target", zorder=10)
    else:  # a target that moves
        space.plot(*target[0, first[0]].T, color=_RED, linestyle="--", linewidth=1.5, label="target", zorder=10)
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="Flights from fresh starts")
    for axis in (space.xaxis, space.yaxis, space.zaxis):
        axis.set_major_locator(plt.MaxNLocator(4))
    space.legend(loc="upper left", frameon=False)
    over_time.set(xlabel="time [s]", ylabel=label, yscale=scale)
    over_time.yaxis.set_major_formatter("{x:g}")
    over_time.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def plot_learning_curve(metrics: str | Path, path: str | Path) -> None:
    """Draw how the evaluations in a ``metrics.csv`` went over training time and steps: return, success, and a metric.

    Args:
        metrics: the CSV file of a training run.
        path: where the PNG file goes.
    """
    plt = _pyplot()
    with open(metrics, newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    panels = [
        ("eval/return", "return", 1.0),
        ("eval/success", "success [%]", 100.0),
        ("eval/gates_passed", "gates passed", 1.0),
        ("eval/tracking_rmse", "median tracking error [cm]", 100.0),
        ("eval/position_error", "median error [cm]", 100.0),
    ]
    panels = [panel for panel in panels if panel[0] in columns][:3]
    figure, axes = plt.subplots(1, len(panels), figsize=(3.7 * len(panels), 3.2), layout="constrained", squeeze=False)
    for axis, (name, label, scale) in zip(axes[0], panels, strict=True):
        axis.plot(columns["time/seconds"], scale * columns[name], color=_BLUE, marker="o", markersize=3, linewidth=1.4)
        axis.set(xlabel="training time [s]", ylabel=label)
        axis.grid(alpha=0.3)
        seconds_per_step = columns["time/seconds"][-1] / columns["steps"][-1]
        upper = axis.secondary_xaxis(
            "top", functions=(lambda s, k=seconds_per_step: s / k, lambda n, k=seconds_per_step: n * k)
        )
        upper.set_xlabel("control steps", color=_INK)
        if "error" in label:
            axis.set_yscale("log")
            axis.yaxis.set_major_formatter("{x:g}")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _pyplot():
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError("Pictures need matplotlib: pip install 'torchrl_quad[render]'.") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt
