"""Figures and films as files."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.render.frames import (
    BLUE,
    INK,
    RED,
    Scene,
    bounds,
    box,
    checked,
    episode_steps,
    first_episodes,
    make_figure,
    set_box,
    shades,
)

_PAPER = {  # of figures that are as wide as a page of two columns
    "font.size": 8,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "legend.handlelength": 1.2,
    "legend.handletextpad": 0.4,
    "legend.columnspacing": 0.9,
    "legend.borderaxespad": 0.0,
    "pdf.fonttype": 42,  # fonts are embedded as TrueType, which publishers ask for
    "ps.fonttype": 42,
    "savefig.dpi": 300,  # of a PNG
}
_WIDTH = 7.16  # [inches], of a page of two columns
_BESIDE = {"left": 0.54, "right": 0.99, "top": 0.94, "bottom": 0.12, "hspace": 0.5}  # shares of a page
_COLORS = INK, BLUE, RED, "#d99a1c"


def plot_flight(rollout: TensorDictBase, path: str | Path, *, num_envs: int = 12, control_dt: float = 0.02) -> None:
    """Draw the first episodes of a flight: paths in space with their targets, and over time how well they go.

    That is the number of gates passed where there are gates, else the distance to the target, and for a task without
    targets its first metric, or the reward.

    Args:
        rollout: (num_envs, time), of any task.
        path: where the picture goes, PNG, PDF or SVG by its suffix.
        num_envs: how many environments are drawn.
        control_dt: control step of the environment [s].

    Raises:
        ValueError: the rollout has another shape or lacks the position, or ``num_envs`` is less than 1.
    """
    flight = checked(rollout, "plot_flight", num_envs, *_keys("position"))
    steps, position = episode_steps(flight), first_episodes(flight, "position").numpy()
    label, scale, lines = _progress(flight)
    name, values = next(iter(lines.items()))
    if (passed := first_episodes(flight, "gates_passed")) is not None:
        label, scale, name, values = "", "linear", "gates passed", passed.squeeze(-1).numpy()
    time = control_dt * np.arange(position.shape[1])

    figure = make_figure(figsize=(11, 4.6))
    from matplotlib.ticker import MaxNLocator

    space = figure.add_axes((0.02, 0.03, 0.42, 0.9), projection="3d")
    over_time = figure.add_axes((0.54, 0.12, 0.44, 0.83))
    for i, color in enumerate(shades(len(position))):
        flown = slice(int(steps[i]) + 1)
        space.plot(*position[i, flown].T, color=color, linewidth=1.2)
        space.scatter(*position[i, 0], color=color, s=14)
        over_time.plot(time[flown], values[i, flown], color=color, linewidth=1.2)
    target = first_episodes(flight, "target")
    if target is not None:
        _draw_targets(space, _still(target, steps), "gate" if "gate" in flight["state"] else "target")
        space.legend(loc="upper left", frameon=False)
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="Flights from fresh starts")
    for axis in (space.xaxis, space.yaxis, space.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    over_time.set(xlabel="time [s]", ylabel=f"distance {name} [m]" if label else name)
    _set_scale(over_time, scale)
    over_time.grid(alpha=0.3)
    figure.savefig(path, dpi=130)


def plot_episode(rollout: TensorDictBase, path: str | Path, *, env_index: int = 0, control_dt: float = 0.02) -> None:
    """Draw the first episode of one drone as a figure for a paper, as wide as a page of two columns (7.16 inches).

    Its path in space coloured by speed, with targets or numbered gates; and over time: the distance to the target with
    the metrics that are lengths, too (for a task without targets its metrics, or the reward), the actions, and the
    speeds of the rotors. The times at which gates are passed are marked.

    Args:
        rollout: (num_envs, time), of any task, with or without its graph.
        path: where the figure goes: PDF or SVG, whose fonts are embedded, or PNG with 300 dots per inch, by its suffix.
        env_index: which environment.
        control_dt: control step of the environment [s].

    Raises:
        ValueError: the rollout has another shape, lacks position, velocity, rotor speed or action, or matplotlib does
            not know the suffix.
        IndexError: there is no such environment.
    """
    keys = _keys("position", "velocity", "rotor_speed")
    flight = checked(rollout, "plot_episode", None, *keys, ("action",))
    if not -len(flight) <= env_index < len(flight):
        raise IndexError(f"plot_episode: env_index={env_index}, and the rollout has {len(flight)} environments.")
    flight = flight[[env_index]]
    flight = flight[:, : int(episode_steps(flight))]
    figure = make_figure(figsize=(_WIDTH, 3.4))
    from matplotlib import rc_context
    from matplotlib.ticker import MaxNLocator

    with rc_context(_PAPER):
        space = figure.add_axes((0.0, 0.2, 0.44, 0.8), projection="3d", computed_zorder=False)
        _draw_path(space, figure.add_axes((0.09, 0.12, 0.26, 0.02)), flight)
        axes = figure.subplots(3, 1, sharex=True, gridspec_kw=_BESIDE)
        times = control_dt * np.arange(flight.shape[1] + 1)
        label, scale, lines = _progress(flight)
        _draw_lines(axes[0], times, {name: x[0] for name, x in lines.items()}, label)
        _set_scale(axes[0], scale)
        actions = flight["action"][0].T.numpy()
        actions = np.concatenate((actions, actions[:, -1:]), 1)  # each lasts until the next instant
        actions = dict(zip(("thrust", "roll rate", "pitch rate", "yaw rate"), actions, strict=True))
        _draw_lines(axes[1], times, actions, "action", drawstyle="steps-post")
        speeds = {f"rotor {i + 1}": x for i, x in enumerate(first_episodes(flight, "rotor_speed")[0].T.numpy())}
        _draw_lines(axes[2], times, speeds, "rotor speed\n[rad/s]")
        if (passed := first_episodes(flight, "gates_passed")) is not None:
            for time in times[1:][passed[0, :, 0].diff() > 0]:
                for axis in axes:
                    axis.axvline(time, color=RED, linestyle=":", linewidth=0.6, zorder=0)
        axes[2].set(xlabel="time [s]", xlim=(0, times[-1]))
        for axis in axes[1:]:
            axis.yaxis.set_major_locator(MaxNLocator(4))
        figure.savefig(path)


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
        rollout: (num_envs, time), of any task.
        path: where the GIF file goes.
        num_envs: how many environments are shown.
        control_dt: control step of the environment [s].
        fps: frames per second, at least, and up to 50; as many as go into whole control steps.
        max_seconds: what is filmed of a longer flight.

    Raises:
        ValueError: the rollout has another shape or lacks the position or the quaternion, or a number is not positive.
    """
    for name, value in (("control_dt", control_dt), ("fps", fps), ("max_seconds", max_seconds)):
        if not value > 0:
            raise ValueError(f"animate_flight: {name} must be positive, got {value!r}.")
    flight = checked(rollout, "animate_flight", num_envs, *_keys("position", "quaternion"))
    flight = flight[:, : max(round(max_seconds / control_dt), 1)]
    position, attitude, target = (first_episodes(flight, name) for name in ("position", "quaternion", "target"))
    still = {} if target is None else _still(target, episode_steps(flight))
    scene = Scene(position, len(position), 336, **still)
    trail = max(round(1.0 / control_dt), 1)
    stride = max(int(1.0 / (min(fps, 50) * control_dt) + 1e-6), 1)
    instants = np.append(np.arange(0, flight.shape[1], stride), flight.shape[1])
    frames = [
        scene.draw(
            position[:, t],
            attitude[:, t],
            None if target is None else target[:, t],
            trails=position[:, max(t - trail, 0) : t + 1],
            text=f"{control_dt * t:.1f} s",
        )
        for t in instants
    ]
    from PIL import Image

    # A GIF counts in 10 ms: rounded instants keep step with the clock where rounded intervals would not.
    lasts = 10 * np.diff(np.round(100 * control_dt * np.append(instants, instants[-1] + stride)))
    first, *rest = map(Image.fromarray, frames)
    first.save(path, save_all=True, append_images=rest, duration=lasts.tolist(), loop=0)


