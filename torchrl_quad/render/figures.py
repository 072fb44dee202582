"""Figures as PNG files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_quad.dynamics import quaternion
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


def animate_flight(
    rollout: TensorDictBase,
    path: str | Path,
    *,
    num_envs: int = 6,
    control_dt: float = 0.02,
    fps: int = 15,
    max_seconds: float = 12.0,
) -> None:
    """Film the first episodes of a flight in real time: drones with their body axes, trails, and targets.

    Args:
        rollout: (num_envs, time), of any task whose state has a ``target``.
        path: where the GIF file goes.
        num_envs: how many environments are shown.
        control_dt: control step of the environment [s].
        fps: frames per second, at least; as many as go into whole control steps.
        max_seconds: what is filmed of a longer flight.
    """
    plt = _pyplot()
    from PIL import Image

    flight = rollout[:num_envs, : max(round(max_seconds / control_dt), 1)].detach().cpu()
    # A drone stays where its episode has ended.
    last = QuadrotorEnv.first_episode(flight).sum(1, keepdim=True) - 1
    index = torch.arange(flight.shape[1])[None, :, None].minimum(last).squeeze(-1)
    position, attitude, target = (
        flight["next", "state", name].gather(1, index.unsqueeze(-1).expand(-1, -1, k))
        for name, k in (("position", 3), ("quaternion", 4), ("target", 3))
    )
    low, high = position.flatten(0, 1).amin(0), position.flatten(0, 1).amax(0)
    center, half = 0.5 * (low + high), max(0.55 * (high - low).max().item(), 0.5)
    arm = 0.08 * half * torch.tensor([[1, 1, 0], [-1, -1, 0], [0, 0, 0], [1, -1, 0], [-1, 1, 0]], dtype=position.dtype)
    body = position.unsqueeze(-2) + quaternion.rotate(attitude.unsqueeze(-2), arm.expand(*position.shape[:2], 5, 3))

    figure = plt.figure(figsize=(4.2, 4.2), dpi=80)
    space = figure.add_axes((0.0, 0.03, 0.92, 0.95), projection="3d")
    space.set(**{f"{axis}lim": (c - half, c + half) for axis, c in zip("xyz", center.tolist(), strict=True)})
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    colors = plt.get_cmap("viridis")(np.linspace(0.05, 0.85, len(position)))
    moving = {"animated": True}  # drawn onto the axes in each frame; the axes are drawn once
    drones = [space.plot([], [], [], color=color, linewidth=2.5, **moving)[0] for color in colors]
    trails = [space.plot([], [], [], color=color, linewidth=1, alpha=0.5, **moving)[0] for color in colors]
    (targets,) = space.plot([], [], [], color=_RED, marker="*", markersize=9, linestyle="none", **moving)
    clock = space.text2D(0.04, 0.94, "", transform=space.transAxes, color=_INK, **moving)
    figure.canvas.draw()
    background = figure.canvas.copy_from_bbox(figure.bbox)
    trail = max(round(1.0 / control_dt), 1)
    stride = max(int(1.0 / (fps * control_dt)), 1)
    frames = []
    for t in range(0, position.shape[1], stride):
        for i, (drone, line) in enumerate(zip(drones, trails, strict=True)):
            drone.set_data_3d(*body[i, t].T)
            line.set_data_3d(*position[i, max(t - trail, 0) : t + 1].T)
        targets.set_data_3d(*target[:, t].T)
        clock.set_text(f"{control_dt * (t + 1):.1f} s")
        figure.canvas.restore_region(background)
        for artist in (*trails, targets, *drones, clock):
            figure.draw_artist(artist)
        frames.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3]))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=1000 * stride * control_dt, loop=0)
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
