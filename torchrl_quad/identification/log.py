"""Logs of real flights in one schema: SI units, our frames, one clock."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from torchrl_quad.deploy.frames import Convention
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.identification import checks, motor_checks
from torchrl_quad.identification.errors import (
    GapsTooLarge,
    LogError,
    NoFlight,
    UnreadableLog,
    WrongMotors,
    WrongUnit,
    in_units,
)
from torchrl_quad.identification.layouts import QUANTITIES, Columns, Layout, gather, settled
from torchrl_quad.identification.pieces import broken, find_pieces, motors_on
from torchrl_quad.identification.remedies import Mended, remedy_for
from torchrl_quad.identification.signals import LARGEST, Array, Signal, Stream, clean, cover, on_grid
from torchrl_quad.identification.sources import read_streams
from torchrl_quad.options import NonNegative, checked
from torchrl_quad.rotations import from_euler

_LONGEST = 3000  # letters of an error: it lists up to 60 columns
LEAST_STEP, MAX_STEPS = 1e-3, 1_000_000  # [s] of a log, and how many: 17 minutes at 1 kHz, half a gigabyte
FULL_SPEED = 4000.0  # [rad/s], of which rotor speeds are given as shares where a file has them instead of commands
_OPTIONAL = ("battery_voltage", "setpoint.")
_FIELDS = [name for name in QUANTITIES if name not in ("euler", "velocity_body", "rotor_speed")]


@checked
@dataclass(frozen=True)
class FlightLog:
    """A flight as :func:`read_log` gives it: world z up, body FLU, quaternions (w, x, y, z) from body to world.

    All fields are of float64 and share ``time``. Streams of other clocks were put there as if they had the same clock:
    the fields that ``onboard`` names may be late by a constant delay, which the fit estimates.
    """

    name: str
    time: Array  #: (T,) [s], in uniform steps from 0
    position: Array  #: (T, 3) [m], world frame
    quaternion: Array  #: (T, 4), unit norm, without jumps of sign
    velocity: Array  #: (T, 3) [m/s], world frame
    angular_velocity: Array  #: (T, 3) [rad/s], body frame
    acceleration: Array | None  #: (T, 3) [m/s^2], what an accelerometer measures, body frame
    motor_command: Array  #: (T, 4), 0 to 1 of the full command; front left, back left, back right, front right
    battery_voltage: Array | None  #: (T,) [V]
    setpoint: Mapping[str, Array] | None  #: what the controller was asked for, by name, held between samples
    segments: tuple[tuple[int, int], ...]  #: pieces in flight without gaps, for ``position[start:stop]``
    onboard: tuple[str, ...]  #: fields by another clock than the position's, late by an unknown, constant delay
    notes: tuple[str, ...]  #: what was found and done, a sentence each

    def __post_init__(self) -> None:
        length = np.shape(self.time)[:1]
        for field in ("time", *_FIELDS):
            value = getattr(self, field)
            shape = () if field in ("time", "battery_voltage") else (QUANTITIES[field][0],)
            if value is None and field in ("acceleration", "battery_voltage"):
                continue
            fits = isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.shape == (*length, *shape)
            if not (fits and len(value) > 1 and (np.abs(value) < LARGEST).all()):
                raise UserValueError(
                    f"FlightLog: {field} must be a float array {('T', *shape)} of finite numbers, T of them at least "
                    f"two; got {shown(value)}."
                )
        if not (self.dt < 0.5 and (np.abs(np.diff(self.time) - self.dt) < 1e-3 * self.dt).all()):
            raise UserValueError(f"FlightLog: time must rise in uniform steps below 0.5 s, got {shown(self.time)}.")
        if not (self.setpoint is None or isinstance(self.setpoint, Mapping)):
            raise UserTypeError(f"FlightLog: setpoint must be arrays by name, or None; got {shown(self.setpoint)}.")
        ends = [end for piece in self.segments for end in piece]
        if ends != sorted(ends) or not all(0 <= end <= length[0] for end in ends):
            raise UserValueError(
                f"FlightLog: segments must be pairs (start, stop) in order, from 0 to {length[0]}; got "
                f"{shown(self.segments)}."
            )

    @property
    def dt(self) -> float:
        """The step [s]."""
        return float(self.time[1] - self.time[0])

    def __str__(self) -> str:
        pieces = ", ".join(f"{a * self.dt:.2f} to {b * self.dt:.2f}" for a, b in self.segments)
        lines = [f"{self.name}: {len(self.time)} samples in steps of {1000.0 * self.dt:g} ms; in flight {pieces} s"]
        return "\n".join(lines + [f"- {note}" for note in self.notes])


@checked
def read_log(
    path: str | Path,
    columns: str | Layout | Mapping[str, str | Sequence[str] | Columns | Mapping[str, Any] | None] | None = None,
    *,
    convention: Convention | None = None,
    onboard: Sequence[str] | None = None,
    dt: Annotated[float, Field(ge=LEAST_STEP, lt=0.5)] | None = None,
    clearance: NonNegative = 0.1,
    max_gap: NonNegative = 0.05,
    min_duration: NonNegative = 0.5,
) -> FlightLog:
    """Read the log of a flight: CSV (also gz), PX4 ULog, ArduPilot dataflash log, ROS bag, or uSD log of a Crazyflie.

    Bags need rosbags: ``pip install '.[logs]'`` in a clone. ``docs/flight_logs.md`` has examples and limits.

    Args:
        path: a file, or the folder of a ROS 2 bag. Its first bytes say of what kind it is.
        columns: which columns are which quantity: the name of a preset in ``LAYOUTS``, a :class:`Layout`, or a mapping
            from quantities to names or :class:`Columns`, in the order of the convention. By default the kind of file
            and the header decide. A mapping replaces entries of the preset for the file, and None leaves one out; it
            describes all of a CSV file, if it names position, attitude and motors.
            ``{"names": [...], "scale": 1e-3}`` is short for Columns.
        convention: the frames and orders of the file, of :mod:`torchrl_quad.deploy.frames`; by default the preset's,
            and for a mapping of a CSV file ours. Its ``xyzw`` and ``motors`` say how quaternions and motors are named.
        onboard: fields that another clock than the position's has stamped; "setpoint" is one.
        dt: step of the result [s], from 0.001 to below 0.5; by default that of the attitude, or 0.001 if it is less.
        clearance: height above where the drone stood [m] up to which it counts as on the ground.
        max_gap: the longest time without samples [s] that is bridged; at least three usual steps always are. Longer
            gaps separate pieces.
        min_duration: the shortest piece in flight that is kept [s].

    Raises:
        LogError: the log cannot be used. Its subclasses name the reason, and what its message tells to write was tried.
    """
    path = Path(path)
    options: dict[str, Any] = {"onboard": onboard, "dt": dt, "clearance": clearance}
    options |= {"max_gap": max_gap, "min_duration": min_duration}
    with _naming(path):
        streams, layout, notes = read_streams(path, columns)
        layout = layout if convention is None else replace(layout, convention=convention)
        layout = settled(layout, streams)
        start = Mended(layout, {column for stream in streams for column in stream.columns})

        def read(mended: Mended) -> FlightLog:
            factor = np.divide(mended.layout.time.scale, layout.time.scale)
            late = np.subtract(mended.layout.time.offset, layout.time.offset) * np.asarray(mended.layout.time.scale)
            moved = streams
            if mended.layout.time != layout.time:
                moved = [replace(stream, time=stream.time * factor - late) for stream in streams]
            if "span" in mended.changes:
                low, high = mended.changes["span"]
                moved = [stream.at((stream.time >= low) & (stream.time <= high)) for stream in moved]
            return _read(path, moved, mended.layout, list(notes), {**options, **mended.changes})

        try:
            return read(start)
        except LogError as error:
            mended = remedy_for(error, start, read)
            if mended is None:
                raise
            raise type(error)(f"{error} {mended.told(columns)}") from error


def _read(
    path: Path, streams: Sequence[Stream], layout: Layout, notes: list[str], options: Mapping[str, Any]
) -> FlightLog:
    """The flight in the streams of a file, as a layout says what they are, with the options of :func:`read_log`."""
    clearance, max_gap, min_duration = (options[name] for name in ("clearance", "max_gap", "min_duration"))
    fields = layout.onboard if options["onboard"] is None else tuple(options["onboard"])
    known = [*_FIELDS, "setpoint"]
    for field in fields:
        if field not in known:
            raise UserValueError(f"onboard: unknown field {shown(field)}. Choose from: {', '.join(known)}.")
    signals = _signals(layout, streams, path.name, notes)
    main = [signal for quantity, signal in signals.items() if not quantity.startswith(_OPTIONAL)]
    grid, step = _grid(signals, main, options["dt"], path.name)
    valid = cover(main, grid, step, max_gap, notes)
    at = on_grid(signals, grid, step)
    on, _ = motors_on(at["motor_command"], step, path.name)
    sound = on & valid & ~broken(at, on, step)[0]
    moving = sound if sound.sum() > 10 else on
    checks.check_velocity(at, signals, step, moving)
    notes.append(checks.check_rates(at, signals, step, moving, layout.convention))
    checks.check_lean(at, signals, step, moving)
    checks.check_specific_force(at, signals, step, moving)
    segments, found = find_pieces(at, valid, step, path.name, clearance, max_gap, min_duration)
    notes.append(motor_checks.check_order(at, signals, step, segments))
    setpoint = {q.removeprefix("setpoint."): x for q, x in at.items() if q.startswith("setpoint.")}
    present = {q.partition(".")[0] for q in at}
    motion: Any = {q: at.get(q) for q in ("position", "quaternion", "velocity", "angular_velocity", "acceleration")}
    if "battery_voltage" not in at and "rotor_speed" not in layout.columns:
        notes.append("no battery voltage: the thrust of a command cannot be told from the charge of the battery")
    return FlightLog(
        name=path.name.removesuffix(".gz").rsplit(".", 1)[0] if path.is_file() else path.name,
        time=step * np.arange(len(grid), dtype=float),
        **motion,
        motor_command=np.clip(at["motor_command"], 0.0, 1.0),
        battery_voltage=at["battery_voltage"][:, 0] if "battery_voltage" in at else None,
        setpoint={name: x[:, 0] if x.shape[-1] == 1 else x for name, x in setpoint.items()} or None,
        segments=segments,
        onboard=tuple(f for f in fields if f in present and (f != "angular_velocity" or f in signals)),
        notes=tuple(notes + found),
    )


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Put errors of a log in one line that names its file."""
    try:
        yield
    except LogError as error:
        said = str(error) if path.name in str(error) else f"{path.name}: {error}"
        said = " ".join("".join(x if x.isprintable() else " " for x in said).split())  # names may hold anything
        raise type(error)(said if len(said) <= _LONGEST else f"{said[:_LONGEST]} ...") from error


