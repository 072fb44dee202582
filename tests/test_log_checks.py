"""What follows from other quantities of a log is compared with them: faults of a known flight, and what mends them."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers import refuses
from log_writers import END, TABLE, flight, matrix, ned, own_table, write_csv
from scipy.spatial.transform import Rotation

from torchrl_quad.identification import Columns, LogError, read_log
from torchrl_quad.identification.layouts import choose
from torchrl_quad.identification.motor_checks import check_motors
from torchrl_quad.identification.signals import Signal

T = np.arange(0.0, END, 0.01)
TRUE = flight(T)
ATTITUDE, AVIATION = (Rotation.from_quat(x["quaternion"], scalar_first=True) for x in (TRUE, ned(TRUE)))
EULER = {name: columns for name, columns in TABLE.items() if name != "quaternion"} | {"euler": ("r", "p", "h")}
STILL = {name: TRUE[name] * (0.0, 0.0, 1.0) for name in ("position", "velocity")}
BACKWARD = ATTITUDE * Rotation.from_rotvec((0, 0, np.pi))
NO_GYRO = {name: columns for name, columns in TABLE.items() if name != "angular_velocity"}
NO_SPEED = {name: columns for name, columns in TABLE.items() if name != "velocity"}


def euler(angles):
    return dict(zip("rph", angles.T, strict=True))


def turned(about):
    return (ATTITUDE * Rotation.from_rotvec(about)).as_quat(scalar_first=True)


aviation = {name: ned(TRUE)[name] for name in ("angular_velocity", "acceleration")}
dead_yaw = TRUE["angular_velocity"] * (1.0, 1.0, 0.0)
other_row = TRUE["position"] + (np.arange(len(T)) % 2)[:, None] * (5.0, 2.0, 0.0)
FAULTS = {  # what changes, how it is named, and what the message says
    "tracker turned": (own_table(T, quaternion=turned((0, 0, 0.8))), TABLE,
        "turned by 46 degrees about .0.0, 0.0, 1.0. a"),
    "tracker pitched": (own_table(T, quaternion=turned((0, 0.5, 0))), TABLE, "turned by 29 degrees about .-?0.0, 1.0"),
    "tracker backward": (own_table(T, quaternion=turned((0, 0, np.pi))), NO_GYRO, "back right on, or x .*f x of"),
    "motors a quarter on": (own_table(T, motor_command=TRUE["motor_command"][:, [3, 0, 1, 2]]), NO_GYRO,
        "front right on, or x of .*points left, and must point forward. If motors are"),
    "backward angles": (own_table(T) | euler(BACKWARD.as_euler("ZYX")[:, ::-1]), EULER, "180 degrees .*backward, wr"),
    "aviation": (own_table(T, **aviation) | euler(np.degrees(AVIATION.as_euler("ZYX")[:, ::-1])), EULER,
        "in degrees and .* yaw counts from north"),
    "x first": (own_table(T) | euler(ATTITUDE.as_euler("XYZ")), EULER, "about the body's x, then y, then z. Give quat"),
    "z, x, y": (own_table(T) | euler(ATTITUDE.as_euler("ZXY")[:, [1, 2, 0]]), EULER, "the body's z, then x, then y"),
    "rotation vector": (own_table(T) | euler(ATTITUDE.as_rotvec()), EULER, "if the angles are a rotation vector"),
    "no yaw": (own_table(T) | euler(ATTITUDE.as_euler("ZYX")[:, ::-1] * (1, 1, 0)), EULER,
        "About yaw .* does not turn"),
    "dead axis": (own_table(T, angular_velocity=dead_yaw), TABLE, "About yaw .* does not turn as quaternion"),
    "stands still": (own_table(T, **STILL), TABLE, "leans to and fro by 17 degrees, .* hardly accelerates"),
    "two drones": (own_table(T, position=other_row), TABLE, "jumps to and fro from row to row, by 5.39 m"),
    "feet": (own_table(T, position=TRUE["position"] / 0.3048), NO_SPEED, "in feet, write"),
    "half speed": (own_table(T) | {"t": 2.0 * T}, TABLE, "is 2 times the derivative .* time does not count seconds"),
    "minutes": (own_table(T) | {"t": T / 60.0}, TABLE, "time does not count seconds.*scale=60"),
    "samples": (own_table(T) | {"t": np.arange(len(T))}, TABLE, "counts samples at 100 Hz"),
    "constant motors": (own_table(T, motor_command=np.full((len(T), 4), 0.5)), TABLE,
        "never changes. Name the commands"),
    "a motor twice": (own_table(T), TABLE | {"motor_command": ("u0", "u1", "u2", "u2")},
        "names a column twice: u0, u1"),
}  # fmt: skip

MENDED = ("tracker backward", "motors a quarter on", "backward angles", "aviation", "feet", "half speed", "minutes")
MENDED += ("samples",)


@pytest.mark.parametrize("fault", FAULTS)
def test_what_contradicts_the_rest_of_a_log_is_named_and_what_is_to_be_written_mends_it(fault, tmp_path):
    table, columns, said = FAULTS[fault]
    path = write_csv(tmp_path / "a.csv", table)
    told = re.search(r"rite (columns=.*)\.$", refuses(said, read_log, path, columns, error=LogError))
    assert (told is not None) == (fault in MENDED)
    if told:
        log = read_log(path, **eval(f"dict({told[1]})", {"Columns": Columns}))
        for name in ("position", "velocity", "acceleration"):
            np.testing.assert_allclose(getattr(log, name)[5:-5], flight(log.time)[name][5:-5], atol=5e-3)
        np.testing.assert_allclose(matrix(log.quaternion), matrix(flight(log.time)["quaternion"]), atol=2e-3)


def test_commands_whose_columns_are_named_thrusts_say_what_to_do_if_they_are():
    signal = Signal("motor_command", ("thrust1", "thrust2", "thrust3", "thrust4"), T, TRUE["motor_command"])
    assert "0 to 1. If they are thrusts, put sqrt" in check_motors(signal)[0]
    assert check_motors(replace(signal, columns=("m1", "m2", "m3", "m4"))) == []


def test_rows_that_a_tracker_lost_count_as_missing(tmp_path):
    lost = (T > 5.0) & (T < 5.03)
    for place, attitude in ((-9999.0, TRUE["quaternion"]), (0.0, 0.0)):
        changed = {"position": np.where(lost[:, None], place, TRUE["position"])}
        changed["quaternion"] = np.where(lost[:, None], attitude, TRUE["quaternion"])
        log = read_log(write_csv(tmp_path / "a.csv", own_table(T, **changed)), TABLE)
        np.testing.assert_allclose(log.position, TRUE["position"][: len(log.time)], atol=2e-3)


def test_a_remedy_names_the_columns_that_were_read_and_not_those_that_are_zero(tmp_path):
    layout = choose(TABLE, None)
    batteries = {"battery_voltage": (Columns(("first",)), Columns(("second",)))}
    table = own_table(T) | {"first": 0.0 * T, "second": 16000.0 - 10.0 * T}
    path = write_csv(tmp_path / "a.csv", table)
    said = "second.* is 1.5[0-9]+e.04 in the median.*If it is in millivolts, write "
    said += r"columns=.*\('second',\), scale=0.001"
    refuses(said, read_log, path, replace(layout, columns={**layout.columns, **batteries}), error=LogError)
