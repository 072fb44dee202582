"""Draw learning curves from the CSV file of a training run."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, describe_metric
from torchrl_quad.errors import UserValueError
from torchrl_quad.render.canvas import BLUE, INK, make_figure, save, set_scale

_PANELS = 4


def plot_learning_curve(
    csv_path: str | Path, path: str | Path, *, metrics: Mapping[str, Metric] = EPISODE_METRICS
) -> None:
    """Draw the evaluations of a training run over training time, with the control steps at the top.

    Draws up to four of the columns ``eval/NAME``: first those that ``metrics`` describes, in its order, then the
    others.

    Args:
        csv_path: the CSV file; it has the columns ``time/seconds`` [s] and ``steps``, and a row for each evaluation.
        path: the picture to write, PNG, PDF or SVG by its suffix.
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
    columns = {
        name: np.array([float(row[name] or "nan") for row in rows])  # a cell may be empty
        for name in ("time/seconds", "steps", *(f"eval/{name}" for name in names))
    }
    seconds, steps = columns["time/seconds"], columns["steps"]
    known_seconds, known_steps = _knots(seconds, steps)
    figure = make_figure(figsize=(3.4 * len(names), 3.2), layout="constrained")
    from matplotlib.ticker import EngFormatter, MaxNLocator

    axes = figure.subplots(1, len(names), squeeze=False)
    for axis, name in zip(axes[0], names, strict=True):
        metric = describe_metric(name, metrics)
        values = metric.scale * columns[f"eval/{name}"]
        axis.plot(seconds, values, color=BLUE, marker="o", markersize=3, linewidth=1.4)
        axis.set(xlabel="training time [s]", ylabel=metric.axis_label + (", median" if metric.median else ""))
        axis.grid(alpha=0.3)
        if metric.log:
            set_scale(axis, log=True)
        if len(known_steps) > 1:
            to_steps = partial(np.interp, xp=known_seconds, fp=known_steps)
            to_seconds = partial(np.interp, xp=known_steps, fp=known_seconds)
            upper = axis.secondary_xaxis("top", functions=(to_steps, to_seconds))
            upper.set_xlabel("control steps", color=INK)
            upper.xaxis.set_major_locator(MaxNLocator(5))
            upper.xaxis.set_major_formatter(EngFormatter(sep=""))
    save(figure, path, dpi=130)


def _knots(seconds: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of seconds and steps between which to interpolate, both increasing, from (0, 0) and beyond both ends.

    A constant rate would not do: an iteration that compiles takes far longer than the others.
    """
    pairs = [(0.0, 0.0)]
    for pair in zip(seconds, steps, strict=True):
        if pair[0] > pairs[-1][0] and pair[1] > pairs[-1][1]:
            pairs.append(pair)
    knots = np.array(pairs)
    if len(knots) > 1:  # the axes have margins: go on at the rates of both ends
        first, last = (knots[-1, 0] / step[0] * step for step in (knots[1] - knots[0], knots[-1] - knots[-2]))
        knots = np.concatenate((knots[:1] - first, knots, knots[-1:] + last))
    return knots[:, 0], knots[:, 1]