def plot_learning_curve(metrics: str | Path, path: str | Path) -> None:
    """Draw how the evaluations in a ``metrics.csv`` went over training time and steps: return, success, and a metric.

    Args:
        metrics: the CSV file of a training run.
        path: where the picture goes, PNG, PDF or SVG by its suffix.

    Raises:
        ValueError: the file has no row, or none of the columns to draw.
    """
    with open(metrics, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"plot_learning_curve: {metrics} has no row yet; a run writes one at each evaluation.")
    panels = [
        ("eval/return", "return", 1.0),
        ("eval/success", "success [%]", 100.0),
        ("eval/gates_passed", "gates passed", 1.0),
        ("eval/tracking_rmse", "median tracking error [cm]", 100.0),
        ("eval/position_error", "median error [cm]", 100.0),
    ]
    known = [name for name, *_ in panels]
    panels = [panel for panel in panels if panel[0] in rows[0]][:3]
    if not panels or not {"time/seconds", "steps"} <= rows[0].keys():
        raise ValueError(
            f"plot_learning_curve needs the columns time/seconds, steps, and one of {', '.join(known)}; {metrics} has "
            f"{', '.join(rows[0])}."
        )
    names = ["time/seconds", "steps", *(name for name, *_ in panels)]
    columns = {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}  # a cell may be empty
    figure = make_figure(figsize=(3.7 * len(panels), 3.2), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)
    for axis, (name, label, scale) in zip(axes[0], panels, strict=True):
        axis.plot(columns["time/seconds"], scale * columns[name], color=BLUE, marker="o", markersize=3, linewidth=1.4)
        axis.set(xlabel="training time [s]", ylabel=label)
        axis.grid(alpha=0.3)
        if "error" in label:
            _set_scale(axis, "log")
        if not columns["steps"][-1]:
            continue  # one evaluation, before the first step
        seconds_per_step = columns["time/seconds"][-1] / columns["steps"][-1]
        upper = axis.secondary_xaxis(
            "top", functions=(lambda s, k=seconds_per_step: s / k, lambda n, k=seconds_per_step: n * k)
        )
        upper.set_xlabel("control steps", color=INK)
    figure.savefig(path, dpi=130)