def _next(name: str) -> str:
    """The name with its last number raised by one."""
    return re.sub(r"\d+(?=\D*$)", lambda found: str(int(found[0]) + 1), name)


def _signals(layout: Layout, streams: Sequence[Stream], name: str, notes: list[str]) -> dict[str, Signal]:
    """Each quantity at its own rate, finite, in order of time, and in range."""
    signals = {}
    gathered = gather(layout, streams, name)
    if "rotor_speed" in gathered:
        speeds = gathered.pop("rotor_speed")
        notes += motor_checks.check_speeds(speeds, FULL_SPEED)
        gathered["motor_command"] = replace(speeds, values=np.abs(speeds.values) / FULL_SPEED)
        gathered.pop("battery_voltage", None)
        notes.append(
            f"motor commands are rotor speeds as shares of {FULL_SPEED:g} rad/s, whatever the battery: a drone's "
            f"motor_command with speed_per_volt {FULL_SPEED:g}, nominal_voltage 1 and delay 0 keeps the speeds; they "
            f"reach {np.nanmax(np.abs(speeds.values)):.4g}, taken as rad/s"
        )
    motors, tables = gathered["motor_command"].columns, [x for x in streams if x.name == "csv"]  # others have arrays
    last = _next(max(motors))  # m5 after m4
    if last == max(motors):  # e after d
        last = f"{last[:-1]}{chr(ord(last[-1]) + 1)}"
    next_one = _next(last)
    if last not in motors and next_one != last and any({last, next_one} <= x.columns.keys() for x in tables):
        raise WrongMotors(
            f"{last} and {next_one} look like a fifth and a sixth motor. Only drones with four rotors are fitted; if "
            "they are no motors, leave their columns out."
        )
    if last not in motors and any(last in x.columns for x in tables):
        notes.append(f"{last} looks like a fifth motor: only {', '.join(motors)} are read, of a drone with four rotors")
    q, place = gathered.get("quaternion"), gathered["position"]
    if q is not None and q.time is place.time:
        place.values[~q.values.any(-1)] = np.nan  # trackers write zeros for what they do not see
    for quantity, signal in gathered.items():
        if quantity == "battery_voltage" and not (signal.values > 0.0).any():
            continue  # autopilots say 0 where no battery is measured
        if quantity == "battery_voltage":
            checks.check_voltage(signal)
        if quantity == "quaternion":
            notes += checks.check_quaternion(clean(signal)[0])
            norm = np.linalg.norm(signal.values, axis=-1, keepdims=True)
            unit = np.where(np.abs(norm - 1.0) < 0.05, signal.values / np.where(norm > 0.0, norm, 1.0), np.nan)
            signal = replace(signal, values=unit)
        if quantity.startswith(_OPTIONAL) and np.isfinite(signal.values).all(-1).sum() < 2:
            notes.append(f"{signal} holds no finite samples: left out")
            continue
        signals[quantity], dropped = clean(signal)
        notes += dropped
    if "quaternion" not in signals:
        euler = signals.pop("euler")
        checks.check_angles(euler)
        theirs = replace(layout.convention, xyzw=False)
        turned = theirs.back({"quaternion": from_euler(euler.values)})["quaternion"]
        signals["quaternion"] = replace(euler, values=turned)
    if signals["motor_command"].field == "motor_command":
        notes += motor_checks.check_motors(signals["motor_command"])
    return signals


