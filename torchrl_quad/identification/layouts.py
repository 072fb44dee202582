"""Layouts: which columns of a file are which quantity, in which unit and convention."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from torchrl_quad.deploy import frames
from torchrl_quad.dynamics import presets
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.identification.errors import MissingColumns, UnreadableLog
from torchrl_quad.identification.signals import LARGEST, Signal, Stream

# How many columns a quantity has, and which quantity of a convention has its frame and order. Setpoints may have any
# number of columns.
QUANTITIES: dict[str, tuple[int, str | None]] = {
    "position": (3, "position"),
    "quaternion": (4, "quaternion"),
    "euler": (3, None),
    "velocity": (3, "velocity"),
    "velocity_body": (3, "angular_velocity"),  # as all vectors of the body
    "angular_velocity": (3, "angular_velocity"),
    "acceleration": (3, "angular_velocity"),
    "motor_command": (4, "motors"),
    "rotor_speed": (4, "motors"),
    "battery_voltage": (1, None),
}
# Two names of one thing: who names one leaves out the other, and of what a file has the first is read.
RIVALS = (("quaternion", "euler"), ("velocity", "velocity_body"), ("motor_command", "rotor_speed"))
_TRANSLATED = ("position", "velocity", "quaternion", "angular_velocity")  # setpoints
NEEDED = (("position",), ("quaternion", "euler"), ("motor_command", "rotor_speed"))
G = 9.80665
OURS = frames.Convention("torchrl_quad", motors=(0, 1, 2, 3))
ROS = frames.Convention("ROS", xyzw=True, motors=(0, 1, 2, 3))
BY_IMU = ("angular_velocity", "acceleration", "motor_command", "battery_voltage", "setpoint")


@dataclass(frozen=True)
class Columns:
    """The columns of one quantity: value = scale * (what the file says - offset), in SI units.

    ``Columns(("m1", "m2", "m3", "m4"), scale=1e-3, offset=1000)`` reads pulses from 1000 to 2000 us as 0 to 1.
    """

    names: tuple[str, ...]
    scale: ArrayLike = 1.0
    offset: ArrayLike = 0.0

    def __post_init__(self) -> None:
        names = (self.names,) if isinstance(self.names, str) else self.names
        if not (isinstance(names, Sequence) and names and all(isinstance(name, str) for name in names)):
            raise UserValueError(f"Columns: names must be the names of columns, got {shown(self.names)}.")
        object.__setattr__(self, "names", tuple(names))
        for field in ("scale", "offset"):
            value = getattr(self, field)
            try:
                numbers = presets.as_array(value)
            except (ValueError, RecursionError):
                numbers = np.array(np.nan)
            fits = numbers.shape in ((), (len(names),)) and (np.abs(numbers) <= 1e30).all()
            if not fits or (field == "scale" and not numbers.all()):
                rule = "a number, or one for each column" + (", and none may be zero" if field == "scale" else "")
                raise UserValueError(f"Columns: {field} of {', '.join(names)} must be {rule}; got {shown(value)}.")
            object.__setattr__(self, field, tuple(numbers.tolist()) if numbers.ndim else float(numbers))


@dataclass(frozen=True)
class Layout:
    """Where one kind of file keeps each quantity."""

    columns: Mapping[str, tuple[Columns, ...]]  #: choices for each quantity; the first that the file has is read
    convention: frames.Convention = OURS  #: the frames, and the order in which quaternions and motors are named
    onboard: tuple[str, ...] = ()  #: fields by a clock of their own
    time: Columns = Columns(("time",))  #: of CSV files; others have clocks
    required: frozenset[str] = frozenset()  #: quantities that a caller named; a file without their columns is refused

    def __post_init__(self) -> None:
        if not isinstance(self.convention, frames.Convention):
            raise UserTypeError(f"convention must be one of torchrl_quad.deploy.frames, got {shown(self.convention)}.")
        for quantity, choices in (*self.columns.items(), ("time", (self.time,))):
            for choice in choices:
                _as_columns(quantity, choice)

    @property
    def names(self) -> set[str]:
        """The columns of all quantities."""
        return {name for choices in self.columns.values() for choice in choices for name in choice.names}


def _as_columns(quantity: object, names: object) -> Columns:
    if isinstance(names, Mapping) and "names" in names and set(names) <= {"names", "scale", "offset"}:
        names = Columns(**cast("dict[str, Any]", dict(names)))
    if not isinstance(names, Columns):
        if not isinstance(names, Sequence) or isinstance(names, bytes):
            raise UserTypeError(
                f"columns: {shown(quantity)} takes the name of a column, a list of them, or Columns; got "
                f"{shown(names)}."
            )
        names = Columns((names,) if isinstance(names, str) else tuple(names))
    count, sizes = len(names.names), {**{name: size for name, (size, _) in QUANTITIES.items()}, "time": 1}
    if not (isinstance(quantity, str) and (quantity in sizes or quantity.startswith("setpoint."))):
        raise MissingColumns(
            f"Unknown quantity {shown(quantity)} in columns. Choose from: {', '.join(sizes)}, setpoint.NAME."
        )
    size = sizes.get(quantity, count)
    if len(set(names.names)) < count:
        raise MissingColumns(f"{quantity} names a column twice: {', '.join(names.names)}. Name {count} different ones.")
    if count != size:
        raise MissingColumns(f"{quantity} takes {size} column(s), got {count}: {', '.join(names.names)}. Name each.")
    return names


def named_alike(names: str, of: str = "", scale: ArrayLike = 1.0, offset: ArrayLike = 0.0) -> Columns:
    """Columns whose names all begin with ``of``, as the files of this package list them."""
    return Columns(tuple(of + name for name in names.split()), scale, offset)


def shipped(name: str) -> dict[str, Any]:
    """A file of this package."""
    return presets.parse(Path(__file__).with_name(name).read_bytes(), name)


Asked = str | Layout | Mapping[str, object] | None  # what a caller says of the columns
LAYOUTS = {
    name: Layout(
        {quantity: tuple(named_alike(**choice) for choice in choices) for quantity, choices in said["columns"].items()},
        getattr(frames, said["convention"])(),
        tuple(said.get("onboard", ())),
        Columns((said.get("time", "time"),)),
    )
    for name, said in shipped("layouts.yaml").items()
}
LAYOUTS["cfclient"] = replace(LAYOUTS["crazyflie"], time=Columns(("Timestamp",), 1e-3))


def choose(columns: Asked, default: Layout | None) -> Layout:
    """The layout for what a caller names: a preset, a layout, or a mapping, which replaces entries of a default."""
    if isinstance(columns, Layout):
        return columns
    if isinstance(columns, str):
        if columns not in LAYOUTS:
            raise MissingColumns(f"Unknown layout {shown(columns)}. Choose from: {', '.join(LAYOUTS)}.")
        return LAYOUTS[columns]
    if not isinstance(columns, Mapping):
        raise UserTypeError(
            f"columns must be the name of a layout ({', '.join(LAYOUTS)}), a Layout, or a mapping of quantities to "
            f"names of columns; got {shown(columns)}."
        )
    chosen = {quantity: (_as_columns(quantity, names),) for quantity, names in columns.items() if names is not None}
    time = chosen.pop("time", None)
    default = default or Layout({}, onboard=BY_IMU)
    ousted = {*columns, *(rival for pair in RIVALS for rival in pair if set(pair) & set(chosen))}
    kept = {quantity: choices for quantity, choices in default.columns.items() if quantity not in ousted}
    return replace(default, columns=kept | chosen, time=time[0] if time else default.time, required=frozenset(chosen))


def settled(layout: Layout, streams: Sequence[Stream]) -> Layout:
    """The layout with one choice for each quantity that the streams have: the first that is not zero all along.

    Autopilots write zeros where nothing is measured, as of a first battery that is not there.
    """
    columns = {column: values for stream in reversed(streams) for column, values in stream.columns.items()}
    kept = dict(layout.columns)
    for quantity, choices in kept.items():
        there = [c for c in choices if columns.keys() >= set(c.names)]
        measured = [c for c in there if any(np.any(columns[column]) for column in c.names)]
        kept[quantity] = tuple((measured or there)[:1]) or choices
    return replace(layout, columns=kept)


def gather(layout: Layout, streams: Sequence[Stream], name: str) -> dict[str, Signal]:
    """Each quantity of a settled layout that the streams have, in our units, frames and orders; NaN beyond
    ``LARGEST``."""
    owner = {column: stream for stream in reversed(streams) for column in stream.columns}
    found = {}
    for quantity, choices in layout.columns.items():
        choice = next((c for c in choices if owner.keys() >= set(c.names)), None)
        if choice is None:
            if quantity in layout.required:
                missing = sorted({column for c in choices for column in c.names} - owner.keys())
                raise MissingColumns(
                    f"{name} has no column {', '.join(missing)}, named for {quantity}. {_columns_there(owner, missing)}"
                )
            continue
        stream = owner[choice.names[0]]
        if any(owner[column] is not stream for column in choice.names):
            raise UnreadableLog(
                f"{name}: the columns of {quantity}, {', '.join(choice.names)}, are in different streams, whose "
                "samples have different times. Name columns of one."
            )
        with np.errstate(over="ignore", invalid="ignore"):  # damage makes NaN and numbers of any size
            values = np.stack([np.asarray(stream.columns[column], float) for column in choice.names], -1)
            values[np.isin(values, (-9999.0, -99999.0, 99999.0))] = np.nan  # as programs write what is missing
            values = (values - np.asarray(choice.offset, float)) * np.asarray(choice.scale, float)
        values[~(np.abs(values) < LARGEST)] = np.nan
        setpoint = quantity.removeprefix("setpoint.")
        _, alike = QUANTITIES.get(quantity, (0, setpoint if setpoint in _TRANSLATED else None))
        if alike and not (alike == "motors" and layout.convention.motors is None):
            values = layout.convention.back({alike: values})[alike]
        found[quantity] = Signal(quantity, choice.names, stream.time, values)
    for first, second in RIVALS:
        if first in found:
            found.pop(second, None)
    for quantities in NEEDED:
        if not found.keys() & set(quantities):
            asked = [column for q in quantities for choice in layout.columns.get(q, ()) for column in choice.names]
            raise MissingColumns(
                f"{name} has no {' or '.join(quantities)}: looked for {', '.join(asked) or 'nothing'}. Every log needs "
                f"position, attitude and motor commands. {_columns_there(owner, asked)}"
            )
    return found


def match(header: Sequence[str], name: str) -> Layout:
    """The preset for the columns of a CSV file."""
    for layout in LAYOUTS.values():
        if any({*layout.time.names, *place.names} <= set(header) for place in layout.columns["position"]):
            return layout
    if {"gyroADC[0]", "motor[0]"} <= set(header) and not any(x.startswith("navPos") for x in header):
        raise blackbox(name)
    raise MissingColumns(f"No preset knows the columns of {name}. {_columns_there(header)}")


def blackbox(name: str) -> MissingColumns:
    """The error of a log of Betaflight, or of its decoder."""
    return MissingColumns(
        f"{name} is a Betaflight blackbox log: it has gyro, accelerometer and motors, and neither position nor "
        "attitude, which every log needs. Fly in motion capture, decode the log with blackbox_decode, add the poses at "
        "its times, and name all columns."
    )


def _columns_there(names: Iterable[str], asked: Sequence[str] = ()) -> str:
    names = [*names]
    time = "" if any("." in name for name in names) else '"time": "t", '  # of an autopilot, which has its clock
    return (
        f'Name them: columns={{{time}"position": ["x", "y", "z"], ...}}. '
        f"There are{listed(names, [*asked, *QUANTITIES])}."
    )


def listed(names: Iterable[str], asked: Sequence[str]) -> str:
    """What there is, whole where 2200 letters hold it, else what is most like something asked for."""
    there, most = sorted(names), 2200
    if sum(map(len, there)) + 2 * len(there) <= most:
        return f": {', '.join(there) or 'none'}"
    words = [set(_words(x)) for x in asked]
    rank = {x: max(len(w & set(_words(x))) / max(len(w), 1) for w in words) for x in there[: 10**4]}
    ranked = sorted(rank, key=lambda x: -rank[x])
    ends = itertools.accumulate(len(x) + 2 for x in ranked)
    kept = [x for x, end in zip(ranked, ends, strict=True) if end <= most]
    return f" {len(there)}, of which these are most alike: {', '.join(kept)}"


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]{2,}|\d+", name.lower())
