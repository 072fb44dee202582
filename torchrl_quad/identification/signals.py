"""Streams and signals: what a file holds before it is a flight, each with its own clock."""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.identification.errors import ClockJumpsBack, NotFiniteLog, UnreadableLog
from torchrl_quad.rotations import conjugate, continuous, multiply, rotate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
LARGEST = 1e9  # of a quantity, in SI units; only damage makes larger ones
MAX_COLUMNS = 100_000  # of a table, and of all messages of a ULog together


def open_plain(path: Path) -> io.BufferedReader:
    """A plain file, open for reading. A pipe, a socket or a device is not opened: to read one may never end."""
    if path.is_file():
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb")
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):  # which may have become a pipe in between
            return file
        file.close()
    raise UnreadableLog(f"{path.name} is not a regular file but a pipe, a socket or a device. Give the path of a log.")


def too_many(name: str, most: int, what: str, remedy: str) -> UnreadableLog:
    """The error of a file that is beyond a limit."""
    return UnreadableLog(f"{name} has more than {most:,} {what}, the maximum. {remedy}")


@dataclass(frozen=True)
class Stream:
    """Columns of one rate: a table of a CSV file, a message of an autopilot, a topic of a bag."""

    name: str
    time: Array  # (N,) [s], from any start
    columns: Mapping[str, Array]  # each (N,), by the name that a layout uses

    def at(self, rows: Mask) -> Stream:
        """Some of its samples."""
        return replace(self, time=self.time[rows], columns={name: x[rows] for name, x in self.columns.items()})


