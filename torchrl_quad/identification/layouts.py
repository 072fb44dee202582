"""Layouts: which columns of a file are which quantity, in which unit and convention."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from torchrl_quad.deploy import frames
from torchrl_quad.dynamics.presets import as_array
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.identification.errors import MissingColumns, UnreadableLog
from torchrl_quad.identification.streams import LARGEST, Array, Signal, Stream

SIZES = {  # how many columns a quantity has; setpoints may have any number
    "position": 3,
    "quaternion": 4,
    "euler": 3,
    "velocity": 3,
    "velocity_body": 3,
    "angular_velocity": 3,
    "acceleration": 3,
    "motor_command": 4,
    "battery_voltage": 1,
}
NEEDED = (("position",), ("quaternion", "euler"), ("motor_command",))
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
        is_names = isinstance(names, Sequence) and len(names) > 0 and all(isinstance(name, str) for name in names)
        if not is_names:
            raise UserValueError(f"Columns: names must be the names of columns, got {shown(self.names)}.")
        object.__setattr__(self, "names", tuple(names))
        for field in ("scale", "offset"):
            value = getattr(self, field)
            try:
                numbers = as_array(value)
                fits = numbers.shape in ((), (len(names),)) and (np.abs(numbers) <= 1e30).all()
            except (ValueError, RecursionError):
                fits = False
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
        rules = {
            "columns must map quantities to tuples of Columns": isinstance(self.columns, Mapping)
            and all(isinstance(c, Sequence) and all(isinstance(x, Columns) for x in c) for c in self.columns.values()),
            "convention must be one of torchrl_quad.deploy.frames": isinstance(self.convention, frames.Convention),
            "onboard must be a tuple of fields": isinstance(self.onboard, Sequence)
            and not isinstance(self.onboard, str)
            and all(isinstance(field, str) for field in self.onboard),
            "time must be Columns of one name": isinstance(self.time, Columns) and len(self.time.names) == 1,
            "required must be a set of quantities": isinstance(self.required, Set),
        }
        for rule, holds in rules.items():
            if not holds:
                raise UserValueError(f"Layout: {rule}, got {shown(getattr(self, rule.split()[0]))}.")
        for quantity, choices in self.columns.items():
            for choice in choices:
                _check_quantity(quantity, choice)


def _c(names: str, scale: ArrayLike = 1.0, offset: ArrayLike = 0.0) -> Columns:
    return Columns(tuple(names.split()), scale, offset)


def _three(stem: str) -> str:
    return " ".join(f"{stem}[{k}]" for k in range(3))


def _check_quantity(quantity: object, columns: Columns) -> None:
    known = [*SIZES, "time", "setpoint.NAME"]
    is_known = isinstance(quantity, str) and (quantity in known[:-1] or quantity.startswith("setpoint."))
    if not is_known:
        raise MissingColumns(f"Unknown quantity {shown(quantity)} in columns. Choose from: {', '.join(known)}.")
    size = 1 if quantity == "time" else SIZES.get(quantity, len(columns.names))
    if len(columns.names) != size:
        raise MissingColumns(
            f"{quantity} takes {size} column(s), got {len(columns.names)}: {', '.join(columns.names)}. Name each."
        )


LAYOUTS = {
    "nanobench": Layout(  # arXiv:2603.09908: Vicon, and the on-board log of a Crazyflie 2.1
        {
            "position": (_c("px py pz"),),
            "quaternion": (_c("qx qy qz qw"),),
            "velocity": (_c("vx vy vz"),),
            "angular_velocity": (_c("imu_gyro_x imu_gyro_y imu_gyro_z"),),
            "acceleration": (_c("imu_acc_x imu_acc_y imu_acc_z", G),),
            "motor_command": (_c("motor_motor_m1 motor_motor_m2 motor_motor_m3 motor_motor_m4", 1 / 65535),),
            "battery_voltage": (_c("pwr_pm_vbat"),),
            "setpoint.position": (_c("sp_ctrltarget_x sp_ctrltarget_y sp_ctrltarget_z"),),
            "setpoint.yaw": (_c("sp_ctrltarget_yaw", DEGREE),),
        },
        frames.crazyflie(),
        BY_IMU,
        Columns(("t",)),
    ),
    "px4": Layout(  # msg/*.msg of PX4 1.14; older firmware has no actuator_motors
        {
            "position": (_c("vehicle_local_position.x vehicle_local_position.y vehicle_local_position.z"),),
            "quaternion": (_c(f"vehicle_attitude.q[0] {' '.join(f'vehicle_attitude.q[{k}]' for k in (1, 2, 3))}"),),
            "velocity": (_c("vehicle_local_position.vx vehicle_local_position.vy vehicle_local_position.vz"),),
            "angular_velocity": (_c(_three("vehicle_angular_velocity.xyz")), _c(_three("sensor_combined.gyro_rad"))),
            "acceleration": (
                _c(_three("vehicle_acceleration.xyz")),
                _c(_three("sensor_combined.accelerometer_m_s2")),
            ),
            "motor_command": (
                _c(" ".join(f"actuator_motors.signal[{k}]" for k in range(4))),
                _c(" ".join(f"actuator_outputs.output[{k}]" for k in range(4)), 1e-3, 1000.0),
            ),
            "battery_voltage": (_c("battery_status.voltage_v"),),
            "setpoint.position": (
                _c(_three("trajectory_setpoint.position")),
                _c(" ".join(f"vehicle_local_position_setpoint.{axis}" for axis in "xyz")),
            ),
        },
        frames.px4(),
    ),
    "crazyflie": Layout(  # the log variables of the firmware, as the uSD deck writes them
        {
            "position": (
                _c("stateEstimate.x stateEstimate.y stateEstimate.z"),
                _c("stateEstimateZ.x stateEstimateZ.y stateEstimateZ.z", 1e-3),
            ),
            "quaternion": (
                _c("stateEstimate.qx stateEstimate.qy stateEstimate.qz stateEstimate.qw"),
                _c("stateEstimateZ.qx stateEstimateZ.qy stateEstimateZ.qz stateEstimateZ.qw"),
            ),
            "euler": tuple(  # the firmware counts pitch the other way round
                _c(f"{group}.roll {group}.pitch {group}.yaw", (DEGREE, -DEGREE, DEGREE))
                for group in ("stateEstimate", "stabilizer")
            ),
            "velocity": (
                _c("stateEstimate.vx stateEstimate.vy stateEstimate.vz"),
                _c("stateEstimateZ.vx stateEstimateZ.vy stateEstimateZ.vz", 1e-3),
            ),
            "angular_velocity": (
                _c("gyro.x gyro.y gyro.z", DEGREE),
                _c("stateEstimateZ.rateRoll stateEstimateZ.ratePitch stateEstimateZ.rateYaw", (1e-3, -1e-3, 1e-3)),
            ),
            "acceleration": (_c("acc.x acc.y acc.z", G),),
            "motor_command": (_c("motor.m1 motor.m2 motor.m3 motor.m4", 1 / 65535),),
            "battery_voltage": (_c("pm.vbat"),),
            "setpoint.position": (_c("ctrltarget.x ctrltarget.y ctrltarget.z"),),
            "setpoint.yaw": (_c("ctrltarget.yaw", DEGREE),),
        },
        frames.crazyflie(),
    ),
}


def choose(columns: str | Layout | Mapping[str, object], default: Layout | None) -> Layout:
    """The layout for what a caller names: a preset, a layout, or a mapping, which goes over the default if there is
    one."""
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
    time = chosen.pop("time", (Columns(("time",)),))[0]
    required = frozenset(chosen)
    if default is None:
        return Layout(chosen, onboard=BY_IMU, time=time, required=required)
    if "quaternion" in chosen or "euler" in chosen:
        default_columns = {q: c for q, c in default.columns.items() if q not in ("quaternion", "euler")}
    else:
        default_columns = dict(default.columns)
    time = time if "time" in columns else default.time
    return replace(default, columns=default_columns | chosen, time=time, required=required)


def _as_columns(quantity: str, names: object) -> Columns:
    if not isinstance(names, Columns | str) and not (isinstance(names, Sequence) and not isinstance(names, bytes)):
        raise UserTypeError(
            f"columns: {shown(quantity)} takes the name of a column, a list of them, or Columns; got {shown(names)}."
        )
    columns = names if isinstance(names, Columns) else Columns(names)  # type: ignore[arg-type]
    _check_quantity(quantity, columns)
    return columns


def gather(layout: Layout, streams: Sequence[Stream], name: str) -> dict[str, Signal]:
    """Each quantity of the layout that the streams have, in our units, frames and orders; NaN beyond ``LARGEST``.

    Raises:
        MissingColumns: the streams lack a quantity that every log needs, or a column of a mapping.
        UnreadableLog: the columns of a quantity stand in streams of different clocks.
    """
    owner = {column: stream for stream in reversed(streams) for column in stream.columns}
    found = {}
    for quantity, choices in layout.columns.items():
        choice = next((c for c in choices if all(column in owner for column in c.names)), None)
        if choice is None and quantity in layout.required:
            missing = sorted({column for c in choices for column in c.names} - owner.keys())
            raise MissingColumns(
                f"{name} has no column {', '.join(missing)}, named for {quantity}. {_columns_there(owner)}"
            )
        if choice is None:
            continue
        stream = owner[choice.names[0]]
        if any(owner[column] is not stream for column in choice.names):
            raise UnreadableLog(
                f"{name}: the columns of {quantity}, {', '.join(choice.names)}, stand in different streams, whose "
                "samples have different times. Name columns of one."
            )
        with np.errstate(over="ignore", invalid="ignore"):  # damage makes NaN and numbers of any size
            values = np.stack([np.asarray(stream.columns[column], float) for column in choice.names], -1)
            values = (values - choice.offset) * choice.scale
        values[~(np.abs(values) < LARGEST)] = np.nan
        values = _translate(quantity, values, layout.convention)
        found[quantity] = Signal(quantity, choice.names, stream.time, values)
    if "quaternion" in found:
        found.pop("euler", None)
    if "velocity" in found:
        found.pop("velocity_body", None)
    for quantities in NEEDED:
        if not found.keys() & set(quantities):
            asked = [column for q in quantities for choice in layout.columns.get(q, ()) for column in choice.names]
            raise MissingColumns(
                f"{name} has no {' or '.join(quantities)}: looked for {', '.join(asked) or 'nothing'}. Every log needs "
                f"position, attitude and motor commands. {_columns_there(owner)}"
            )
    return found


def match(header: Sequence[str], name: str) -> Layout:
    """The preset for the columns of a CSV file.

    Raises:
        MissingColumns: none knows them.
    """
    for layout in LAYOUTS.values():
        if {*layout.time.names, *layout.columns["position"][0].names} <= set(header):
            return layout
    raise MissingColumns(f"No preset knows the columns of {name}. {_columns_there(header)}")


def _columns_there(names: Sequence[str] | Mapping[str, Stream]) -> str:
    there = sorted(names)
    more = f" and {len(there) - 40} more" if len(there) > 40 else ""
    return (
        'Name them: columns={"time": "t", "position": ["x", "y", "z"], ...}. '
        f"There are: {', '.join(there[:40]) or 'none'}{more}."
    )


def _translate(quantity: str, values: Array, convention: frames.Convention) -> Array:
    """From the frames and orders of a convention into ours."""
    alike = {
        "acceleration": "angular_velocity",  # a vector of the body
        "velocity_body": "angular_velocity",
        "motor_command": "motors",
        "setpoint.position": "position",
        "setpoint.velocity": "velocity",
        "setpoint.quaternion": "quaternion",
        "setpoint.angular_velocity": "angular_velocity",
    }
    name = alike.get(quantity, quantity)
    if name not in ("position", "velocity", "quaternion", "angular_velocity", "motors"):
        return values
    if name == "motors" and convention.motors is None:
        return values
    return convention.back({name: values})[name]
