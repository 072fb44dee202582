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

from torchrl_quad.envs import QuadrotorEnv
from torchrl_quad.render.frames import BLUE, INK, RED, Scene, box, make_figure, set_box, shades

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

    That is the metric ``gates_passed`` where there is one, else the distance to the target, and for a task without
    targets its first metric, or the reward.

    Args:
        rollout: (num_envs, time), of any task.
        path: where the picture goes, PNG, PDF or SVG by its suffix.
        num_envs: how many environments are drawn.
        control_dt: control step of the environment [s].

    Raises:
        ValueError: the rollout has another shape, or lacks the position.
    """
    flight = _checked(rollout, "plot_flight", "position")[:num_envs].detach().cpu()
    first = QuadrotorEnv.first_episode(flight).squeeze(-1).numpy()
    position = flight["next", "state", "position"].numpy()
    start = flight["state", "position"][:, 0].numpy()
    label, scale, progress = _progress(flight)
    time = control_dt * np.arange(1, position.shape[1] + 1)

    figure = make_figure(figsize=(11, 4.6))
    from matplotlib.ticker import MaxNLocator

    space = figure.add_axes((0.02, 0.03, 0.42, 0.9), projection="3d")
    over_time = figure.add_axes((0.54, 0.12, 0.44, 0.83))
    for i, color in enumerate(shades(len(position))):
        x, y, z = np.concatenate((start[i : i + 1], position[i, first[i]])).T
        space.plot(x, y, z, color=color, linewidth=1.2)
        space.scatter(*start[i], color=color, s=14)
        over_time.plot(time[first[i]], progress[i, first[i]], color=color, linewidth=1.2)
    target = flight["state"].get("target", None)
    if target is not None:
        _draw_targets(space, target, "gate" if "gate" in flight["state"] else "target")
        space.legend(loc="upper left", frameon=False)
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="Flights from fresh starts")
    for axis in (space.xaxis, space.yaxis, space.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    over_time.set(xlabel="time [s]", ylabel=label)
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
    rollout = _checked(rollout, "plot_episode", "position", "velocity", "rotor_speed")
    if not -len(rollout) <= env_index < len(rollout):
        raise IndexError(f"plot_episode: env_index={env_index}, and the rollout has {len(rollout)} environments.")
    flight = rollout[env_index].detach().cpu()
    flight = flight[: int(QuadrotorEnv.first_episode(flight.unsqueeze(0)).sum())]
    figure = make_figure(figsize=(_WIDTH, 3.4))
    from matplotlib import rc_context
    from matplotlib.ticker import MaxNLocator

    with rc_context(_PAPER):
        space = figure.add_axes((0.0, 0.2, 0.44, 0.8), projection="3d", computed_zorder=False)
        _draw_path(space, figure.add_axes((0.09, 0.12, 0.26, 0.02)), flight)
        axes = figure.subplots(3, 1, sharex=True, gridspec_kw=_BESIDE)
        times = control_dt * np.arange(len(flight) + 1)
        label, scale, lines = _errors(flight)
        _draw_lines(axes[0], times, lines, label)
        _set_scale(axes[0], scale)
        actions = dict(zip(("thrust", "roll rate", "pitch rate", "yaw rate"), flight["action"].T.numpy(), strict=True))
        _draw_lines(axes[1], times[:-1], actions, "action", drawstyle="steps-post")
        speeds = {f"rotor {i + 1}": x for i, x in enumerate(_with_start(flight, "rotor_speed").T)}
        _draw_lines(axes[2], times, speeds, "rotor speed\n[rad/s]")
        if "gates_passed" in flight["state"]:
            passed = _with_start(flight, "gates_passed")[:, 0]
            for time in times[1:][np.diff(passed) > 0]:
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
        fps: frames per second, at least; as many as go into whole control steps.
        max_seconds: what is filmed of a longer flight.

    Raises:
        ValueError: the rollout has another shape, or lacks the position or the quaternion.
    """
    flight = _checked(rollout, "animate_flight", "position", "quaternion")
    flight = flight[:num_envs, : max(round(max_seconds / control_dt), 1)].detach().cpu()
    # A drone stays where its episode has ended.
    last = QuadrotorEnv.first_episode(flight).sum(1, keepdim=True) - 1
    index = torch.arange(flight.shape[1])[None, :, None].minimum(last)
    states = {
        name: flight["next", "state", name].take_along_dim(index, 1)
        for name in ("position", "quaternion", "target")
        if name in flight["next", "state"]
    }
    position, target = states["position"], states.get("target")
    standing = {}
    if target is not None:
        places = _places(flight["state", "target"])
        standing = {"curve": target[0]} if places is None else {"places": places}
    scene = Scene(position, len(position), **standing)
    trail = max(round(1.0 / control_dt), 1)
    stride = max(int(1.0 / (fps * control_dt)), 1)
    frames = [
        scene.draw(
            *(x[:, t] for x in states.values()),
            trails=position[:, max(t - trail, 0) : t + 1],
            text=f"{control_dt * (t + 1):.1f} s",
        )
        for t in range(0, flight.shape[1], stride)
    ]
    from PIL import Image

    first, *rest = map(Image.fromarray, frames)
    first.save(path, save_all=True, append_images=rest, duration=1000 * stride * control_dt, loop=0)


