"""Draw flights and learning curves as figures. Without a path a figure is returned only, and a notebook shows it."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, describe_metric
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import Positive, Size, checked
from torchrl_quad.render import canvas
from torchrl_quad.render.canvas import BLUE, GREEN, INK, RED
from torchrl_quad.render.flights import Flight, box_shape, state_keys, with_obstacles
from torchrl_quad.vision import Primitives

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

_PAPER = Path(__file__).with_name("paper.mplstyle")  # for figures as wide as a page of two columns
_WIDTH = 7.16  # [inches], of a page of two columns
_BESIDE = {"left": 0.54, "right": 0.99, "top": 0.94, "bottom": 0.12, "hspace": 0.5}  # shares of a page
_ABOVE: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.02), "ncols": 4}  # a legend
_COLORS = INK, BLUE, RED, "#d99a1c"
_PANELS = 4  # of a learning curve


@checked
def plot_flight(
    rollout: TensorDictBase,
    path: str | Path | None = None,
    *,
    env: EnvBase | None = None,
    num_envs: Size = 12,
    control_dt: Positive = 0.02,
    title: str | None = None,
    view: Literal["space", "above"] = "space",
) -> Figure:
    """Draw the first episodes of a flight: their paths in space, and over time how well they go.

    The second panel shows the metric that the task names in its markers, else the distance to the target, and for a
    task without targets its first metric, or the reward. A dashed line marks the value from which a state fulfils the
    task, if the markers name it.

    Args:
        rollout: (num_envs, time), of any task, with or without its graph.
        path: the picture to write, PNG, PDF or SVG by its suffix; None for none.
        env: the environment that flew, also under transforms. It provides the control step, the markers, and the units
            of metrics; without it, the picture shows the targets in the rollout.
        num_envs: the maximum number of environments to draw.
        control_dt: control step [s]; used only without ``env``.
        title: of the picture; by default the name of the environment and the number of flights.
        view: "above" shows the paths alone, coloured by speed, between the obstacles that they could meet. Where each
            environment has obstacles of its own, it has a panel of its own. A ring is a start, a cross a crash.

    Raises:
        ImportError: matplotlib is missing.
        TypeError, ValueError: what is given cannot be drawn, or matplotlib does not know the suffix.
    """
    needed = state_keys("position", "velocity") if view == "above" else [*state_keys("position"), ("next", "reward")]
    flight = Flight("plot_flight", rollout, env, control_dt, needed, num_envs)
    title = flight.title if title is None else title
    if view == "above":
        return canvas.save(_draw_from_above(flight, title), path)
    position = flight.position
    label, log, values, success = flight.progress()
    figure = canvas.make_figure(figsize=(11, 4.6), dpi=130)
    space = canvas.add_space(figure, (0.0, 0.02, 0.46, 0.9))
    over_time = figure.add_axes((0.55, 0.12, 0.43, 0.77))
    for i, color in enumerate(canvas.drone_colors(len(flight))):
        flown = slice(int(flight.steps[i]) + 1)
        space.plot(*position[i, flown].T.numpy(), color=color, linewidth=1.2)
        space.scatter(*position[i, 0], color=color, s=14)
        over_time.plot(flight.times[flown], values[i, flown], color=color, linewidth=1.2)
    alike = len(flight) == 1 or not flight.has_own_obstacles
    markers = with_obstacles(flight.markers, flight.solids(0)) if alike else flight.shared_markers
    canvas.draw_markers(space, markers)
    canvas.set_box(space, *canvas.box(*canvas.bounds(position, *markers.points())), zoom=0.9)
    named = dict(zip(*reversed(space.get_legend_handles_labels()), strict=True))  # a name once
    if named:
        space.legend(named.values(), named.keys(), loc="upper left", frameon=False)
    over_time.set(xlabel="time [s]", ylabel=label)
    canvas.set_scale(over_time, log)
    over_time.grid(alpha=0.3)
    if success is not None:
        near = "" if flight.markers.progress else "below "
        over_time.axhline(success, color=RED, linestyle="--", linewidth=1.0, label=f"success: {near}{success:g}")
        over_time.legend(loc="best", frameon=False)
    figure.suptitle(title, x=0.04, y=0.965, ha="left", fontsize=13)
    return canvas.save(figure, path)


@checked
def plot_episode(
    rollout: TensorDictBase,
    path: str | Path | None = None,
    *,
    env: EnvBase | None = None,
    env_index: int = 0,
    control_dt: Positive = 0.02,
) -> Figure:
    """Draw the first episode of the environment ``env_index`` for a paper, as wide as a page of two columns.

    Shows its path in space, coloured by speed, with the task's markers and numbers at its gates; and over time the
    distance to the target with the metrics that are lengths (without targets: all metrics, or the reward), the actions,
    and the rotor speeds if the state holds them. Dotted lines mark the times at which the drone passes gates, a dashed
    line the distance from which a state fulfils the task. PDF and SVG embed their fonts, PNG has 300 dots per inch.

    The other arguments, and errors, are those of :func:`plot_flight`; the rollout needs velocity and action, too.
    """
    keys = [*state_keys("position", "velocity"), ("action",), ("next", "reward")]
    flight = Flight("plot_episode", rollout, env, control_dt, keys, env_index=env_index)
    figure = canvas.make_figure(figsize=(_WIDTH, 3.4))  # first: it says so where matplotlib is missing
    from matplotlib import rc_context
    from matplotlib.ticker import MaxNLocator

    with rc_context(fname=_PAPER):
        space = canvas.add_space(figure, (0.0, 0.2, 0.44, 0.8), computed_zorder=False)
        _draw_path(space, figure.add_axes((0.09, 0.12, 0.26, 0.02)), flight)
        rotor_speed = flight.state("rotor_speed")
        axes = figure.subplots(2 if rotor_speed is None else 3, 1, sharex=True, gridspec_kw=_BESIDE)
        times = flight.times
        label, log, lines = flight.progress_lines()
        _draw_lines(axes[0], times, {name: x[0] for name, x in lines.items()}, label)
        if flight.target is not None and (near := flight.near_enough) is not None:
            axes[0].axhline(near, color=RED, linestyle="--", linewidth=0.6, label=f"success: below {near:g}")
            axes[0].legend(**_ABOVE)
        canvas.set_scale(axes[0], log)
        actions = cast("Tensor", flight.entry("action"))[0].T.numpy()
        actions = np.concatenate((actions, actions[:, -1:]), 1)  # each lasts until the next instant
        actions = dict(zip(flight.action_names, actions, strict=True))
        _draw_lines(axes[1], times, actions, "action", drawstyle="steps-post")
        if rotor_speed is not None:
            speeds = {f"rotor {i + 1}": x for i, x in enumerate(rotor_speed[0].T.numpy())}
            _draw_lines(axes[2], times, speeds, "rotor speed\n[rad/s]")
        if (gate := flight.gate_index()) is not None:
            for time in times[1:][gate[0].diff().numpy() != 0]:
                for axis in axes:
                    axis.axvline(time, color=RED, linestyle=":", linewidth=0.6, zorder=0)
        axes[-1].set(xlabel="time [s]", xlim=(0, times[-1]))
        for axis in axes[1:]:
            axis.yaxis.set_major_locator(MaxNLocator(4))
        return canvas.save(figure, path)


def _draw_path(space: Axes3D, below: Axes, flight: Flight) -> None:
    """Draw the path of an episode in space, coloured by speed, with the markers around it."""
    from matplotlib.patheffects import withStroke
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    position, speed = flight.position[0].numpy(), flight.speed[0].numpy()
    path = Line3DCollection(np.stack((position[:-1], position[1:]), 1), cmap="viridis", linewidth=1.5, zorder=5)
    path.set_array(0.5 * (speed[:-1] + speed[1:]))
    space.add_collection(path)
    space.scatter(*position[0], color=INK, s=10, zorder=6)
    markers = with_obstacles(flight.markers, flight.solids(0))
    if markers.gates is not None:
        halo = [withStroke(linewidth=2, foreground="white")]
        for i, (x, y, z) in enumerate(markers.gates.tolist(), 1):
            space.text(x, y, z, f"   {i}", color=RED, zorder=11, path_effects=halo)
    canvas.draw_markers(space, markers)
    canvas.set_box(space, *canvas.box(*canvas.bounds(flight.position, *markers.points())), zoom=0.86)
    bar = space.figure.colorbar(path, cax=below, orientation="horizontal")
    bar.set_label("speed [m/s]")
    bar.outline.set_linewidth(0.6)


def _draw_lines(axis: Axes, time: np.ndarray, lines: dict[str, np.ndarray], label: str, **style: Any) -> None:
    """Draw lines by name over time, with a legend above."""
    for (name, x), color in zip(lines.items(), itertools.cycle(_COLORS), strict=False):
        axis.plot(time, x, color=color, label=name, linewidth=0.9, **style)
    axis.set_ylabel(label)
    axis.yaxis.set_label_coords(-0.13, 0.5, transform=axis.transAxes)  # in line with those of the other panels
    axis.legend(**_ABOVE)


# -- from above --------------------------------------------------------------------------------------------------------


def _draw_from_above(flight: Flight, title: str) -> Figure:
    """The paths between the obstacles that stand between the least and the greatest height of the flight."""
    from matplotlib.collections import LineCollection

    position, speed, everyone = flight.position, flight.speed, range(len(flight))
    groups = [[i] for i in everyone] if flight.has_own_obstacles else [everyone]
    low, high = canvas.bounds(position)
    sides = (high - low)[:2].clamp_min(2.0) + 4.0
    middle, width = 0.5 * (low + high)[:2], 10.0
    left, bottom, right, top = torch.cat((middle - 0.5 * sides, middle + 0.5 * sides)).tolist()
    height = min(0.6 + len(groups) * (0.88 * width * (sides[1] / sides[0]).item() + 0.2), 14.0)
    figure = canvas.make_figure(figsize=(width, height), dpi=130, layout="constrained")
    axes = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    fastest, crash = speed.nan_to_num().amax().item(), flight.entry("next", "crash")
    for axis, group in zip(axes, groups, strict=True):
        if (solids := flight.solids(group[0])) is not None:
            _draw_sections(axis, solids, low[2].item(), high[2].item())
        for i in group:
            flown = position[i, : int(flight.steps[i]) + 1, :2].numpy()
            line = LineCollection(list(itertools.pairwise(flown)), cmap="viridis", linewidth=1.8)
            line.set_array(speed[i, : len(flown) - 1].numpy())
            line.set_clim(0.0, fastest)
            axis.add_collection(line)
            axis.plot(*flown[0], marker="o", color=INK, markersize=5, fillstyle="none")
            if crash is not None and crash[i, : int(flight.steps[i])].any():
                axis.plot(*flown[-1], marker="x", color=RED, markersize=9, markeredgewidth=2)
        axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", ylabel="y [m]")
    axes[-1].set_xlabel("x [m]")
    figure.suptitle(title, x=0.02, ha="left", fontsize=12)
    figure.colorbar(axes[-1].collections[-1], ax=list(axes), label="speed [m/s]", shrink=0.6, pad=0.01, aspect=30)
    return figure


def _draw_sections(axis: Axes, solids: Primitives, low: float, high: float) -> None:
    """Draw what stands between two heights [m] from above."""
    from matplotlib.patches import Circle, Polygon

    style: dict[str, Any] = {"facecolor": GREEN, "alpha": 0.6, "edgecolor": "none"}
    round_ones = [(x, y, z - r, z + r, r) for x, y, z, r in solids.spheres[0].tolist()]
    round_ones += [(x, y, z, z + height, r) for x, y, z, r, height in solids.cylinders[0].tolist()]
    for x, y, bottom, top, radius in round_ones:
        if bottom < high and top > low:
            axis.add_patch(Circle((x, y), radius, **style))
    for x in solids.boxes[0].detach().cpu().float():
        corners = box_shape(x).points
        if corners[:, 2].min() < high and corners[:, 2].max() > low:
            centre = corners[:, :2].mean(0)
            around = torch.atan2(*(corners[:, :2] - centre).flip(-1).T).argsort()
            axis.add_patch(Polygon(corners[around, :2].numpy(), **style))
    for x, y, z, distance in solids.planes[0].tolist():
        if abs(z) < 0.99:
            foot = distance * x, distance * y
            axis.axline(foot, (foot[0] - y, foot[1] + x), color=GREEN, linewidth=3)


# -- learning curves ---------------------------------------------------------------------------------------------------


def plot_learning_curve(
    csv_path: str | Path, path: str | Path | None = None, *, metrics: Mapping[str, Metric] = EPISODE_METRICS
) -> Figure:
    """Draw the evaluations of a training run over training time; the label of its axis says how many steps it took.

    Draws up to four of the columns ``eval/NAME``: first those that ``metrics`` describes, in its order, then the
    others.

    Args:
        csv_path: the CSV file; it has the columns ``time/seconds`` [s] and ``steps``, and one row per evaluation.
        path: as in :func:`plot_flight`.
        metrics: labels, units and scales by name, such as ``env.metric_info``.

    Raises:
        ValueError: the file has no row, or lacks a column.
    """
    with open(csv_path, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise UserValueError(f"plot_learning_curve: {csv_path} has no row yet; a run writes one at each evaluation.")
    evaluated = [name.removeprefix("eval/") for name in rows[0] if name.startswith("eval/")]
    names = [*(name for name in metrics if name in evaluated), *(name for name in evaluated if name not in metrics)]
    names = names[:_PANELS]
    if not names or not {"time/seconds", "steps"} <= rows[0].keys():
        raise UserValueError(
            f"plot_learning_curve needs the columns time/seconds, steps, and at least one eval/NAME, such as "
            f"eval/return; {csv_path} has {', '.join(rows[0])}."
        )

    def column(name: str) -> np.ndarray:
        return np.array([float(row[name] or "nan") for row in rows])  # a cell may be empty

    seconds, steps = column("time/seconds"), column("steps")[-1]
    figure = canvas.make_figure(figsize=(3.4 * len(names), 3.2), dpi=130, layout="constrained")
    axes = figure.subplots(1, len(names), squeeze=False)
    for axis, name in zip(axes[0], names, strict=True):
        metric = describe_metric(name, metrics)
        values = metric.scale * column(f"eval/{name}")
        axis.plot(seconds, values, color=BLUE, marker="o", markersize=3, linewidth=1.4)
        axis.set(
            xlabel=f"training time [s] of {steps:.3g} control steps",
            ylabel=metric.axis_label + (", median" if metric.median else ""),
        )
        axis.grid(alpha=0.3)
        canvas.set_scale(axis, metric.log)
    return canvas.save(figure, path)
