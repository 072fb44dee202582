"""Tables of a flight whose every quantity is known, with columns, rates, units and frames of all kinds."""

from dataclasses import replace

import numpy as np
import pytest
from log_writers import END, G, flight, matrix, ned, write_csv

from torchrl_quad.deploy import frames
from torchrl_quad.errors import UserError, UserValueError
from torchrl_quad.identification import (
    LAYOUTS,
    Columns,
    MissingColumns,
    UnreadableLog,
    WrongFrame,
    WrongQuaternion,
    WrongUnit,
    read_log,
)

OURS = {
    "position": ("x", "y", "z"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "angular_velocity": ("wx", "wy", "wz"),
    "acceleration": ("fx", "fy", "fz"),
    "motor_command": ("u0", "u1", "u2", "u3"),
}


def own_table(t, **changes):
    true = flight(t) | changes
    columns = {"t": t}
    for quantity, names in OURS.items():
        columns |= dict(zip(names, true[quantity].T, strict=True))
    return columns | {"v": true["battery_voltage"]}


def test_a_mapping_reads_any_table_and_rates_are_matched(tmp_path):
    t = np.arange(0.0, END, 0.004)  # 250 Hz, with a battery that is measured each 0.2 s
    columns = own_table(t, battery_voltage=np.where(np.arange(len(t)) % 50, np.nan, flight(t)["battery_voltage"]))
    mapping = {"time": "t", "battery_voltage": "v", **OURS}
    path = write_csv(tmp_path / "own.csv", columns)
    log = read_log(path, mapping, dt=0.01)
    start, stop = log.segments[0]
    inside = np.arange(start, stop)
    # Where the climb ends and the descent begins, the angular acceleration jumps: a mean over a step differs there.
    inside = inside[(np.abs(log.time[inside] - 3.0) > 0.015) & (np.abs(log.time[inside] - 7.0) > 0.015)]
    true = flight(log.time)
    for name, tolerance in {"position": 1e-4, "velocity": 1e-3, "angular_velocity": 2e-3, "acceleration": 2e-3}.items():
        np.testing.assert_allclose(getattr(log, name)[inside], true[name][inside], atol=tolerance)
    np.testing.assert_allclose(log.motor_command[inside], true["motor_command"][inside], atol=1e-3)
    np.testing.assert_allclose(np.abs((log.quaternion * true["quaternion"]).sum(-1)), 1.0, atol=1e-6)
    np.testing.assert_allclose(log.battery_voltage[inside], true["battery_voltage"][inside], atol=1e-3)
    assert log.onboard == ("angular_velocity", "acceleration", "motor_command", "battery_voltage")

    xyzw = replace(LAYOUTS["nanobench"].convention, motors=(0, 1, 2, 3))
    listed = {**mapping, "quaternion": ("qx", "qy", "qz", "qw")}
    np.testing.assert_allclose(read_log(path, listed, convention=xyzw, dt=0.01).quaternion, log.quaternion)
    twice = tmp_path / "twice.csv"
    twice.write_text(path.read_text().replace("wz,", "wy,", 1))
    without = {k: v for k, v in mapping.items() if k != "motor_command"}
    twin = mapping | {"angular_velocity": ("wx", "wy", "wx")}
    nowhere = "no column nowhere, named for velocity.*There are: .*x, y"
    for error, message, file, columns in (
        (WrongQuaternion, "scalar last", path, listed),
        (MissingColumns, "takes 4 column", path, mapping | {"motor_command": ("u0", "u1", "u2")}),
        (MissingColumns, "Unknown quantity 'speed'", path, mapping | {"speed": ("vx", "vy", "vz")}),
        (MissingColumns, nowhere, path, mapping | {"velocity": ("vx", "vy", "nowhere")}),
        (MissingColumns, "No preset knows", path, {"angular_velocity": OURS["angular_velocity"]}),
        (MissingColumns, "No preset knows.*columns=", path, None),
        (MissingColumns, "has no motor_command", path, without),
        (UnreadableLog, "twice.csv has several columns of one name: wy. Rename them", twice, twin),
    ):
        with pytest.raises(error, match=message):
            read_log(file, columns)


def test_what_is_faster_than_the_log_does_not_alias(tmp_path):
    t = np.arange(0.0, END, 0.002)
    buzz = 2.0 * (-1.0) ** np.arange(len(t))[:, None]  # each fifth sample alone would see it as a bias
    path = write_csv(tmp_path / "fast.csv", own_table(t, angular_velocity=flight(t)["angular_velocity"] + buzz))
    log = read_log(path, {"time": "t", **OURS}, dt=0.01)
    assert np.abs((log.angular_velocity - flight(log.time)["angular_velocity"])[1:-1].mean(0)).max() < 0.01


def test_touching_down_and_landing_on_a_table_are_cut_out(tmp_path):
    t = np.arange(0.0, 12.0, 0.01)
    knots = {0: 0, 1: 0, 2: 1, 4: 1, 5: 0.03, 5.5: 0.03, 6.5: 1, 8: 1, 9: 0.6, 12: 0.6}  # it lands 0.6 m higher
    true = flight(0.0 * t + 0.01)
    true["position"][:, 2] = 0.05 + np.interp(t, list(knots), list(knots.values()))
    noise = np.random.default_rng(0).normal(scale=1e-4, size=(2, len(t)))  # a tracker that says the same is frozen
    true["position"][:, 0], true["quaternion"][:, 1] = noise
    true["velocity"][:, 2] = np.gradient(true["position"][:, 2], t)
    true["motor_command"] = np.full((len(t), 4), 0.5) * ((t > 0.8) & (t < 10.0))[:, None]
    log = read_log(write_csv(tmp_path / "touch.csv", own_table(t, **true)), {"time": "t", **OURS})
    expected = ((1.1, 4 + 0.9 / 0.97), (5.5 + 0.07 / 0.97, 8.75))  # 0.1 m above the ground, and above the table
    np.testing.assert_allclose(np.array(log.segments) * log.dt, expected, atol=0.02)
    assert "between take-off and landing are within 0.1 m of the ground" in str(log)


def test_euler_angles_and_velocities_of_the_body_become_ours(tmp_path):
    t = np.arange(0.0, END, 0.01)
    true = flight(t)
    r = matrix(true["quaternion"])
    columns = own_table(t, velocity=np.einsum("nji,nj->ni", r, true["velocity"]))
    columns["roll"], columns["pitch"] = np.arctan2(r[:, 2, 1], r[:, 2, 2]), -np.arcsin(r[:, 2, 0])
    columns["yaw"] = np.degrees(np.arctan2(r[:, 1, 0], r[:, 0, 0]))
    path = write_csv(tmp_path / "own.csv", columns)
    mapping = {"time": "t", **OURS}
    euler = Columns(("roll", "pitch", "yaw"), scale=(1.0, 1.0, np.pi / 180))
    turned = {k: v for k, v in mapping.items() if k not in ("velocity", "quaternion")}
    log = read_log(path, {**turned, "velocity_body": OURS["velocity"], "euler": euler})
    np.testing.assert_allclose(log.velocity, true["velocity"], atol=1e-6)
    np.testing.assert_allclose(np.abs((log.quaternion * true["quaternion"]).sum(-1)), 1.0, atol=1e-7)
    with pytest.raises(WrongFrame, match='"velocity_body"'):
        read_log(path, mapping)
    force, motors = true["acceleration"], true["motor_command"]
    for error, message, changes in (
        (WrongFrame, "in the world frame", {"angular_velocity": np.einsum("nij,nj->ni", r, true["angular_velocity"])}),
        (WrongUnit, "in g.*scale=9.80665", {"acceleration": force / G}),
        (WrongUnit, "scale=9.80665e-3", {"acceleration": 1e3 * force / G}),
        (WrongUnit, "scale=1 / 65535", {"motor_command": 65535.0 * motors}),
        (WrongUnit, "scale=1 / 100", {"motor_command": 100.0 * motors}),
        (WrongUnit, "offset=1000", {"motor_command": 2000.0 * motors}),
    ):
        with pytest.raises(error, match=message):
            read_log(write_csv(path, own_table(t, **changes)), mapping)
    log = read_log(path, {k: v for k, v in mapping.items() if k in ("time", "position", "quaternion")} | {
        "motor_command": Columns(OURS["motor_command"], scale=1 / 2000)}, convention=None)  # fmt: skip
    inside = slice(*log.segments[0])
    np.testing.assert_allclose(log.velocity[inside], true["velocity"][inside], atol=0.02)
    assert log.acceleration is None and log.setpoint is None


def test_a_log_in_ned_is_read_by_its_convention(tmp_path):
    t = np.arange(0.0, END, 0.01)
    path = write_csv(tmp_path / "ned.csv", own_table(t, **ned(flight(t))))
    mapping = {"time": "t", **OURS}
    with pytest.raises(WrongFrame, match=r"frames.px4\(\)"):
        read_log(path, mapping)
    log = read_log(path, mapping, convention=replace(frames.px4(), motors=(0, 1, 2, 3)))
    np.testing.assert_allclose(log.position, flight(t)["position"], atol=1e-6)
    np.testing.assert_allclose(log.angular_velocity, flight(t)["angular_velocity"], atol=1e-6)


HUGE = 10**400  # more than a float holds
BAD_ARGUMENTS = [
    *((name, value) for name in ("dt", "clearance", "max_gap", "min_duration") for value in (
        np.nan, np.inf, -1, True, "a", HUGE, [1.0], np.array([1.0, 2.0]),
    )),
    *(("dt", value) for value in (0, 1e-9, 0.5)),
    *(("columns", value) for value in (
        5, True, b"px4", ["x"], {1: "x"}, {"time": 5}, {"position": [1, 2, 3]}, {"velocity": None}, {"euler": {"a": 1}},
    )),
    *(("convention", value) for value in ("px4", 5, {})),
    *(("onboard", value) for value in ("setpoint", 5, ["speed"], [None], {"position": 1})),
    *(("path", value) for value in (None, 5, b"a.csv", ["a.csv"], "", "a\0b", "a" * 5000, "two\nlines.csv")),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD_ARGUMENTS, ids=lambda x: x if isinstance(x, str) and len(x) < 9 else "")
def test_arguments_that_make_no_log_are_refused_by_name(name, value, tmp_path):
    path = write_csv(tmp_path / "own.csv", own_table(np.arange(0.0, END, 0.01)))
    arguments = {"path": path, "columns": {"time": "t", **OURS}} | {name: value}
    with pytest.raises((UserError, OSError)) as refused:
        read_log(**arguments)
    assert name in str(refused.value) or name in ("columns", "path")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("value", [0, True, "2", None, np.nan, np.inf, HUGE, (1, 2), [], 1j, [[1.0, 1.0, 1.0]]])
def test_columns_take_a_scale_and_an_offset_that_are_numbers(value):
    with pytest.raises(UserValueError, match="Columns: scale of a, b, c must be a number, or one for each column"):
        Columns(("a", "b", "c"), scale=value)
    if value != 0:
        with pytest.raises(UserValueError, match="Columns: offset of a, b, c must be"):
            Columns(("a", "b", "c"), offset=value)


def test_layouts_say_which_of_their_fields_is_wrong():
    for changes, message in (
        ({"columns": {"position": ("x", "y", "z")}}, "position takes 3 column.* got 1: x"),
        ({"columns": {"position": (5,)}}, "columns: 'position' takes the name of a column"),
        ({"columns": {"speed": (("v",),)}}, "Unknown quantity 'speed'"),
        ({"convention": "px4"}, "convention must be one of torchrl_quad.deploy.frames, got 'px4'"),
        ({"time": Columns(("s", "ns"))}, "time takes 1 column.* got 2: s, ns"),
    ):
        with pytest.raises(UserError, match=message):
            replace(LAYOUTS["nanobench"], **changes)
    with pytest.raises(UserValueError, match="names must be the names of columns, got 5"):
        Columns(5)