def plot_learning_curve(metrics: str | Path, path: str | Path) -> None:
    """Draw how the evaluations in a ``metrics.csv`` went over training time and steps: return, success, and a metric.

    Args:
        metrics: the CSV file of a training run.
        path: where the picture goes, PNG, PDF or SVG by its suffix.
    """
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
    figure = make_figure(figsize=(3.7 * len(panels), 3.2), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)
    for axis, (name, label, scale) in zip(axes[0], panels, strict=True):
        axis.plot(columns["time/seconds"], scale * columns[name], color=BLUE, marker="o", markersize=3, linewidth=1.4)
        axis.set(xlabel="training time [s]", ylabel=label)
        axis.grid(alpha=0.3)
        seconds_per_step = columns["time/seconds"][-1] / columns["steps"][-1]
        upper = axis.secondary_xaxis(
            "top", functions=(lambda s, k=seconds_per_step: s / k, lambda n, k=seconds_per_step: n * k)
        )
        upper.set_xlabel("control steps", color=INK)
        if "error" in label:
            _set_scale(axis, "log")
    figure.savefig(path, dpi=130)


# -- what they share ---------------------------------------------------------------------------------------------------


def _checked(rollout: TensorDictBase, who: str, *names: str) -> TensorDictBase:
    """The rollout, if it is one with these entries of the state."""
    if rollout.dim() != 2 or not rollout.numel():
        raise ValueError(
            f"{who} draws a rollout of batch size (num_envs, time), such as env.rollout(...) returns; got "
            f"{tuple(rollout.shape)}. Of one drone, write rollout.unsqueeze(0)."
        )
    entries = rollout.keys(include_nested=True)
    needed = [*((*place, "state", name) for place in ((), ("next",)) for name in names), ("next", "done")]
    missing = [key for key in [*needed, *(["action"] if who == "plot_episode" else [])] if key not in entries]
    if missing:
        raise ValueError(
            f"{who}: the rollout lacks {', '.join(map(str, missing))}. Hand it over whole, as "
            "env.rollout(...) returns it."
        )
    return rollout


def _progress(flight: TensorDictBase) -> tuple[str, str, np.ndarray]:
    """What tells how well flights (num_envs, time) go: its name, the scale of its axis, and its values."""
    ends = flight["next"]
    metrics = ends.get("metrics", {})
    if "gates_passed" in metrics:
        return "gates passed", "linear", metrics["gates_passed"].squeeze(-1).numpy()
    if "target" in ends["state"]:
        distance = (ends["state", "position"] - ends["state", "target"]).norm(dim=-1)
        return "distance to the target [cm]", "log", 100 * distance.numpy()
    for name, value in metrics.items():
        return name.replace("_", " "), "linear", value.squeeze(-1).numpy()
    return "reward", "linear", ends["reward"].squeeze(-1).numpy()


