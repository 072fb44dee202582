"""Draw flights as figures."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_quad.envs.metrics import first_episode
from torchrl_quad.render.canvas import (
    BLUE,
    INK,
    RED,
    bounds,
    box,
    draw_markers,
    drone_colors,
    make_figure,
    save,
    set_box,
    set_scale,
)
from torchrl_quad.render.flights import Flight, check_rollout, state_keys
from torchrl_quad.render.obstacles import with_obstacles

_PAPER = {  # for figures as wide as a page of two columns
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
    "savefig.dpi": 300,  # for PNG
}
_WIDTH = 7.16  # [inches], of a page of two columns
_BESIDE = {"left": 0.54, "right": 0.99, "top": 0.94, "bottom": 0.12, "hspace": 0.5}  # shares of a page
_ABOVE = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.02), "ncols": 4}  # a legend
_COLORS = INK, BLUE, RED, "#d99a1c"


def plot_flight(
    rollout: TensorDictBase,
    path: str | Path,
    *,
    env: EnvBase | None = None,
    num_envs: int = 12,
    control_dt: float = 0.02,
    title: str | None = None,
) -> None:
    """Draw the first episodes of a flight: their paths in space, and over time how well they go.

    The second panel shows the metric that the task names in its markers, else the distance to the target, and for a
    task without targets its first metric, or the reward. A dashed line marks the value from which a state fulfils the
    task, if the markers name it.

    Args:
        rollout: (num_envs, time), of any task.
        path: the picture to write, PNG, PDF or SVG by its suffix.
        env: the environment that flew, also under transforms. It provides the control step, the markers, and the units
            of metrics; without it, the picture shows the targets in the rollout.
        num_envs: how many environments to draw, at most.
        control_dt: control step [s]; used only without ``env``.
        title: of the picture; by default the name of the environment and the number of flights.

    Raises:
        TypeError: ``env`` is not a quadrotor environment.
        ValueError: the rollout has another shape, lacks the position or the reward, or ``num_envs`` is less than 1.
    """
    flight = Flight("plot_flight", rollout, env, control_dt, [*state_keys("position"), ("next", "reward")], num_envs)
    position = flight.state("position")
    label, log, values, success = flight.progress()

    figure = make_figure(figsize=(11, 4.6))
    space = figure.add_axes((0.0, 0.02, 0.46, 0.9), projection="3d")
    over_time = figure.add_axes((0.55, 0.12, 0.43, 0.77))
    for i, color in enumerate(drone_colors(len(flight))):
        flown = slice(int(flight.steps[i]) + 1)
        space.plot(*position[i, flown].T.numpy(), color=color, linewidth=1.2)
        space.scatter(*position[i, 0], color=color, s=14)
        over_time.plot(flight.times[flown], values[i, flown], color=color, linewidth=1.2)
    alike = len(flight) == 1 or not getattr(getattr(flight.env, "scene", None), "is_random", False)
    markers = with_obstacles(flight.markers, flight.solids(0) if alike else None)
    draw_markers(space, markers)
    set_box(space, *box(*bounds(position, *markers.points())), zoom=0.9)
    named = dict(zip(*reversed(space.get_legend_handles_labels()), strict=True))  # a name once
    if named:
        space.legend(named.values(), named.keys(), loc="upper left", frameon=False)
    over_time.set(xlabel="time [s]", ylabel=label)
    set_scale(over_time, log)
    over_time.grid(alpha=0.3)
    if success is not None:
        near = "" if flight.markers.progress else "below "
        over_time.axhline(success, color=RED, linestyle="--", linewidth=1.0, label=f"success: {near}{success:g}")
        over_time.legend(loc="best", frameon=False)
    figure.suptitle(flight.title if title is None else title, x=0.04, y=0.965, ha="left", fontsize=13)
    save(figure, path, dpi=130)


def plot_episode(
    rollout: TensorDictBase,
    path: str | Path,
    *,
    env: EnvBase | None = None,
    env_index: int = 0,
    control_dt: float = 0.02,
) -> None:
    """Draw the first episode of one drone as a figure for a paper, as wide as a page of two columns (7.16 inches).

    Shows its path in space, coloured by speed, with the task's markers and numbers at its gates. Shows over time the
    distance to the target with the metrics that are lengths (without targets: all metrics, or the reward), the actions,
    and the rotor speeds if the state holds them. Dotted lines mark the times at which the drone passes gates, a dashed
    line the distance from which a state fulfils the task, if the markers name it.

    Args:
        rollout: (num_envs, time), of any task, with or without its graph.
        path: the figure to write: PDF or SVG with embedded fonts, or PNG with 300 dots per inch, by its suffix.
        env: the environment that flew, also under transforms. It provides the control step, the markers, and the units
            of metrics; without it, the figure shows the targets in the rollout.
        env_index: which environment.
        control_dt: control step [s]; used only without ``env``.

    Raises:
        TypeError: ``env`` is not a quadrotor environment.
        ValueError: the rollout has another shape, lacks position, velocity, action or reward, or matplotlib does not
            know the suffix.
        IndexError: there is no such environment.
    """
    keys = [*state_keys("position", "velocity"), ("action",), ("next", "reward")]
    check_rollout("plot_episode", rollout, env, keys)
    if not -len(rollout) <= env_index < len(rollout):
        raise IndexError(f"plot_episode: env_index={env_index}, and the rollout has {len(rollout)} environments.")
    episode = rollout[[env_index]]
    episode = episode[:, : int(first_episode(episode).sum())]
    flight = Flight("plot_episode", episode, env, control_dt, keys)
    figure = make_figure(figsize=(_WIDTH, 3.4))
    from matplotlib import rc_context
    from matplotlib.ticker import MaxNLocator

    with rc_context(_PAPER):
        space = figure.add_axes((0.0, 0.2, 0.44, 0.8), projection="3d", computed_zorder=False)
        _draw_path(space, figure.add_axes((0.09, 0.12, 0.26, 0.02)), flight)
        rotor_speed = flight.state("rotor_speed")
        axes = figure.subplots(2 if rotor_speed is None else 3, 1, sharex=True, gridspec_kw=_BESIDE)
        times = flight.times
        label, log, lines = flight.progress_lines()
        _draw_lines(axes[0], times, {name: x[0] for name, x in lines.items()}, label)
        if flight.target is not None and (near := flight.near_enough) is not None:
            axes[0].axhline(near, color=RED, linestyle="--", linewidth=0.6, label=f"success: below {near:g}")
            axes[0].legend(**_ABOVE)
        set_scale(axes[0], log)
        actions = flight.rollout["action"][0].T.numpy()
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
        save(figure, path)


def _draw_path(space: Any, below: Any, flight: Flight) -> None:
    """Draw the path of an episode in space, coloured by speed, with the markers around it."""
    from matplotlib.patheffects import withStroke
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    points = [flight.state("position")]
    position, speed = points[0][0].numpy(), flight.state("velocity")[0].norm(dim=-1).numpy()
    path = Line3DCollection(np.stack((position[:-1], position[1:]), 1), cmap="viridis", linewidth=1.5, zorder=5)
    path.set_array(0.5 * (speed[:-1] + speed[1:]))
    space.add_collection(path)
    space.scatter(*position[0], color=INK, s=10, zorder=6)
    markers = with_obstacles(flight.markers, flight.solids(0))
    if markers.gates is not None:
        halo = [withStroke(linewidth=2, foreground="white")]
        for i, centre in enumerate(markers.gates.tolist(), 1):
            space.text(*centre, f"   {i}", color=RED, zorder=11, path_effects=halo)
    draw_markers(space, markers)
    set_box(space, *box(*bounds(*points, *markers.points())), zoom=0.86)
    bar = space.figure.colorbar(path, cax=below, orientation="horizontal")
    bar.set_label("speed [m/s]")
    bar.outline.set_linewidth(0.6)


def _draw_lines(axis: Any, time: np.ndarray, lines: dict[str, np.ndarray], label: str, **style: Any) -> None:
    """Draw lines by name over time, with a legend above."""
    for (name, x), color in zip(lines.items(), itertools.cycle(_COLORS), strict=False):
        axis.plot(time, x, color=color, label=name, linewidth=0.9, **style)
    axis.set_ylabel(label)
    axis.yaxis.set_label_coords(-0.13, 0.5, transform=axis.transAxes)  # in line with those of the other panels
    axis.legend(**_ABOVE)