def _grid(signals: Mapping[str, Signal], main: Sequence[Signal], dt: float | None, name: str) -> tuple[Array, float]:
    """The times that all streams share, in uniform steps, and the step [s]."""
    attitude = signals["quaternion"]
    step = dt or max(round(attitude.step, 5), LEAST_STEP)
    if not 0.0 < attitude.step < 0.5:
        units = in_units("time", "it is in", milliseconds=1e-3, microseconds=1e-6, nanoseconds=1e-9)
        counts = {f"at {hertz} Hz": 1.0 / hertz for hertz in (100, 50, 200, 250, 400, 500) if attitude.step == 1.0}
        units = in_units("time", "it counts samples", **counts) + units
        raise WrongUnit(f"{name}: the clock steps by {attitude.step:.4g} s, which is not a flight.", *units)
    start, stop = max(s.time[0] for s in main), min(s.time[-1] for s in main)
    span = stop - start
    if span < 20.0 * step:
        raise NoFlight(
            f"{name} is not a flight: its streams share {max(span, 0.0):.2f} s. Give a longer log, or name "
            "columns that were recorded at the same time."
        )
    if span > MAX_STEPS * step:  # a clock that jumps ahead, or a long log: seen before anything is put on a grid
        said = f"{name} spans {span:.4g} s, {span / step:.3g} steps of {step:g} s; the maximum is {MAX_STEPS:,}"
        signal = max(main, key=lambda s: np.diff(s.time).max())
        k = int(np.diff(signal.time).argmax())
        begin, end = signal.time[k : k + 2]
        if end - begin < 0.1 * span:
            raise UnreadableLog(f"{said}. Cut it into shorter logs.", {"dt": float(f"{2.0 * span / MAX_STEPS:.2g}")})
        raise GapsTooLarge(
            f"{said}. The clock of {signal} jumps from {begin:.10g} to {end:.10g} s at sample {k + 1}.",
            {"span": (float(signal.time[0]), float(begin))},
            {"span": (float(end), float(signal.time[-1]))},
        )
    return start + step * np.arange(int(span / step + 1e-6) + 1), step