def _errors(flight: TensorDictBase) -> tuple[str, str, dict[str, np.ndarray]]:
    """How far an episode (time) is from what it is to reach: label, scale of the axis, lines (time + 1) by name."""
    ends = flight["next"]
    told = {name: np.append(np.nan, value[:, 0]) for name, value in ends.get("metrics", {}).items()}
    if "target" not in flight["state"] and told:
        return "metrics", "linear", {name.replace("_", " "): x for name, x in told.items()}
    if "target" not in flight["state"]:
        return "reward", "linear", {"per step": np.append(np.nan, ends["reward"][:, 0])}
    distance = np.linalg.norm(_with_start(flight, "position") - _with_start(flight, "target"), axis=-1)
    lines = {"to the next gate" if "gate" in flight["state"] else "to the target": distance}
    ground = told.get("position_error", distance)
    if not np.allclose(ground[1:], distance[1:], atol=1e-5):
        lines["over ground"] = ground
    if "tracking_rmse" in told:
        lines["RMSE"] = told["tracking_rmse"]
    return "distance [m]", "linear" if "gate" in flight["state"] else "log", lines


def _with_start(flight: TensorDictBase, name: str) -> np.ndarray:
    """An entry of the state over an episode (time), (time + 1, k), from its start to its end."""
    return torch.cat((flight["state", name][:1], flight["next", "state", name])).numpy()


def _draw_path(space: Any, below: Any, flight: TensorDictBase) -> None:
    """The path of an episode (time) in space, coloured by speed, with what it flies to."""
    from matplotlib.patheffects import withStroke
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    position = _with_start(flight, "position")
    speed = np.linalg.norm(_with_start(flight, "velocity"), axis=-1)
    path = Line3DCollection(np.stack((position[:-1], position[1:]), 1), cmap="viridis", linewidth=1.5, zorder=5)
    path.set_array(0.5 * (speed[:-1] + speed[1:]))
    space.add_collection(path)
    space.scatter(*position[0], color=INK, s=10, zorder=6)
    points, state = [position], flight["state"]
    if "gate" in state:
        gates = dict(zip(state["gate"][:, 0].tolist(), state["target"].numpy(), strict=True))
        points.extend(gates.values())
        _draw_targets(space, state["target"], "gate")
        for gate, point in gates.items():
            halo = [withStroke(linewidth=2, foreground="white")]
            space.text(*point, f"   {gate + 1}", color=RED, zorder=11, path_effects=halo)
    elif "target" in state:
        points.append(_with_start(flight, "target"))
        _draw_targets(space, state["target"], "target")
    points = torch.as_tensor(np.vstack(points))
    set_box(space, *box(points.amin(0), points.amax(0)), zoom=0.86)
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


def _places(target: Tensor) -> Tensor | None:
    """The places (*, 3) of targets (*, time, 3), or None where they move all the time, and not from gate to gate."""
    moves = (target.diff(dim=-2) != 0).any(-1).flatten()
    return None if 2 * moves.sum() > len(moves) else target.reshape(-1, 3).mul(1e3).round().div(1e3).unique(dim=0)


def _draw_targets(space: Any, target: Tensor, name: str) -> None:
    """Targets (*, time, 3) where they stand still, or the line along which the first moves."""
    places = _places(target)
    if places is None:
        line = target.reshape(-1, target.shape[-2], 3)[0]
        space.plot(*line.T.numpy(), color=RED, linestyle="--", linewidth=1.0, label=name, zorder=3)
    elif name == "gate":
        style = {"marker": "o", "facecolor": "none", "linewidth": 1.5, "depthshade": False}
        space.scatter(*places.T.numpy(), edgecolor=RED, s=90, label=name, zorder=10, **style)
    else:
        space.scatter(*places.T.numpy(), color=RED, marker="*", s=140, label=name, zorder=10)
