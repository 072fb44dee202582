"""Layouts: which columns of a file are which quantity, in which unit and convention."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from torchrl_quad.deploy import frames
from torchrl_quad.identification.errors import MissingColumns
from torchrl_quad.identification.streams import Signal, Stream

SIZES = {
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
DEGREE = np.pi / 180.0
G = 9.80665
OURS = frames.Convention("our frames")


@dataclass(frozen=True)
class Columns:
    """The columns of one quantity, in the order of the layout's convention, and what to multiply them by."""

    names: tuple[str, ...]
    scale: ArrayLike = 1.0


@dataclass(frozen=True)
class Layout:
    """Where a kind of file keeps each quantity.

    ``columns`` maps a quantity, or ``"setpoint.NAME"``, to its :class:`Columns`, best first; the first whose columns
    are all there is read. The convention says the frames, and the order of quaternions and motors.
    """

    about: str
    columns: Mapping[str, tuple[Columns, ...]]
    convention: frames.Convention = OURS
    onboard: tuple[str, ...] = ()
    time: Columns = field(default_factory=lambda: Columns(("time",)))  # of CSV files; others have clocks


def _c(names: str, scale: ArrayLike = 1.0) -> tuple[Columns]:
    return (Columns(tuple(names.split()), scale),)


LAYOUTS = {
    "nanobench": Layout(
        "CSV files of NanoBench: Crazyflie 2.1 in Vicon, with its on-board log",
        {
            "position": _c("px py pz"),
            "quaternion": _c("qx qy qz qw"),
            "velocity": _c("vx vy vz"),
            "angular_velocity": _c("imu_gyro_x imu_gyro_y imu_gyro_z"),
            "acceleration": _c("imu_acc_x imu_acc_y imu_acc_z", G),
            "motor_command": _c("motor_motor_m1 motor_motor_m2 motor_motor_m3 motor_motor_m4", 1 / 65535),
            "battery_voltage": _c("pwr_pm_vbat"),
            "setpoint.position": _c("sp_ctrltarget_x sp_ctrltarget_y sp_ctrltarget_z"),
            "setpoint.yaw": _c("sp_ctrltarget_yaw", DEGREE),
        },
        frames.crazyflie(),
        ("angular_velocity", "acceleration", "motor_command", "battery_voltage", "setpoint"),
        Columns(("t",)),
    ),
}


def gather(layout: Layout, streams: Sequence[Stream], name: str) -> dict[str, Signal]:
    """Each quantity of the layout that the streams have, in our units, frames and orders.

    Raises:
        MissingColumns: the streams lack a quantity that every log needs.
    """
    found: dict[str, Signal] = {}
    by_column = {column: stream for stream in reversed(streams) for column in stream.columns}
    for quantity, choices in layout.columns.items():
        for choice in choices:
            owners = {id(by_column[c]): by_column[c] for c in choice.names if c in by_column}
            if len(owners) == 1 and all(c in by_column for c in choice.names):
                stream = next(iter(owners.values()))
                values = np.stack([np.asarray(stream.columns[c], float) for c in choice.names], -1)
                values = _convert(quantity, values * choice.scale, layout.convention)
                found[quantity] = Signal(quantity, choice.names, stream.time, values)
                break
    for needed in (("position",), ("quaternion", "euler"), ("motor_command",)):
        if not any(quantity in found for quantity in needed):
            asked = [c for q in needed for choice in layout.columns.get(q, ()) for c in choice.names]
            there = sorted(by_column)
            raise MissingColumns(
                f"{name} has no {' or '.join(needed)}: looked for {', '.join(asked) or 'nothing'}. Every log needs "
                "position, attitude and motor commands. Name the columns with columns={...}; there are: "
                f"{', '.join(there[:60])}{' ...' if len(there) > 60 else ''}."
            )
    return found


def _convert(quantity: str, values: np.ndarray, convention: frames.Convention) -> np.ndarray:
    kind = {"acceleration": "angular_velocity", "velocity_body": "angular_velocity", "motor_command": "motors"}
    kind |= {"setpoint.position": "position", "setpoint.velocity": "velocity", "setpoint.quaternion": "quaternion"}
    name = kind.get(quantity, quantity)
    if name == "motors" and convention.motors is None:
        return values
    if name in ("position", "velocity", "quaternion", "angular_velocity", "motors"):
        return convention.back({name: values})[name]
    return values


def own_layout(columns: Mapping[str, Sequence[str] | str], scale: Mapping[str, ArrayLike] | None) -> Layout:
    """The layout that a user's mapping describes."""
    scale = scale or {}
    chosen = {
        quantity: (Columns((names,) if isinstance(names, str) else tuple(names), scale.get(quantity, 1.0)),)
        for quantity, names in columns.items()
    }
    time = chosen.pop("time", (Columns(("time",)),))[0]
    return Layout("a mapping of columns", chosen, time=time)


__all__ = ["LAYOUTS", "SIZES", "Columns", "Layout", "gather", "own_layout", "replace"]
