"""What read_log finds in a real flight and in tables of a known one, and what it says of every fault of a log."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import cases, refuses
from log_writers import END, OURS, TABLE, G, flight, own_table, write_csv

from torchrl_quad.errors import UserError
from torchrl_quad.identification import LAYOUTS, Columns, LogError, MissingColumns, NoFlight, read_log
from torchrl_quad.identification.errors import UnreadableLog, WrongQuaternion
from torchrl_quad.rotations import rotate_inverse

FLIGHT = Path(__file__).parent.parent / "examples" / "data" / "figure8.csv.gz"
GYRO, FORCE = (tuple(f"imu_{name}_{axis}" for axis in "xyz") for name in ("gyro", "acc"))
PLACE, SPEED, TURN = ("px", "py", "pz"), ("vx", "vy", "vz"), ("qx", "qy", "qz", "qw")
H = 0.5**0.5
MOTORS = tuple(f"motor_motor_m{k}" for k in (1, 2, 3, 4))


@pytest.fixture(scope="module")
def table():
    """The first nine seconds of the flight, by column; copies of it get faults."""
    rows = np.genfromtxt(FLIGHT, delimiter=",", names=True, max_rows=900)
    return {name: rows[name] for name in rows.dtype.names}


@pytest.fixture(scope="module")
def plain(table, tmp_path_factory):
    """The flight as it is."""
    return read_log(write_csv(tmp_path_factory.mktemp("plain") / "flight.csv", table))


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
    assert log.name == "figure8" and log.dt == pytest.approx(0.01)
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
    assert np.abs(log.setpoint["yaw"]).max() < np.pi and log.setpoint["position"].shape == log.position.shape
    assert log.onboard == ("angular_velocity", "acceleration", "motor_command", "battery_voltage", "setpoint")

    # The ground, take-off and landing are cut out, and said.
    ((start, stop),) = log.segments
    ground = np.median(table["pz"][:50])
    assert log.position[start:stop, 2].min() > ground + 0.0995
    assert log.position[start - 1, 2] < ground + 0.1005 and log.position[stop, 2] < ground + 0.1005
    assert (start * log.dt, stop * log.dt) == (pytest.approx(2.16, abs=0.02), pytest.approx(21.68, abs=0.02))
    notes = str(log)
    assert "take-off: cut out up to 2.16 s" in notes and "landing: cut out from 21.68 s" in notes
    higher = read_log(FLIGHT, clearance=0.3).segments[0]
    assert higher[0] > start and higher[1] < stop


def turned(table, x, y):
    """Position and velocity in another world than the attitude."""
    pairs = [(a, (f"{a}x", f"{a}y")) for a in "pv"]
    rows = {"x": np.array(x), "y": np.array(y)}
    return {f"{a}{n}": row @ [table[k] for k in names] for a, names in pairs for n, row in rows.items()}


def y_up(t):
    """Position, velocity and attitude in a world whose y axis points up."""
    x, y, z, w = (H * t[n] for n in TURN)
    moved = {"py": t["pz"], "pz": -t["py"], "vy": t["vz"], "vz": -t["vy"]}
    return moved | {"qx": x - w, "qy": y + z, "qz": z - y, "qw": w + x}


def in_body(t):
    q, v = (np.stack([t[n] for n in names], -1) for names in (("qw", *TURN[:3]), SPEED))
    return dict(zip(SPEED, rotate_inverse(q, v).T, strict=True))


FAULTS = {  # a fault: what changes, the error, and what its message must name
    "gyro in degrees": (lambda t: scaled(t, GYRO, 180 / np.pi), "WrongUnit", "imu_gyro_x.*degrees/s. Write .*0.0174"),
    "gyro in milliradians": (lambda t: scaled(t, GYRO, 1e3), "WrongUnit", "imu_gyro_x.*milliradians"),
    "gyro three times too fast": (lambda t: scaled(t, GYRO, 6.0), "WrongUnit", "times the derivative"),
    "gyro of a body with z down": (lambda t: scaled(t, GYRO[1:], -1), "WrongFrame", "y right and z down"),
    "gyro of another flight": (lambda t: {n: t[n][::-1] for n in GYRO}, "WrongFrame", "does not follow"),
    "world to body": (lambda t: scaled(t, TURN[:3], -1), "WrongQuaternion", "if the quaternion is from world to body"),
    "scalar first": (lambda t: {n: t[k] for n, k in zip(TURN, ("qw", *TURN))}, "WrongQuaternion", "first"),  # noqa: B905
    "not of length 1": (lambda t: scaled(t, TURN, 0.5), "WrongQuaternion", "length 1.*0.5"),
    "millimetres": (lambda t: scaled(t, PLACE + SPEED, 1e3), "WrongUnit", "px.*millimetres.*0.001.*vx.*0.001"),
    "mixed lengths": (lambda t: scaled(t, SPEED, 1e3), "WrongUnit", "vx, vy, vz.*1e\\+03 times"),
    "z down": (lambda t: scaled(t, ("pz", "vz"), -1), "WrongFrame", "z points down. If only z.*scale=.1.0, 1.0, -1"),
    "body with z down": (
        lambda t: {"qx": t["qw"], "qy": t["qz"], "qz": -t["qy"], "qw": -t["qx"]} | scaled(t, GYRO[1:] + FORCE[1:], -1),
        "WrongFrame", "does not thrust along its z axis.*y right and z down"),
    "y up": (y_up, "WrongFrame", "does not thrust along its z axis: the cosine between them is -?0.0"),
    "velocity of the body": (in_body, "WrongFrame", "body frame .correlation 1.000. and not in the world"),
    "velocity without z": (lambda t: {"vz": 0.0 * t["vz"]}, "WrongFrame", "vz. does not follow .* 0.00 along x, y, z"),
    "accelerometer down": (lambda t: scaled(t, FORCE[2:], -1), "WrongFrame", "other direction.*scale="),
    "accelerometer in m/s^2": (lambda t: scaled(t, FORCE, G), "WrongUnit", "mean length of 97.*in m/s.2, write"),
    "accelerometer in g": (lambda t: scaled(t, FORCE, 1 / G), "WrongUnit", "in g, write"),
    "accelerometer in mg": (lambda t: scaled(t, FORCE, 1e3 / G), "WrongUnit", "in thousandths of g, write"),
    "motors in percent": (lambda t: scaled(t, MOTORS, 100.0), "WrongUnit", "f they are thrusts.*percents, write"),
    "motors in DShot": (lambda t: {n: 2000.0 * np.maximum(t[n], 30.0) for n in MOTORS}, "WrongUnit",
        "DShot commands up to 2000, write"),
    "motors in counts": (lambda t: scaled(t, MOTORS, 65535.0), "WrongUnit", "counts of 16 bits, write"),
    "motors beyond full": (lambda t: scaled(t, MOTORS, 2.0), "WrongUnit", "full command. It is like neither"),
    "motors are thrusts": (lambda t: scaled(t, MOTORS, 2.75), "WrongUnit", "put sqrt.thrust / full thrust. in"),
    "thrusts below one": (lambda t: scaled(t, MOTORS, 0.08), "WrongUnit", "flies with so little.*put sqrt.thrust /"),
    "motors turn to and fro": (lambda t: {n: 65535 * 700 * np.sin(9 * t["t"] + t[n]) for n in MOTORS}, "WrongUnit",
        "like neither"),
    "motors are speeds": (lambda t: {n: 65535 * 3e-2 * (-1) ** k * t[n] for k, n in enumerate(MOTORS)}, "WrongUnit",
        "in rad/s, wr"),
    "one motor stands": (lambda t: scaled(t, MOTORS[2:3], 0.0), "WrongMotors",
        "not change for the motor back left. Name"),
    "motors in another order": (lambda t: dict(zip(MOTORS, (t[MOTORS[k]] for k in (3, 1, 2, 0)), strict=True)),
        "WrongMotors", "another"),
    "accelerometer without gravity": (
        lambda t: {n: np.gradient(t[v], t["t"]) / G for n, v in zip(FORCE, SPEED, strict=True)}, "WrongUnit",
        'lacks gravity.*Write columns={"acceleration": None}.$'),
    "two faults at once": (lambda t: scaled(t, GYRO, 180 / np.pi) | scaled(t, FORCE, 1 / G), "WrongUnit",
        "imu_gyro_x.*imu_acc_x"),
    "roll rate mirrored": (lambda t: scaled(t, GYRO[:1], -1), "WrongFrame", "with roll the other way. Write .*-1.0, 1"),
    "pitch rate mirrored": (lambda t: scaled(t, GYRO[1:2], -1), "WrongFrame", "with pitch the other way. Write "),
    "centimetres": (lambda t: scaled(t, PLACE + SPEED, 1e2), "WrongUnit", "px.*centimetres.*0.01.*vx.*0.01"),
    "feet": (lambda t: scaled(t, PLACE + SPEED, 1 / 0.3048), "WrongUnit", "leans less than .*in feet.*0.3048"),
    "knots": (lambda t: scaled(t, SPEED, 1 / 0.5144), "WrongUnit", "1.9.* times .*in knots, write .*0.5144"),
    "km/h": (lambda t: scaled(t, SPEED, 3.6), "WrongUnit", "3.* times .*in km/h, write .*0.277"),
    "millivolts": (lambda t: {"pwr_pm_vbat": 1e3 * t["pwr_pm_vbat"]}, "WrongUnit", "in the median.*millivolts, write"),
    "centivolts": (lambda t: {"pwr_pm_vbat": 1e2 * t["pwr_pm_vbat"]}, "WrongUnit", "in centivolts, write"),
    "motors in pulses": (lambda t: {n: np.where(t["t"] < 0.5, 0.0, 1000.0 + t[n] / 65.535) * 65535.0 for n in MOTORS},
        "WrongUnit", "runs from 0 .*pulses from 1000 to 2000 us, write"),
    "world turned": (lambda t: turned(t, (0.0, -1.0), (1.0, 0.0)), "WrongFrame", "turned by 8. degrees about z. Bring"),
    "world mirrored": (lambda t: turned(t, (1.0, 0.0), (0.0, -1.0)), "WrongFrame",
        "of position and .* is mirrored in y"),
    "attitude of another time": (lambda t: {n: np.roll(t[n], 150) for n in TURN + GYRO}, "WrongFrame",
        "leans another way .*up to 0.3 s late. Name"),
    "clock in ms": (lambda t: scaled(t, ["t"], 1e3), "WrongUnit", "milliseconds, write"),
    "clock in ns": (lambda t: {"t": 1e9 * t["t"]}, "WrongUnit", "nanoseconds, write"),
    "clock jumps back": (lambda t: {"t": t["t"] - (t["t"] > 5.0)}, "ClockJumpsBack", "from 5 to 4.0.* at sample"),
    "no order in time": (lambda t: {"t": t["t"][::-1]}, "ClockJumpsBack", "899 time.*. Sort its rows by time"),
    "no numbers": (lambda t: scaled(t, PLACE[:1], np.nan), "NotFiniteLog", "0 of 900 samples of position"),
    "motors off": (lambda t: scaled(t, MOTORS, 0.0), "NoFlight", "motor command is below"),
    "never in the air": (lambda t: {"pz": 0 * t["pz"], "vz": 0 * t["vz"]}, "NoFlight", "rises 0.000 m at most"),
    "gaps": (lambda t: {"px": np.where(t["t"] % 0.4 < 0.2, t["px"], np.nan)}, "GapsTooLarge", "Write max_gap=0.25.$"),
}  # fmt: skip


HOPELESS = {"motors beyond full", "motors are thrusts", "thrusts below one", "motors turn to and fro", "no numbers"}
HOPELESS |= {"one motor stands", "clock jumps back", "no order in time", "y up", "motors off", "never in the air"}
HOPELESS |= {"world turned", "world mirrored", "attitude of another time"}


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
def test_each_fault_has_its_name_and_its_remedy(fault, table, plain, read):
    change, error, message = FAULTS[fault]
    with pytest.raises(LogError, match=message) as caught:
        read(change(table))
    assert type(caught.value).__name__ == error and isinstance(caught.value, ValueError)
    told = re.search(r"rite (.*)\.$", str(caught.value))
    if told:  # what the message says to write
        mended = read(change(table), **eval(f"dict({told[1]})", {"Columns": Columns, "np": np}))
        motors = [] if "rotor_speed" in told[1] else ["motor_command"]
        if "scale" in told[1]:
            for name in ("angular_velocity", "acceleration", "position", "velocity", *motors):
                np.testing.assert_allclose(getattr(mended, name), getattr(plain, name), atol=1e-3, err_msg=name)
    assert bool(told) == (fault not in HOPELESS)


@cases(
    (lambda head, rows: [head, *(",".join(f'"{x}"' for x in row.split(",")) for row in rows)], None),
    (lambda head, rows: [head, *rows[:-1], rows[-1][:40]], "is cut off: left out"),
    (lambda head, rows: ["sep=;", *(x.replace(",", ";") for x in (head, *rows))], None),
    (lambda head, rows: [x.replace(",", "|") for x in (head, *rows)], None),
    (lambda head, rows: ["# " + head, *rows], None),
    (lambda head, rows: ["# exported, today", "#", *(x.replace(",", ";") for x in ("# " + head, *rows))], None),
    (lambda head, rows: [x.replace(",", "\t") for x in ("#" + head, *rows)], None),
    (lambda head, rows: ["% " + head.replace(",", " "), *(x.replace(",", "  ") for x in rows)], None),  # numpy.savetxt
    (lambda head, rows: [head.replace(",", ";"), *(x.replace(",", ";").replace(".", ",") for x in rows)], None),
    (lambda head, rows: ["# a remark", head, *rows], None),
    (lambda head, rows: ["%mode," + head, *(f"MANUAL,{x}" for x in rows)], None),  # as rostopic writes
    (lambda head, rows: [head, *(f"{row}," for row in rows)], None),
    (lambda head, rows: [f"{head},note", *(f"{row},#N/A" for row in rows)], None),
    (lambda head, rows: ["[", *rows], "is JSON, or like it. Export it"),
    (lambda head, rows: ["\r".join([head, *rows])], "carriage returns alone. Save it as CSV with line feeds"),
    (lambda head, rows: rows, "its first row holds numbers. Put a row above it"),
    (lambda head, rows: ["made by a program", head, *rows], "names the columns: delete the lines above"),
    (lambda head, rows: [head, *(f"12:00:{row}" for row in rows)], "the time in t is no number, but '12:00:0"),
    (lambda head, rows: [head, *rows[:5], rows[5][:40], *rows[5:]], "row 6 has .* Leave that row out"),
)
def test_tables_as_other_programs_write_them_are_read_or_their_lines_are_named(change, said, table, plain, tmp_path):
    path = write_csv(tmp_path / "flight.csv", table)
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join(change(head, rows)) + "\n")
    if said is None or "left out" in said:
        log = read_log(path)
        np.testing.assert_allclose(log.position, plain.position[: len(log.position)])
        assert (said or "") in str(log) and len(log.time) > len(plain.time) - 3
    else:
        refuses(said, read_log, path, error=UnreadableLog)
    path.write_bytes(path.read_text().encode("utf-16"))
    refuses("is text, but not in UTF-8. Save it as CSV in UTF-8", read_log, path, error=UnreadableLog)


def test_without_a_gyro_the_lean_of_the_drone_tells_a_wrong_quaternion(table, plain, read):
    log = read(drop=GYRO)
    assert "no gyro: angular_velocity was derived from the attitude" in log.notes
    assert "angular_velocity" not in log.onboard
    assert np.corrcoef(log.angular_velocity[300:800, 1], plain.angular_velocity[300:800, 1])[0, 1] > 0.7
    for fault in ("world to body", "scalar first"):
        with pytest.raises(LogError, match="leans where the drone accelerates.*Write columns=") as caught:
            read(FAULTS[fault][0](table), drop=GYRO)
        assert type(caught.value).__name__ == "WrongQuaternion"


def test_gaps_a_lost_tracker_and_a_frozen_one_separate_pieces(table, plain, read):
    t = table["t"]
    whole = plain.segments
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


def test_a_mapping_replaces_entries_of_a_preset_and_nothing_else(table, plain, read):
    renamed = read({"T": 1e3 * table["t"]}, drop=["t"], columns={"time": {"names": "T", "scale": 1e-3}})
    np.testing.assert_allclose(renamed.position, plain.position)
    renamed = {"volts": table["pwr_pm_vbat"], "motor_motor_m5": table["t"]}
    log = read(renamed, drop=("pwr_pm_vbat", "sp_ctrltarget_yaw"), columns={"battery_voltage": "volts"})
    np.testing.assert_array_equal(log.battery_voltage, plain.battery_voltage)
    assert "motor_motor_m5 looks like a fifth motor" in str(log)
    assert set(log.setpoint) == {"position"}  # what the preset knows and the file lacks is left out, as ever


def test_the_delay_of_the_on_board_clock_is_seen_and_left_to_the_fit(table, plain, read):
    lag = 8  # samples
    shifted = read({name: np.roll(table[name], lag) for name in (*GYRO, *FORCE, *MOTORS)})
    told = [float(str(log).split("correlation")[1].split("ms late")[0].split()[1]) for log in (plain, shifted)]
    assert told[1] - told[0] == pytest.approx(80.0, abs=8.0)
    np.testing.assert_allclose(shifted.angular_velocity[lag:-lag], plain.angular_velocity[: -2 * lag], atol=1e-9)


def test_what_holds_no_flight_or_not_what_was_asked_for_is_refused_by_name(read):
    for error, message, options in (
        (NoFlight, "share 0.14 s", {"rows": slice(0, 15)}),
        (NoFlight, "never for 60 s", {"min_duration": 60.0}),
        (MissingColumns, "Unknown layout 'betaflight'. Choose from: nanobench", {"columns": "betaflight"}),
        (MissingColumns, "no column volts, named for battery_voltage", {"columns": {"battery_voltage": "volts"}}),
        (MissingColumns, "no column s of the time. There are: imu_acc_x, ", {"columns": {"time": "s"}}),
    ):
        refuses(message, read, error=error, **options)


# -- tables of a flight whose every quantity is known ------------------------------------------------------------------


def test_a_mapping_reads_any_table_and_rates_are_matched(tmp_path):
    t = np.arange(0.0, END, 0.004)  # 250 Hz, with a battery that is measured each 0.2 s
    columns = own_table(t, battery_voltage=np.where(np.arange(len(t)) % 50, np.nan, flight(t)["battery_voltage"]))
    mapping = TABLE | {"battery_voltage": "v"}
    path = write_csv(tmp_path / "own.csv", columns)
    log = read_log(path, mapping, dt=0.01)
    start, stop = log.segments[0]
    inside = np.arange(start, stop)
    # Where the climb ends and the descent begins, the angular acceleration jumps: a mean over a step differs there.
    inside = inside[(np.abs(log.time[inside] - 3.0) > 0.015) & (np.abs(log.time[inside] - 7.0) > 0.015)]
    true = flight(log.time)
    for name, tolerance in {"position": 1e-4, "velocity": 1e-3, "angular_velocity": 2e-3, "acceleration": 2e-3}.items():
        np.testing.assert_allclose(getattr(log, name)[inside], true[name][inside], atol=tolerance)
    np.testing.assert_allclose(log.motor_command[inside], true["motor_command"][inside], atol=2e-3)
    np.testing.assert_allclose(np.abs((log.quaternion * true["quaternion"]).sum(-1)), 1.0, atol=1e-6)
    np.testing.assert_allclose(log.battery_voltage[inside], true["battery_voltage"][inside], atol=1e-3)
    assert log.onboard == ("angular_velocity", "acceleration", "motor_command", "battery_voltage")

    xyzw = replace(LAYOUTS["nanobench"].convention, motors=(0, 1, 2, 3))
    listed = mapping | {"quaternion": ("qx", "qy", "qz", "qw")}
    np.testing.assert_allclose(read_log(path, listed, convention=xyzw, dt=0.01).quaternion, log.quaternion)
    twice = tmp_path / "twice.csv"
    twice.write_text(path.read_text().replace("wz,", "wy,", 1))
    without = {k: v for k, v in mapping.items() if k != "motor_command"}
    twin = mapping | {"angular_velocity": ("wx", "wy", "fx")}
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
        refuses(message, read_log, file, columns, error=error)


def test_what_is_faster_than_the_log_does_not_alias(tmp_path):
    t = np.arange(0.0, END, 0.002)
    buzz = 2.0 * (-1.0) ** np.arange(len(t))[:, None]  # each fifth sample alone would see it as a bias
    path = write_csv(tmp_path / "fast.csv", own_table(t, angular_velocity=flight(t)["angular_velocity"] + buzz))
    log = read_log(path, TABLE, dt=0.01)
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
    log = read_log(write_csv(tmp_path / "touch.csv", own_table(t, **true)), TABLE)
    expected = ((1.1, 4 + 0.9 / 0.97), (5.5 + 0.07 / 0.97, 8.75))  # 0.1 m above the ground, and above the table
    np.testing.assert_allclose(np.array(log.segments) * log.dt, expected, atol=0.02)
    assert "between take-off and landing are within 0.1 m of the ground" in str(log)


HUGE = 10**400  # more than a float holds
BAD_ARGUMENTS = {
    **dict.fromkeys(("clearance", "max_gap", "min_duration"), (np.nan, -1, True, "a", HUGE)),
    "dt": (np.nan, np.inf, 0, 1e-9, 0.5, HUGE, [1.0], np.array([1.0, 2.0])),
    "columns": (5, b"px4", ["x"], {1: "x"}, {"time": 5}, {"position": [1, 2]}, {"velocity": None}, {"euler": {"a": 1}}),
    "convention": ("px4", 5, {}),
    "onboard": ("setpoint", 5, ["speed"], [None], {"position": 1}),
    "path": (None, 5, b"a.csv", ["a.csv"], "", "a\0b", "a" * 5000, "two\nlines.csv"),
}


@pytest.mark.parametrize("name", BAD_ARGUMENTS)
def test_arguments_that_make_no_log_are_refused_by_name(name, tmp_path):
    path = write_csv(tmp_path / "own.csv", own_table(np.arange(0.0, END, 0.01)))
    for value in BAD_ARGUMENTS[name]:
        with pytest.raises((UserError, OSError)) as refused:
            read_log(**{"path": path, "columns": TABLE} | {name: value})
        assert name in str(refused.value) or name in ("columns", "path")
        assert "\n" not in str(refused.value)