# -- what they share ---------------------------------------------------------------------------------------------------


def _keys(*names: str) -> list[tuple[str, ...]]:
    """The keys of a rollout under which these entries of the state stand, and that of its ends."""
    return [*((*place, "state", name) for place in ((), ("next",)) for name in names), ("next", "done")]


def _progress(flight: TensorDictBase) -> tuple[str, str, dict[str, np.ndarray]]:
    """What tells how well the first episodes of flights (num_envs, time) go.

    Returns:
        the label of the axis, "" where the names say it all; the scale of the axis; and the lines (num_envs, time + 1)
        by name, that which tells most first. Metrics and rewards are those of steps, and NaN at the start.
    """

    def told(x: Tensor) -> np.ndarray:
        return torch.nn.functional.pad(x.squeeze(-1).float(), (1, 0), value=torch.nan).numpy()

    ends = flight["next"]
    metrics = {name.replace("_", " "): told(x) for name, x in ends.get("metrics", {}).items()}
    target = first_episodes(flight, "target")
    if target is None:
        return "", "linear", metrics or {"reward": told(ends["reward"])}
    distance = (first_episodes(flight, "position") - target).norm(dim=-1).numpy()
    racing = "gate" in ends["state"]
    lines = {"to the next gate" if racing else "to the target": distance}
    ground = metrics.get("position error", distance)
    if not np.allclose(ground[:, 1:], distance[:, 1:], atol=1e-5, equal_nan=True):
        lines["over ground"] = ground
    if "tracking rmse" in metrics:
        lines["RMSE"] = metrics["tracking rmse"]
    return "distance [m]", "linear" if racing else "log", lines


