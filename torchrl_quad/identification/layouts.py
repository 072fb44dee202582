"""Layouts: which columns of a file are which quantity, in which unit and convention."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from torchrl_quad.deploy import frames
from torchrl_quad.dynamics.presets import as_array
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
    "battery_voltage": (1, None),
}
_TRANSLATED = ("position", "velocity", "quaternion", "angular_velocity")  # setpoints
_NEEDED = (("position",), ("quaternion", "euler"), ("motor_command",))
DEGREE = np.pi / 180.0
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
                numbers = as_array(value)
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
        onboard = None if isinstance(self.onboard, str) else self.onboard
        rules = {
            "columns must map quantities to tuples of Columns": isinstance(self.columns, Mapping)
            and all(_are(c, Columns) for c in self.columns.values()),
            "convention must be one of torchrl_quad.deploy.frames": isinstance(self.convention, frames.Convention),
            "onboard must be a tuple of fields": _are(onboard, str),
            "time must be Columns of one name": isinstance(self.time, Columns) and len(self.time.names) == 1,
            "required must be a set of quantities": isinstance(self.required, Set),
        }
        for rule, holds in rules.items():
            if not holds:
                raise UserValueError(f"Layout: {rule}, got {shown(getattr(self, rule.split()[0]))}.")
        for quantity, choices in self.columns.items():
            for choice in choices:
                _check_quantity(quantity, choice)

    @property
    def names(self) -> set[str]:
        """The columns of all quantities."""
        return {name for choices in self.columns.values() for choice in choices for name in choice.names}


def _are(values: object, kind: type) -> bool:
    return isinstance(values, Sequence) and all(isinstance(value, kind) for value in values)


def _check_quantity(quantity: object, columns: Columns) -> None:
    known = [*QUANTITIES, "time"]
    if not (isinstance(quantity, str) and (quantity in known or quantity.startswith("setpoint."))):
        raise MissingColumns(
            f"Unknown quantity {shown(quantity)} in columns. Choose from: {', '.join(known)}, setpoint.NAME."
        )
    count = len(columns.names)
    size = 1 if quantity == "time" else QUANTITIES.get(quantity, (count, None))[0]
    if count != size:
        raise MissingColumns(f"{quantity} takes {size} column(s), got {count}: {', '.join(columns.names)}. Name each.")


def _c(names: str, scale: ArrayLike = 1.0, offset: ArrayLike = 0.0, *, of: str = "") -> Columns:
    """Columns whose names all begin alike."""
    return Columns(tuple(of + name for name in names.split()), scale, offset)


LAYOUTS = {
    "nanobench": Layout(  # arXiv:2603.09908: Vicon, and the on-board log of a Crazyflie 2.1
        {
            "position": (_c("px py pz"),),
            "quaternion": (_c("qx qy qz qw"),),
            "velocity": (_c("vx vy vz"),),
            "angular_velocity": (_c("x y z", of="imu_gyro_"),),
            "acceleration": (_c("x y z", G, of="imu_acc_"),),
            "motor_command": (_c("m1 m2 m3 m4", 1 / 65535, of="motor_motor_"),),
            "battery_voltage": (_c("pwr_pm_vbat"),),
            "setpoint.position": (_c("x y z", of="sp_ctrltarget_"),),
            "setpoint.yaw": (_c("sp_ctrltarget_yaw", DEGREE),),
        },
        frames.crazyflie(),
        BY_IMU,
        Columns(("t",)),
    ),
    "px4": Layout(  # msg/*.msg of PX4 1.14; older firmware has no actuator_motors
        {
            "position": (_c("x y z", of="vehicle_local_position."),),
            "quaternion": (_c("[0] [1] [2] [3]", of="vehicle_attitude.q"),),
            "velocity": (_c("vx vy vz", of="vehicle_local_position."),),
            "angular_velocity": (
                _c("[0] [1] [2]", of="vehicle_angular_velocity.xyz"),
                _c("[0] [1] [2]", of="sensor_combined.gyro_rad"),
            ),
            "acceleration": (
                _c("[0] [1] [2]", of="vehicle_acceleration.xyz"),
                _c("[0] [1] [2]", of="sensor_combined.accelerometer_m_s2"),
            ),
            "motor_command": (
                _c("[0] [1] [2] [3]", of="actuator_motors.signal"),
                _c("[0] [1] [2] [3]", 1e-3, 1000.0, of="actuator_outputs.output"),
            ),
            "battery_voltage": (_c("battery_status.voltage_v"),),
            "setpoint.position": (
                _c("[0] [1] [2]", of="trajectory_setpoint.position"),
                _c("x y z", of="vehicle_local_position_setpoint."),
            ),
        },
        frames.px4(),
    ),
    "crazyflie": Layout(  # the log variables of the firmware, as the uSD deck writes them
        {
            "position": (_c("x y z", of="stateEstimate."), _c("x y z", 1e-3, of="stateEstimateZ.")),
            "quaternion": (_c("qx qy qz qw", of="stateEstimate."), _c("qx qy qz qw", of="stateEstimateZ.")),
            "euler": tuple(  # the firmware counts pitch the other way round
                _c("roll pitch yaw", (DEGREE, -DEGREE, DEGREE), of=group) for group in ("stateEstimate.", "stabilizer.")
            ),
            "velocity": (_c("vx vy vz", of="stateEstimate."), _c("vx vy vz", 1e-3, of="stateEstimateZ.")),
            "angular_velocity": (
                _c("x y z", DEGREE, of="gyro."),
                _c("rateRoll ratePitch rateYaw", (1e-3, -1e-3, 1e-3), of="stateEstimateZ."),
            ),
            "acceleration": (_c("x y z", G, of="acc."),),
            "motor_command": (_c("m1 m2 m3 m4", 1 / 65535, of="motor."),),
            "battery_voltage": (_c("pm.vbat"),),
            "setpoint.position": (_c("x y z", of="ctrltarget."),),
            "setpoint.yaw": (_c("ctrltarget.yaw", DEGREE),),
        },
        frames.crazyflie(),
    ),
}


def choose(columns: str | Layout | Mapping[str, object], default: Layout | None) -> Layout:
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
    chosen = {quantity: (_as_columns(quantity, names),) for quantity, names in columns.items()}
    time = chosen.pop("time", None)
    default = default or Layout({}, onboard=BY_IMU)
    kept = dict(default.columns)
    if "quaternion" in chosen or "euler" in chosen:  # the caller names the attitude: not that of the preset, too
        kept = {quantity: choices for quantity, choices in kept.items() if quantity not in ("quaternion", "euler")}
    return replace(default, columns=kept | chosen, time=time[0] if time else default.time, required=frozenset(chosen))


def _as_columns(quantity: str, names: object) -> Columns:
    if not isinstance(names, Columns):
        if not isinstance(names, Sequence) or isinstance(names, bytes):
            raise UserTypeError(
                f"columns: {shown(quantity)} takes the name of a column, a list of them, or Columns; got "
                f"{shown(names)}."
            )
        names = Columns(tuple(names) if not isinstance(names, str) else (names,))
    _check_quantity(quantity, names)
    return names


def gather(layout: Layout, streams: Sequence[Stream], name: str) -> dict[str, Signal]:
    """Each quantity of the layout that the streams have, in our units, frames and orders; NaN beyond ``LARGEST``."""
    owner = {column: stream for stream in reversed(streams) for column in stream.columns}
    found = {}
    for quantity, choices in layout.columns.items():
        choice = next((c for c in choices if all(column in owner for column in c.names)), None)
        if choice is None:
            if quantity in layout.required:
                missing = sorted({column for c in choices for column in c.names} - owner.keys())
                raise MissingColumns(
                    f"{name} has no column {', '.join(missing)}, named for {quantity}. {_columns_there(owner)}"
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
            values = (values - np.asarray(choice.offset, float)) * np.asarray(choice.scale, float)
        values[~(np.abs(values) < LARGEST)] = np.nan
        setpoint = quantity.removeprefix("setpoint.")
        _, alike = QUANTITIES.get(quantity, (0, setpoint if setpoint in _TRANSLATED else None))
        if alike and not (alike == "motors" and layout.convention.motors is None):
            values = layout.convention.back({alike: values})[alike]
        found[quantity] = Signal(quantity, choice.names, stream.time, values)
    if "quaternion" in found:
        found.pop("euler", None)
    if "velocity" in found:
        found.pop("velocity_body", None)
    for quantities in _NEEDED:
        if not found.keys() & set(quantities):
            asked = [column for q in quantities for choice in layout.columns.get(q, ()) for column in choice.names]
            raise MissingColumns(
                f"{name} has no {' or '.join(quantities)}: looked for {', '.join(asked) or 'nothing'}. Every log needs "
                f"position, attitude and motor commands. {_columns_there(owner)}"
            )
    return found


def match(header: Sequence[str], name: str) -> Layout:
    """The preset for the columns of a CSV file."""
    for layout in LAYOUTS.values():
        if {*layout.time.names, *layout.columns["position"][0].names} <= set(header):
            return layout
    raise MissingColumns(f"No preset knows the columns of {name}. {_columns_there(header)}")


def _columns_there(names: Iterable[str]) -> str:
    there = sorted(names)
    more = f" and {len(there) - 40} more" if len(there) > 40 else ""
    return (
        'Name them: columns={"time": "t", "position": ["x", "y", "z"], ...}. '
        f"There are: {', '.join(there[:40]) or 'none'}{more}."
    )
