"""What read_log finds in a real flight, and what it says of every fault that a log may have."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from log_writers import G, write_csv

from torchrl_quad.identification import Columns, LogError, MissingColumns, NoFlight, UnreadableLog, read_log

FLIGHT = Path(__file__).parent.parent / "examples" / "data" / "figure8.csv.gz"
GYRO = ("imu_gyro_x", "imu_gyro_y", "imu_gyro_z")
FORCE = ("imu_acc_x", "imu_acc_y", "imu_acc_z")
PLACE = ("px", "py", "pz")
SPEED = ("vx", "vy", "vz")
TURN = ("qx", "qy", "qz", "qw")
MOTORS = tuple(f"motor_motor_m{k}" for k in (1, 2, 3, 4))


@pytest.fixture(scope="module")
def table():
    """The first nine seconds of the flight, by column; copies of it get faults."""
    with gzip.open(FLIGHT, "rt") as file:
        names = file.readline().strip().split(",")
        rows = np.loadtxt(file, delimiter=",", max_rows=900)
    return dict(zip(names, rows.T, strict=True))


@pytest.fixture
def read(table, tmp_path):
    """Reads the flight with some columns changed."""

    def change(changes=None, drop=(), rows=slice(None), **options):
        columns = {**table, **(changes or {})}
        kept = {name: x[rows] for name, x in columns.items() if name not in drop}
        return read_log(write_csv(tmp_path / "flight.csv", kept), **options)

    return change


def scaled(table, names, factor):
    return {name: factor * table[name] for name in names}


def test_a_real_flight_is_read_in_our_units_frames_and_orders(table):
    log = read_log(FLIGHT)
    assert log.name == "figure8"
    assert log.dt == pytest.approx(0.01)
    np.testing.assert_allclose(np.diff(log.time), 0.01, rtol=0, atol=1e-9)
    assert all(x.dtype == np.float64 for x in (log.position, log.quaternion, log.motor_command))
    k = 700
    row = np.searchsorted(table["t"], log.time[k] + table["t"][0])
    assert abs(table["t"][row] - log.time[k]) < 2e-3
    expected = [table[name][row] / 65535 for name in ("m4", "m3", "m2", "m1") for name in [f"motor_motor_{name}"]]
    np.testing.assert_allclose(log.motor_command[k], expected, atol=0.02)
    np.testing.assert_allclose(log.position[k], [table[n][row] for n in PLACE], atol=2e-3)
    np.testing.assert_allclose(log.quaternion[k], [table[n][row] for n in ("qw", "qx", "qy", "qz")], atol=5e-3)
    assert log.acceleration[log.segments[0][0] : log.segments[0][1], 2].mean() == pytest.approx(G, rel=0.03)
    np.testing.assert_allclose(np.linalg.norm(log.quaternion, axis=-1), 1.0)
    assert ((log.quaternion[1:] * log.quaternion[:-1]).sum(-1) > 0.9).all()
    assert 2.9 < log.battery_voltage.min() < log.battery_voltage.max() < 4.3
    assert np.abs(log.setpoint["yaw"]).max() < np.pi
    assert log.setpoint["position"].shape == log.position.shape
    assert log.onboard == ("angular_velocity", "acceleration", "motor_command", "battery_voltage", "setpoint")


def test_the_ground_take_off_and_landing_are_cut_out_and_said(table):
    log = read_log(FLIGHT)
    ((start, stop),) = log.segments
    ground = np.median(table["pz"][:50])
    assert log.position[start:stop, 2].min() > ground + 0.0995
    assert log.position[start - 1, 2] < ground + 0.1005 and log.position[stop, 2] < ground + 0.1005
    assert (start * log.dt, stop * log.dt) == (pytest.approx(2.16, abs=0.02), pytest.approx(21.68, abs=0.02))
    notes = str(log)
    assert "take-off: cut out up to 2.16 s" in notes and "landing: cut out from 21.68 s" in notes
    higher = read_log(FLIGHT, clearance=0.3).segments[0]
    assert higher[0] > start and higher[1] < stop


FAULTS = {  # a fault: what changes, the error, and what its message must name
    "gyro in degrees": (lambda t: scaled(t, GYRO, 180 / np.pi), "WrongUnit", "imu_gyro_x.*degrees.*np.pi / 180"),
    "gyro in milliradians": (lambda t: scaled(t, GYRO, 1e3), "WrongUnit", "imu_gyro_x.*milliradians"),
    "gyro three times too fast": (lambda t: scaled(t, GYRO, 6.0), "WrongUnit", "times the derivative"),
    "gyro of a body with z down": (lambda t: scaled(t, GYRO[1:], -1), "WrongFrame", "y right and z down"),
    "gyro of another flight": (lambda t: {n: t[n][::-1] for n in GYRO}, "WrongFrame", "does not follow"),
    "world to body": (lambda t: scaled(t, TURN[:3], -1), "WrongQuaternion", "if the quaternion is from world to body"),
    "scalar first": (
        lambda t: dict(zip(TURN, [t[n] for n in ("qw", *TURN)], strict=False)),
        "WrongQuaternion",
        "first",
    ),
    "not of length 1": (lambda t: scaled(t, TURN, 0.5), "WrongQuaternion", "length 1.*0.5"),
    "millimetres": (lambda t: scaled(t, PLACE + SPEED, 1e3), "WrongUnit", "px, py, pz.*millimetres.*scale=1e-3"),
    "mixed lengths": (lambda t: scaled(t, SPEED, 1e3), "WrongUnit", "vx, vy, vz.*1e\\+03 times"),
    "z down": (lambda t: scaled(t, ("pz", "vz"), -1), "WrongFrame", "z points down.*frames.px4"),
    "accelerometer down": (lambda t: scaled(t, FORCE[2:], -1), "WrongFrame", "imu_acc_z.*frames.px4"),
    "accelerometer in m/s^2": (lambda t: scaled(t, FORCE, G), "WrongUnit", "imu_acc_x.*median length of 9"),
    "motors beyond full": (lambda t: scaled(t, MOTORS, 2.0), "WrongUnit", "motor_motor_m1.*from 0 to 1"),
    "clock in ms": (lambda t: scaled(t, "t", 1e3), "WrongUnit", "milliseconds"),
    "clock jumps back": (lambda t: {"t": t["t"] - (t["t"] > 5.0)}, "ClockJumpsBack", "from 5 to 4.0.* at sample"),
    "no numbers": (lambda t: scaled(t, PLACE[:1], np.nan), "NotFiniteLog", "0 of 900 samples of position"),
    "motors off": (lambda t: scaled(t, MOTORS, 0.0), "NoFlight", "motor command is below"),
    "never in the air": (lambda t: {"pz": 0 * t["pz"], "vz": 0 * t["vz"]}, "NoFlight", "rises 0.000 m at most"),
    "gaps all over": (
        lambda t: {"px": np.where(t["t"] % 0.4 < 0.2, t["px"], np.nan)},
        "GapsTooLarge",
        "larger max_gap",
    ),
}


def test_a_tracker_that_jumps_is_cut_out(table, read):
    t = table["t"]
    swapped = (t > 5.0) & (t < 5.04)  # its markers are taken for one another
    reset = t > 7.0  # its origin moves
    log = read({"qx": np.where(swapped, 0.7, table["qx"]), "qw": np.where(swapped, 0.714, table["qw"]),
                "py": table["py"] + 0.5 * reset})  # fmt: skip
    assert "a jump of the quaternion, of" in str(log) and "a jump of the position, of" in str(log)
    edges = [round(k * log.dt, 1) for piece in log.segments for k in piece]
    assert edges[1:-1] == pytest.approx([4.9, 5.1, 6.9, 7.1], abs=0.11)


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_has_its_name_and_its_remedy(fault, table, read):
    change, error, message = FAULTS[fault]
    with pytest.raises(LogError, match=message) as caught:
        read(change(table))
    assert type(caught.value).__name__ == error and isinstance(caught.value, ValueError)
    if fault == "gyro in degrees":  # what the message says to write
        told = eval(str(caught.value).split("columns=")[1][:-1], {"Columns": Columns, "np": np})
        mended = read(change(table), columns=told)
        np.testing.assert_allclose(mended.angular_velocity, read().angular_velocity, atol=1e-6)


def test_without_a_gyro_the_lean_of_the_drone_tells_a_wrong_quaternion(table, read):
    log = read(drop=GYRO)
    assert "no gyro: angular_velocity was derived from the attitude" in log.notes
    assert "angular_velocity" not in log.onboard
    measured = read().angular_velocity
    assert np.corrcoef(log.angular_velocity[300:800, 1], measured[300:800, 1])[0, 1] > 0.7
    for fault in ("world to body", "scalar first"):
        with pytest.raises(LogError, match="leans where the drone accelerates") as caught:
            read(FAULTS[fault][0](table), drop=GYRO)
        assert type(caught.value).__name__ == "WrongQuaternion"


def test_gaps_a_lost_tracker_and_a_frozen_one_separate_pieces(table, read):
    t = table["t"]
    whole = read().segments
    assert len(whole) == 1
    lost = (t > 4.0) & (t < 4.5)
    held = np.searchsorted(t, 4.0)
    changes = {
        "rows are missing": ({}, ~lost),
        "not a number": ({name: np.where(lost, np.nan, table[name]) for name in PLACE}, slice(None)),
        "zero quaternions": ({name: np.where(lost & (t < 4.1), 0.0, table[name]) for name in TURN}, slice(None)),
        "frozen": ({n: np.where(lost, table[n][held], table[n]) for n in PLACE + TURN}, slice(None)),
    }
    for fault, (change, rows) in changes.items():
        log = read(change, rows=rows)
        assert len(log.segments) == 2, fault
        (a, b), (c, d) = log.segments
        assert (a, d) == whole[0]
        assert b * log.dt == pytest.approx(4.0, abs=0.02)
        assert c * log.dt == pytest.approx(4.1 if "qw" in change and "px" not in change else 4.5, abs=0.02)
        assert "gap(s)" in str(log)
    bridged = read(rows=~(lost & (t < 4.03)))  # three samples: interpolated
    assert bridged.segments == whole


def test_repeated_times_a_missing_battery_and_an_impact_are_told(table, read):
    t = table["t"].copy()
    t[500] = t[499]
    force = table["imu_acc_x"].copy()
    force[600:603] += 8.0
    log = read({"t": t, "pwr_pm_vbat": 0.0 * t, "imu_acc_x": force})
    assert log.battery_voltage is None and "no battery voltage" in str(log)
    assert "repeat the time" in str(log)
    hit = table["t"][600] - table["t"][0]
    (_, b), (c, _) = log.segments
    assert "an impact, of 78 m/s^2, at" in str(log)
    assert b * log.dt == pytest.approx(hit - 0.1, abs=0.03) and c * log.dt == pytest.approx(hit + 0.3, abs=0.05)


def test_a_mapping_replaces_entries_of_a_preset_and_nothing_else(table, read):
    renamed = {"volts": table["pwr_pm_vbat"]}
    log = read(renamed, drop=("pwr_pm_vbat", "sp_ctrltarget_yaw"), columns={"battery_voltage": "volts"})
    np.testing.assert_array_equal(log.battery_voltage, read().battery_voltage)
    assert set(log.setpoint) == {"position"}  # what the preset knows and the file lacks is left out, as ever
    with pytest.raises(MissingColumns, match="no column vlots, named for battery_voltage.*There are: .*volts"):
        read(renamed, columns={"battery_voltage": "vlots"})
    with pytest.raises(MissingColumns, match="no column seconds of the time. There are: t, "):
        read(columns={"time": "seconds"})


def test_the_delay_of_the_on_board_clock_is_seen_and_left_to_the_fit(table, read):
    lag = 8  # samples
    late = {name: np.roll(table[name], lag) for name in (*GYRO, *FORCE, *MOTORS)}
    plain, shifted = read(), read(late)
    told = [float(str(log).split("correlation")[1].split("ms late")[0].split()[1]) for log in (plain, shifted)]
    assert told[1] - told[0] == pytest.approx(80.0, abs=8.0)
    np.testing.assert_allclose(shifted.angular_velocity[lag:-lag], plain.angular_velocity[: -2 * lag], atol=1e-9)


def test_what_holds_no_flight_is_refused_by_name(tmp_path, read):
    for path, message in (
        (tmp_path / "nowhere.csv", "does not exist"),
        (tmp_path, "Expected metadata file"),
    ):
        with pytest.raises(UnreadableLog, match=message):
            read_log(path)
    with pytest.raises(MissingColumns, match="Unknown layout 'betaflight'. Choose from: nanobench"):
        read_log(FLIGHT, "betaflight")
    with pytest.raises(NoFlight, match="share 0.14 s"):
        read(rows=slice(0, 15))
    with pytest.raises(NoFlight, match="never for 60 s"):
        read(min_duration=60.0)