@dataclass(frozen=True)
class Signal:
    """A quantity at its own rate."""

    field: str
    columns: tuple[str, ...]  # what the file calls it, for messages
    time: Array  # (N,) [s]
    values: Array  # (N, size)

    @property
    def step(self) -> float:
        """The usual time between samples [s]."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else np.inf

    def __str__(self) -> str:
        return f"{self.field} ({', '.join(self.columns)})"


def clean(signal: Signal) -> tuple[Signal, list[str]]:
    """Without samples that are not finite or repeat a time, and notes of what was dropped."""
    time, values = signal.time, signal.values
    finite = np.isfinite(values).all(-1) & (np.abs(time) < 1e19)  # of nanoseconds since 1970, too
    if finite.sum() < 2:  # of tables that join several rates, most rows of the slower ones are empty
        raise NotFiniteLog(
            f"{finite.sum()} of {len(finite)} samples of {signal} are finite: nothing was recorded there. Name other "
            "columns, or leave this quantity out if it is optional."
        )
    time, values = time[finite], values[finite]
    back = np.flatnonzero(np.diff(time) < 0.0)
    if len(back):
        k, far = back[0], -np.diff(time).min()  # [s]
        raise ClockJumpsBack(
            f"The clock of {signal} jumps back from {time[k]:.10g} to {time[k + 1]:.10g} s at sample {k + 1}, and "
            f"{len(back)} time(s) in all: samples have no order in time. "
            + ("Cut the file there and read the parts" if len(back) < 3 and far > 1.0 else "Sort its rows by time")
            + ", or name the right time column."
        )
    new = np.concatenate(([True], np.diff(time) > 0.0))
    notes = []
    if not finite.all():
        lost = (~finite).sum()
        notes.append(f"{lost} samples of {signal} are not finite, or beyond {LARGEST:g}; they count as missing")
    if not new.all():
        notes.append(f"{(~new).sum()} samples of {signal} repeat the time of the sample before, and were dropped")
    return Signal(signal.field, signal.columns, time[new], values[new]), notes


def resample(signal: Signal, grid: Array, dt: float, hold: bool = False) -> Array:
    """The signal at the times of a uniform grid (T, size): slower ones interpolated linearly, or held, and faster ones
    averaged over a step that is centred at each time, so that nothing aliases and nothing is delayed."""
    t, x = signal.time, signal.values
    if hold:
        return x[np.clip(np.searchsorted(t, grid + 1e-9, side="right") - 1, 0, None)]
    if signal.step > 0.67 * dt:
        return np.stack([np.interp(grid, t, column) for column in x.T], -1)
    area = np.concatenate((np.zeros_like(x[:1]), np.cumsum((x[1:] + x[:-1]) * np.diff(t)[:, None] / 2.0, 0)))

    def integral(at: Array) -> Array:  # of the linear interpolation, from t[0] to each time
        k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        share = (at - t[k])[:, None]
        slope = (x[k + 1] - x[k]) / (t[k + 1] - t[k])[:, None]
        return area[k] + share * (x[k] + slope * share / 2.0)

    low, high = np.clip(grid - dt / 2.0, t[0], t[-1]), np.clip(grid + dt / 2.0, t[0], t[-1])
    return (integral(high) - integral(low)) / (high - low)[:, None]


def cover(main: Sequence[Signal], grid: Array, step: float, max_gap: float, notes: list[str]) -> Mask:
    """Which times lie in no gap of any stream; gaps, and streams that are slower than the log, are noted."""
    valid = np.ones(len(grid), bool)
    told: dict[tuple[int, float], list[str]] = {}
    for signal in main:
        free, gaps = _covered(signal, grid, max_gap)
        if signal.field in ("position", "quaternion"):
            held, stuck = _frozen(signal, grid, max_gap)
            free, gaps = free & ~held, np.concatenate((gaps, stuck))
        valid &= free
        if len(gaps):
            told.setdefault((len(gaps), round(float(gaps.max()), 3)), []).append(signal.field)
        if signal.step > 1.5 * step:
            notes.append(f"{signal.field} comes at {1.0 / signal.step:.0f} Hz only: interpolated")
    for (count, longest), fields in told.items():
        notes.append(f"{count} gap(s) of up to {longest:g} s in {', '.join(fields)}: cut out")
    return valid


def on_grid(signals: Mapping[str, Signal], grid: Array, step: float) -> dict[str, Array]:
    """Every quantity of the schema at the times of the grid, derived from others where the file lacks it."""
    q = signals["quaternion"]
    signals = {**signals, "quaternion": replace(q, values=continuous(q.values))}
    at = {name: resample(s, grid, step, hold=name.startswith("setpoint.")) for name, s in signals.items()}
    at["quaternion"] /= np.linalg.norm(at["quaternion"], axis=-1, keepdims=True)
    if "velocity_body" in at:
        at["velocity"] = rotate(at["quaternion"], at.pop("velocity_body"))
    if "velocity" not in at:
        at["velocity"] = slope(at["position"], step)
    if "angular_velocity" not in at:
        at["angular_velocity"] = body_rates(at["quaternion"], step)
    return at


def _covered(signal: Signal, grid: Array, max_gap: float) -> tuple[Mask, Array]:
    """Which times of the grid lie in no gap of the signal, and the lengths of its gaps [s]."""
    spacing = np.diff(signal.time)
    gap = spacing > max(max_gap, 3.0 * signal.step)
    k = np.searchsorted(signal.time, grid, side="right") - 1
    inside = (k >= 0) & (k < len(spacing)) & gap[np.clip(k, 0, len(gap) - 1)]
    inside &= grid > signal.time[np.clip(k, 0, None)] + 1e-9
    return ~inside, spacing[gap]


def _frozen(signal: Signal, grid: Array, max_gap: float) -> tuple[Mask, Array]:
    """Which times of the grid lie where the signal repeats itself digit by digit for longer than ``max_gap``, and for
    how long [s]: a tracker that lost the drone. A signal that is held between slower samples is not frozen."""
    edges = runs((np.diff(signal.values, axis=0) == 0.0).all(-1))
    lengths = signal.time[edges[:, 1]] - signal.time[edges[:, 0]]
    usual = float(np.median(lengths)) if len(lengths) > 0.05 * len(signal.time) else 0.0
    long = lengths > max(max_gap, 3.0 * usual)
    ends = signal.time[edges[long]]
    changes = np.zeros(len(grid) + 1, int)
    np.add.at(changes, np.searchsorted(grid, ends[:, 0] + 1e-9, side="right"), 1)
    np.add.at(changes, np.searchsorted(grid, ends[:, 1] - 1e-9), -1)
    return np.cumsum(changes[:-1]) > 0, lengths[long]


def runs(mask: Mask, shortest: float = 0.0, dt: float = 1.0) -> NDArray[np.int_]:
    """Where the mask holds without a break for ``shortest`` [s] or longer, as pairs (start, stop) in rows (N, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))).reshape(-1, 2)
    return edges[(edges[:, 1] - edges[:, 0]) * dt >= shortest - 1e-9]


def slope(x: Array, dt: float) -> Array:
    """The rate of change (T, n): at each sample the slope of the line through its neighbours within 0.04 s."""
    half = min(max(1, round(0.04 / dt)), (len(x) - 1) // 2)
    k = np.arange(-half, half + 1)
    padded = np.concatenate((2.0 * x[0] - x[half:0:-1], x, 2.0 * x[-1] - x[-2 : -half - 2 : -1]))
    return convolved(padded, -k / (k @ k * dt))


def smooth(x: Array, dt: float, span: float = 0.1) -> Array:
    """The mean of the samples within ``span / 2`` [s] of each (T, n)."""
    half = min(max(0, round(span / dt / 2.0)), (len(x) - 1) // 2)
    padded = np.pad(x, ((half, half), (0, 0)), mode="edge")
    return convolved(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)))


def body_rates(q: Array, dt: float) -> Array:
    """Angular velocity in the body frame (T, 3) [rad/s]: twice the vector part of q^-1 dq/dt."""
    return 2.0 * multiply(conjugate(q), slope(q, dt))[:, 1:]


def numbers(raw: NDArray[Any]) -> Array:
    """A column in float64."""
    with np.errstate(invalid="ignore"):  # NaN of some patterns warn
        return raw.astype(float)


def convolved(x: Array, kernel: Array) -> Array:
    """Each column of a series (T, n) with a kernel, where they overlap wholly."""
    return np.stack([np.convolve(column, kernel, "valid") for column in x.T], -1)
