"""Pictures of a fit: predictions against a flight, and what is left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.identification.log import FlightLog
from torchrl_quad.identification.prediction import ERRORS, PAST, differences, predict
from torchrl_quad.render.canvas import BLUE, INK, RED, make_figure, save

_ROWS = (("position", "m", 1.0), ("velocity", "m/s", 1.0), ("tilt", "deg", 180.0 / np.pi), ("body_rate", "rad/s", 1.0))


_SECONDS = 8.0  # of a flight that are drawn


def draw_prediction(
    log: FlightLog, drone: Any, path: str | Path, prior: Any = None, horizon: float = 0.5, past: float = PAST
) -> None:
    """Draw a piece of a flight, and over it predictions from one state to the next, ``horizon`` [s] long each.

    Args:
        log: the flight.
        drone: whose model predicts, as :func:`prediction_error` takes it.
        path: of the picture.
        prior: another drone, for comparison.
        horizon: of a prediction [s].
        past: before a prediction [s], as :func:`prediction_error` takes it.
    """
    figure = make_figure(figsize=(7.2, 6.4), layout="constrained")
    axes = figure.subplots(4, 2, sharex=True)
    for one, color, label in ((prior, RED, "before the fit"), (drone, BLUE, "fitted")):
        if one is None:
            continue
        windows, flown, seen = predict([log], one, horizon, past, every=horizon)
        count = min(len(windows), round(_SECONDS / horizon))
        time = windows.dt * (windows.start[:count, None].numpy() + np.arange(windows.future + 1))
        for (row, _, scale), (left, right) in zip(_ROWS, axes, strict=True):
            for k, ax in enumerate((left, right)):
                real, guess = (_component(x, row, k)[:count] * scale for x in (seen, flown))
                if color == BLUE:
                    ax.plot(time.T, real.T, color=INK, linewidth=1.6, alpha=0.55)
                    ax.set_ylim(*_range(real))
                ax.plot(time.T, guess.T, color=color, linewidth=0.9)
                ax.plot([], [], color=color, label=label)
    for (row, unit, _), (left, right) in zip(_ROWS, axes, strict=True):
        names = ("roll", "pitch") if row in ("tilt", "body_rate") else ("x", "y")
        for ax, name in zip((left, right), names, strict=True):
            kind = " rate" if row == "body_rate" else "" if row == "tilt" else f" {row}"
            ax.set_ylabel(f"{name}{kind} [{unit}]", fontsize=8)
            ax.tick_params(labelsize=7)
            ax.grid(alpha=0.3, linewidth=0.5)
    axes[0, 0].plot([], [], color=INK, linewidth=1.6, alpha=0.55, label="flight")
    axes[0, 0].legend(fontsize=7, frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    for ax in axes[-1]:
        ax.set_xlabel("time [s]", fontsize=8)
    axes[0, 1].set_title(f"{log.name}, predictions of {horizon:g} s", fontsize=8, loc="right")
    save(figure, path, dpi=110)


def draw_residuals(
    logs: Sequence[FlightLog], drone: Any, path: str | Path, horizon: float = 0.5, past: float = PAST
) -> None:
    """Draw how errors grow over a prediction: the median, and half and nine in ten of the windows around it."""
    windows, flown, seen = predict(logs, drone, horizon, past, every=0.1)
    errors = differences(flown, seen).norm(dim=-1).numpy()
    time = windows.dt * np.arange(errors.shape[1])
    figure = make_figure(figsize=(7.2, 2.2), layout="constrained")
    for i, (ax, (name, unit)) in enumerate(zip(figure.subplots(1, 4), ERRORS.items(), strict=True)):
        marks = np.quantile(errors[:, :, i], (0.05, 0.25, 0.5, 0.75, 0.95), axis=0)
        ax.fill_between(time, marks[0], marks[4], color=BLUE, alpha=0.15, linewidth=0)
        ax.fill_between(time, marks[1], marks[3], color=BLUE, alpha=0.3, linewidth=0)
        ax.plot(time, marks[2], color=BLUE)
        ax.set_title(f"{name.replace('_', ' ')} [{unit}]", fontsize=8)
        ax.tick_params(labelsize=7)
        ax.set_xlabel("time [s]", fontsize=8)
        ax.grid(alpha=0.3, linewidth=0.5)
        ax.set_ylim(bottom=0.0)
    save(figure, path, dpi=110)


def _component(states: Any, row: str, k: int) -> np.ndarray:
    if row == "tilt":
        w, x, y, z = states.quaternion.unbind(-1)
        sines = (2.0 * (w * x + y * z), 2.0 * (w * y - x * z))  # of small roll, and of pitch
        return np.arcsin(np.clip(sines[k].numpy(), -1.0, 1.0))
    values = states.angular_velocity if row == "body_rate" else getattr(states, row)
    return values[..., k].numpy()


def _range(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.25 * (high - low) + 1e-3
    return low - margin, high + margin