def _draw_path(space: Any, below: Any, flight: TensorDictBase) -> None:
    """The path of an episode (time) in space, coloured by speed, with what it flies to."""
    from matplotlib.patheffects import withStroke
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    position, velocity, target = (first_episodes(flight, name) for name in ("position", "velocity", "target"))
    speed, points = velocity[0].norm(dim=-1).numpy(), [position]
    position = position[0].numpy()
    path = Line3DCollection(np.stack((position[:-1], position[1:]), 1), cmap="viridis", linewidth=1.5, zorder=5)
    path.set_array(0.5 * (speed[:-1] + speed[1:]))
    space.add_collection(path)
    space.scatter(*position[0], color=INK, s=10, zorder=6)
    if target is not None:
        still = _still(target, episode_steps(flight))
        points.extend(still.values())
        _draw_targets(space, still, "gate" if "gate" in flight["state"] else "target")
    if target is not None and "gate" in flight["state"]:
        gates = first_episodes(flight, "gate").flatten().int().tolist()
        for gate, point in dict(zip(gates, target[0].tolist(), strict=True)).items():
            halo = [withStroke(linewidth=2, foreground="white")]
            space.text(*point, f"   {gate + 1}", color=RED, zorder=11, path_effects=halo)
    set_box(space, *box(*bounds(*points)), zoom=0.86)
    bar = space.figure.colorbar(path, cax=below, orientation="horizontal")
    bar.set_label("speed [m/s]")
    bar.outline.set_linewidth(0.6)


def _draw_lines(axis: Any, time: np.ndarray, lines: dict[str, np.ndarray], label: str, **style: Any) -> None:
    """Lines by name over time, with a legend above."""
    for (name, x), color in zip(lines.items(), itertools.cycle(_COLORS), strict=False):
        axis.plot(time, x, color=color, label=name, linewidth=0.9, **style)
    axis.set_ylabel(label)
    axis.yaxis.set_label_coords(-0.13, 0.5, transform=axis.transAxes)  # those of all panels in one line
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.02), ncols=4)


def _set_scale(axis: Any, scale: str) -> None:
    """ "linear" or "log" for the vertical axis, with plain numbers at its ticks."""
    axis.set_yscale(scale)
    if scale == "log":
        from matplotlib.ticker import LogLocator, NullFormatter

        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axis.yaxis.set_minor_formatter(NullFormatter())
    axis.yaxis.set_major_formatter("{x:g}")


def _still(target: Tensor, steps: Tensor) -> dict[str, Tensor]:
    """What of targets (num_envs, time + 1, 3) in episodes of so many steps (num_envs) stands still.

    As keywords of :class:`Scene`, each (*, 3): their places, or, where they move all the time and not from gate to
    gate, the curve along which that of the longest episode moves.
    """
    if 2 * (target.diff(dim=1).abs() > 0).any(-1).sum() > steps.sum():
        return {"curve": target[steps.argmax()]}
    return {"places": target.flatten(0, 1).mul(1e3).round().div(1e3).unique(dim=0)}


def _draw_targets(space: Any, still: dict[str, Tensor], name: str) -> None:
    """What of targets stands still."""
    if "curve" in still:
        space.plot(*still["curve"].T.numpy(), color=RED, linestyle="--", linewidth=1.0, label=name, zorder=3)
        return
    gate = {"marker": "o", "facecolor": "none", "edgecolor": RED, "linewidth": 1.5, "depthshade": False, "s": 90}
    style = gate if name == "gate" else {"marker": "*", "color": RED, "s": 140}
    space.scatter(*still["places"].T.numpy(), label=name, zorder=10, **style)
