"""Logs of real flights in one schema: SI units, our frames, one clock."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from torchrl_quad.deploy.frames import Convention
from torchrl_quad.identification.errors import MissingColumns, NoFlight, UnreadableLog
from torchrl_quad.identification.layouts import LAYOUTS, Layout, gather, own_layout
from torchrl_quad.identification.streams import Array, Stream, clean, covered, resample


@dataclass(frozen=True)
class FlightLog:
    """A flight as :func:`read_log` gives it: world z up, body FLU, quaternions (w, x, y, z) from body to world."""

    name: str
    time: Array  #: (T,) [s], in uniform steps from 0
    position: Array  #: (T, 3) [m], world frame
    quaternion: Array  #: (T, 4), unit norm, without jumps of sign
    velocity: Array  #: (T, 3) [m/s], world frame
    angular_velocity: Array  #: (T, 3) [rad/s], body frame
    acceleration: Array | None  #: (T, 3) [m/s^2], specific force in the body frame: what an accelerometer measures
    motor_command: Array  #: (T, 4), 0 to 1 of the full command; front left, back left, back right, front right
    battery_voltage: Array | None  #: (T,) [V]
    setpoint: Mapping[str, Array] | None  #: what the controller was asked for, by name
    segments: tuple[tuple[int, int], ...]  #: (start, stop) of pieces in flight without gaps: ``position[start:stop]``
    onboard: tuple[str, ...]  #: fields by the on-board clock: late against the others by an unknown, constant delay
    notes: tuple[str, ...]  #: what was found and done

    @property
    def dt(self) -> float:
        """The step [s]."""
        return float(self.time[1] - self.time[0])


def read_log(
    path: str | Path,
    columns: str | Mapping[str, Sequence[str] | str] | None = None,
    *,
    scale: Mapping[str, ArrayLike] | None = None,
    convention: Convention | None = None,
    onboard: Sequence[str] | None = None,
    dt: float | None = None,
    clearance: float = 0.1,
    max_gap: float = 0.05,
    min_duration: float = 0.5,
) -> FlightLog:
    """Read the log of a flight."""
    path = Path(path)
    streams, layout = _read_csv(path, columns, scale)
    if convention is not None:
        layout = replace(layout, convention=convention)
    if onboard is not None:
        layout = replace(layout, onboard=tuple(onboard))
    notes = []
    signals = {}
    for quantity, signal in gather(layout, streams, path.name).items():
        signals[quantity], note = clean(signal)
        notes += [note] if note else []
    main = [s for q, s in signals.items() if q != "battery_voltage" and not q.startswith("setpoint.")]
    step = dt or round(signals["quaternion"].step, 5)
    start, stop = max(s.time[0] for s in main), min(s.time[-1] for s in main)
    grid = start + step * np.arange(int((stop - start) / step + 1e-6) + 1)
    valid = np.ones(len(grid), bool)
    for signal in main:
        inside, gaps = covered(signal, grid, max_gap)
        valid &= inside
        if len(gaps):
            notes.append(f"{len(gaps)} gaps of up to {gaps.max():.3g} s in {signal}: cut out")
    at = {q: resample(s, grid, step, hold=q.startswith("setpoint.")) for q, s in signals.items()}
    q = at["quaternion"] / np.linalg.norm(at["quaternion"], axis=-1, keepdims=True)
    motors = at["motor_command"]
    z = at["position"][:, 2]
    still = motors.mean(-1) < 0.02
    flying = valid & ~still & (z > np.median(z[still]) + clearance if still.any() else True)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flying.astype(int), [0]))))
    segments = tuple((int(a), int(b)) for a, b in edges.reshape(-1, 2) if (b - a) * step >= min_duration)
    if not segments:
        raise NoFlight(f"{path.name}: nothing in it flies.")
    setpoint = {q.removeprefix("setpoint."): x for q, x in at.items() if q.startswith("setpoint.")}
    return FlightLog(
        path.name.removesuffix(".gz").removesuffix(".csv"),
        grid - start,
        at["position"],
        q,
        at["velocity"],
        at["angular_velocity"],
        at.get("acceleration"),
        np.clip(motors, 0.0, 1.0),
        at["battery_voltage"][:, 0] if "battery_voltage" in at else None,
        {name: x[:, 0] if x.shape[-1] == 1 else x for name, x in setpoint.items()} or None,
        segments,
        layout.onboard,
        tuple(notes),
    )


def _read_csv(
    path: Path, columns: str | Mapping[str, Sequence[str] | str] | None, scale: Mapping[str, ArrayLike] | None
) -> tuple[list[Stream], Layout]:
    with gzip.open(path, "rt") if path.suffix == ".gz" else open(path) as file:
        header = [name.strip() for name in file.readline().split(",")]
        table = np.genfromtxt(file, delimiter=",", ndmin=2)
    if table.size == 0:
        raise UnreadableLog(f"{path.name} has no rows.")
    if isinstance(columns, Mapping):
        layout = own_layout(columns, scale)
    elif columns is not None:
        layout = LAYOUTS[columns]
    else:
        known = (x for x in LAYOUTS.values() if {*x.time.names, *x.columns["position"][0].names} <= set(header))
        layout = next(known, None)
        if layout is None:
            raise MissingColumns(f"No preset knows the columns of {path.name}.")
    data = dict(zip(header, table.T, strict=True))
    time = data[layout.time.names[0]] * np.asarray(layout.time.scale)
    return [Stream("csv", time, data)], layout
