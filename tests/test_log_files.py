"""One flight as every kind of file is one FlightLog; files that are damaged, or never end, read or are refused."""

import dataclasses
import gzip
import os
import random
import shutil
import socket
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest
from log_writers import END, SERVOS, TABLE, ULOG, dataflash_messages, flight, own_table, px4_messages, times

from log_writers import ulog_message, usd_events, write_bag, write_csv, write_dataflash, write_ulog, write_usd  # isort: skip
from helpers import refuses

from torchrl_quad.identification import Columns, GapsTooLarge, LogError, MissingColumns, read_log, sources
from torchrl_quad.identification.autopilots import PACKED, read_ulog, unpacked
from torchrl_quad.identification.errors import NoFlight, UnreadableLog, WrongMotors, WrongUnit

BATTERY = {"battery_voltage": "/drone/battery.x"}
TOLERANCES = dict.fromkeys(("position", "quaternion", "motor_command", "battery_voltage"), 2e-3)
TOLERANCES |= {"velocity": 1e-2, "angular_velocity": 2e-2, "acceleration": 2e-2}


def same(log, pieces=1, **tolerances):
    """Whether a log is the flight, in its pieces."""
    assert len(log.segments) == pieces
    true = flight(log.time)
    rows = np.concatenate([np.arange(start, stop) for start, stop in log.segments])
    rows = rows[(np.abs(true["position"][rows, 2] - 1.25) < 0.9)]
    assert len(rows) * log.dt > 5.0
    true["quaternion"] *= np.sign((true["quaternion"] * log.quaternion).sum(-1, keepdims=True))
    for name, tolerance in (TOLERANCES | tolerances).items():
        np.testing.assert_allclose(getattr(log, name)[rows], true[name][rows], atol=tolerance, rtol=0, err_msg=name)


def test_a_ulog_is_read_in_our_frames_with_what_leaves_for_the_motors(tmp_path):
    messages = px4_messages()
    log = read_log(write_ulog(tmp_path / "flight.ulg", messages, {"THR_MDL_FAC": 0.3}))
    assert (log.name, log.dt, log.onboard) == ("flight", 0.01, ())
    same(log)
    assert "position comes at 50 Hz only" in str(log) and "THR_MDL_FAC = 0.3" in str(log)
    held = flight(np.floor(log.time * 10 + 1e-6) / 10)["position"]
    np.testing.assert_allclose(log.setpoint["position"], held, atol=1e-5)
    none = tmp_path / "flight.ulg", {"battery_voltage": "batery.voltage"}
    refuses("no column batery.voltage, named for", read_log, *none, error=MissingColumns)
    refuses("such a log has its own clock", read_log, none[0], {"time": "t"}, error=MissingColumns)
    # Older firmware logs pulses; a logger that loses half a second leaves a gap.
    t, _ = messages.pop("actuator_motors")
    signal = flight(t - 5.0)["motor_command"][:, [3, 1, 0, 2]]
    messages["actuator_outputs"] = (t, {"output": ("float", 1000.0 + 1000.0 * signal)})
    lost = (messages["vehicle_attitude"][0] > 10.0) & (messages["vehicle_attitude"][0] < 10.5)
    q = messages["vehicle_attitude"][1]["q"][1]
    messages["vehicle_attitude"] = (messages["vehicle_attitude"][0][~lost], {"q": ("float", q[~lost])})
    log = read_log(write_ulog(tmp_path / "old.ulg", messages, {}))
    same(log, pieces=2)
    assert "actuator_outputs, pulses from 1000 to 2000 us" in str(log) and "1 gap(s) of up to 0.5" in str(log)
    messages["actuator_outputs"] = (t, {"output": ("float", np.maximum(1999.0 * signal, 9.0))})
    assert "actuator_outputs, DShot from 0 to 1999" in str(read_log(write_ulog(tmp_path / "old.ulg", messages, {})))
    for scale, rest, said, parameters in (
        (1999.0, 0.0, "DShot from 0 to 1999", {"DSHOT_CONFIG": 600.0}),
        (875.0, 1075.0, "pulses from 1075 to 1950", {"PWM_MAIN_MIN": 1075, "PWM_MAIN_MAX": 1950, "PWM_MAIN_MIN1": -1}),
    ):
        messages["actuator_outputs"] = (t, {"output": ("float", rest + scale * signal)})
        log = read_log(write_ulog(tmp_path / "old.ulg", messages, parameters))
        assert same(log, pieces=2) is None and said in str(log)
    del messages["actuator_outputs"]
    none = write_ulog(tmp_path / "none.ulg", messages, {})
    refuses("no motor_command or rotor_speed: looked for actuator_motors", read_log, none, error=MissingColumns)


def test_a_dataflash_log_of_ardupilot_is_read_in_our_frames(tmp_path):
    path = write_dataflash(tmp_path / "00000001.BIN", dataflash_messages(), SERVOS)
    same(read_log(path), quaternion=4e-3)
    data = path.read_bytes()
    path.write_bytes(data[:200_000] + b"\xa3\x95\xff" * 5 + data[200_000:-7])
    assert "the dataflash log is damaged: " in str(read_log(path))
    at = data.rfind(b"\xa3\x95")
    path.write_bytes(data[:at] + data[:89] + data[at:])  # a message is described again
    assert "boots" not in str(read_log(path))
    path.write_bytes(data + data)
    log, messages = read_log(path), dataflash_messages()
    (a, b), (c, d) = log.segments
    assert "the log holds 2 boots" in str(log) and (c - a) * log.dt == pytest.approx(END + 10.0, abs=0.02)
    np.testing.assert_allclose(log.position[c + 5 : d - 5], log.position[a + 5 : b - 5], atol=2e-3)
    t, letters, own = messages["XKF1"]  # one core flies at first, and the other from then on
    late, core, t = np.repeat(t > 4.0, 2), np.tile([0, 1], len(t)), np.repeat(t, 2)
    rows = {x: np.repeat(values, 2) * (core == late) for x, values in own.items()} | {"C": core}
    messages |= {"XKF1": (t, letters, rows), "XKF4": (t, "BB", {"C": core, "PI": late.astype(int)})}
    same(read_log(write_dataflash(path, messages, SERVOS)), quaternion=4e-3)
    for parameters in ({"FRAME_CLASS": 2}, SERVOS | {"SERVO9_FUNCTION": 37}, {"SERVO1_FUNCTION": 4}, {"Q_ENABLE": 1}):
        six = write_dataflash(path, dataflash_messages(), {k: float(x) for k, x in parameters.items()})
        refuses("drone with (six|5) rotors|is not the log of a quadrotor", read_log, six, error=WrongMotors)


PLACES = {f"CA_ROTOR{k}_P{x}": v for k, xy in enumerate(((1, -1), (1, 1), (-1, 1), (-1, -1)))
          for x, v in zip("XY", xy, strict=True)} | {"CA_ROTOR_COUNT": 4}  # fmt: skip


def test_the_parameters_of_a_ulog_say_which_outputs_are_motors_and_which_drones_are_none(tmp_path):
    messages = px4_messages()
    t, _ = messages.pop("actuator_motors")
    signal = flight(t - 5.0)["motor_command"]
    still = np.full((len(t), 8), 1500.0)
    pulses = np.where(signal > 0.0, 1075.0 + 875.0 * signal, 900.0)
    ours = pulses[:, [0, 3, 2, 1]]  # front left, front right, back right, back left
    outputs = {"output": ("float", np.concatenate((0.0 * ours, ours), 1))}
    gimbal = still + 400.0 * np.sin(np.outer(t, np.arange(8) % 4))  # whose first axis stands still
    messages |= {"actuator_outputs": (t, {"output": ("float", gimbal)}), "actuator_outputs#1": (t, outputs)}
    messages["actuator_armed"] = (t, {"armed": ("uint8_t", np.ones(len(t)))})
    limits = {"PWM_MIN": 1075, "PWM_MAX": 1950, "PWM_DISARMED": 900}
    functions = {f"PWM_AUX_FUNC{5 + k}": 101 + k for k in range(4)}
    path = tmp_path / "flight.ulg"
    log = read_log(write_ulog(path, messages, limits | functions | {k: float(v) for k, v in PLACES.items()}))
    same(log)
    assert "motor commands are in actuator_outputs#1, pulses from 1075 to 1950 us, placed by CA_ROTOR" in str(log)
    charge = messages["battery_status"][0], {"voltage_v": ("float", 0.0 * messages["battery_status"][0])}
    messages |= {"battery_status": charge, "battery_status#1": messages["battery_status"]}
    same(read_log(write_ulog(path, messages, limits | functions | {k: float(v) for k, v in PLACES.items()})))
    of_old = np.concatenate((gimbal[:, 1:3], pulses[:, [3, 1, 0, 2]], still[:, :2]), 1)  # without functions of outputs
    old = {name: x for name, x in messages.items() if name != "actuator_outputs#1"}
    same(read_log(write_ulog(path, old | {"actuator_outputs": (t, {"output": ("float", of_old)})}, limits)))
    asleep = messages | {"actuator_armed": (t, {"armed": ("uint8_t", 0.0 * t)})}
    asleep["actuator_outputs#1"] = (t, {"output": ("float", 0.0 * still + 900.0)})
    twelve = messages | {"actuator_motors": (t, {"control": ("float", np.tile(signal, 3))})}
    for error, message, logged, parameters in (
        (NoFlight, "never armed: its motors stay at PWM_DISARMED = 900 us", asleep, limits),
        (WrongMotors, "a VTOL .MAV_TYPE 22; its lift motors are outputs 4 to 7", messages, {"MAV_TYPE": 22}),
        (WrongMotors, "a hexacopter", messages, {"MAV_TYPE": 13}),
        (WrongMotors, "a drone with 8 rotors .CA_ROTOR_COUNT", messages, {"CA_ROTOR_COUNT": 8}),
        (WrongMotors, "a drone with 12 motors", twelve, {}),
    ):
        refuses(message, read_log, write_ulog(path, logged, parameters), error=error)


@pytest.mark.parametrize("version", [1, 2])
def test_a_usd_log_is_read_in_both_versions_and_without_its_end(version, tmp_path):
    events = usd_events(times(100), times(10))
    path = write_usd(tmp_path / "log00", events, version)
    log = read_log(path)
    same(log)
    assert log.onboard == () and log.name == "log00"
    assert "checksum" not in str(log)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.9 * len(whole))])
    cut = read_log(path)
    assert "checksum of the uSD log does not match" in str(cut) and "bytes of the uSD log were not read" in str(cut)
    assert cut.time[-1] == pytest.approx(0.9 * END, abs=0.2)
    with pytest.raises(WrongUnit, match=r"gyro.x.*degrees"):
        read_log(write_usd(path, events, version), {"angular_velocity": ("gyro.x", "gyro.y", "gyro.z")})
    path.write_bytes(whole.replace(b"gyro.x(f)", b"gyro.x(e)"))
    refuses(r"a variable of unknown type, 'gyro.x\(e\)'.*export it as CSV", read_log, path, error=UnreadableLog)


def test_compressed_states_of_a_crazyflie_are_unpacked(tmp_path):
    t = times(100)
    true = flight(t)
    q = true["quaternion"][:, [1, 2, 3, 0]]
    code = largest = np.abs(q).argmax(1)  # this component is left out, made positive; the others take ten bits each
    q *= np.sign(np.take_along_axis(q, largest[:, None], 1))
    for k in range(4):
        part = (q[:, k] < 0).astype(int) << 9 | np.rint(np.abs(q[:, k]) * 2**0.5 * 511).astype(int)
        code = np.where(largest == k, code, code << 10 | part)
    back = np.stack(list(unpacked({PACKED: code}).values()), -1)
    assert (1.0 - np.abs((back * q).sum(-1))).max() < 1e-5
    event = usd_events(t, times(10))["fixedFrequency"][1]
    small = {name: x for name, x in event.items() if name.startswith(("acc", "motor"))}
    for k, axis in enumerate("xyz"):
        small[f"stateEstimateZ.{axis}"] = ("h", np.round(1e3 * true["position"][:, k]).astype(int))
        small[f"stateEstimateZ.v{axis}"] = ("h", np.round(1e3 * true["velocity"][:, k]).astype(int))
    for name, x in zip(("Roll", "Pitch", "Yaw"), (true["angular_velocity"] * (1, -1, 1)).T, strict=True):
        small[f"stateEstimateZ.rate{name}"] = ("h", np.round(1e3 * x).astype(int))
    small[PACKED] = ("I", code)
    table = {"Timestamp": 1e3 * t + 5e4} | {name: x for name, (_, x) in small.items()}  # as the client writes it
    usd = write_usd(tmp_path / "log01", {"fixedFrequency": (t, small)}, 2)
    for path in (usd, write_csv(tmp_path / "a.csv", table)):
        log = read_log(path)
        assert log.battery_voltage is None
        log = type(log)(**{**vars(log), "battery_voltage": flight(log.time)["battery_voltage"]})
        same(log, quaternion=4e-3)
    path = write_usd(tmp_path / "log02", usd_events(t, times(10)) | {"second": (t, {"gyro.w": ("f", t)})}, 2)
    with pytest.raises(UnreadableLog, match="different streams"):
        read_log(path, {"angular_velocity": ("gyro.x", "gyro.y", "gyro.w")})


def test_bags_of_ros_1_and_2_find_topics_by_their_types(tmp_path, monkeypatch):
    log = read_log(write_bag(tmp_path / "flight.bag", ros2=False), BATTERY)
    same(log)
    assert log.onboard == ("angular_velocity", "acceleration", "motor_command", "battery_voltage")
    folder = write_bag(tmp_path / "ros2", ros2=True, stamped=None)
    same(read_log(folder, BATTERY))
    (file,) = folder.glob("*.mcap")
    odometry = {
        "position": [f"/drone/odom.pose.pose.position.{a}" for a in "xyz"],
        "quaternion": [f"/drone/odom.pose.pose.orientation.{a}" for a in "xyzw"],
        "velocity_body": [f"/drone/odom.twist.twist.linear.{a}" for a in "xyz"],
    }
    log = read_log(file, BATTERY | odometry, dt=0.01)
    same(log, velocity=2e-2)
    for columns, message in (
        ({"battery_voltage": "/drone/batt.x"}, "no topic /drone/batt. Name.*/drone/battery"),
        ({"battery_voltage": "/drone/battery.voltage"}, "lacks a field of .*Its messages have: x, y, z"),
    ):
        refuses(message, read_log, file, columns, error=MissingColumns)
    with monkeypatch.context() as patch:  # a remedy for the position leaves the attitude of its topic
        true = flight
        patch.setattr("log_writers.flight", lambda t: true(t) | {"position": 1e3 * true(t)["position"]})
        long = write_bag(tmp_path / "long.bag", ros2=False)
    said = refuses("in millimetres", read_log, long, BATTERY, error=WrongUnit)
    same(read_log(long, **eval(f"dict({said.partition('write ')[2][:-1]})", {"Columns": Columns})), velocity=2e-2)
    twins = write_bag(tmp_path / "twins.bag", ros2=False, twin="imu", share=0.1)
    with pytest.raises(MissingColumns, match="several topics for angular_velocity: /drone/imu, /drone/imu2. Say which"):
        read_log(twins, BATTERY)
    # A simulator's clock begins at zero, and its motors are speeds, those of two rotors with a minus.
    log = read_log(write_bag(tmp_path / "simulated.bag", ros2=False, stamped=0, speeds=(800, -800, 800, -800)), BATTERY)
    assert log.battery_voltage is None and "rotor speeds as shares of 4000 rad/s, whatever the battery" in str(log)
    assert log.dt == 0.01 and "stamp: their times" in str(log)
    volts = flight(log.time)["battery_voltage"]
    same(dataclasses.replace(log, motor_command=5.0 * log.motor_command, battery_voltage=volts))
    six = write_bag(tmp_path / "six.bag", ros2=False, speeds=(800,) * 6, share=0.1)
    refuses("/drone/motors drives 6 motors", read_log, six, BATTERY, error=WrongMotors)
    humble = write_bag(tmp_path / "humble", ros2=True, storage="SQLITE3", share=0.1)
    with sqlite3.connect(humble / "humble.db3") as bag:
        bag.execute("delete from message_definitions")
    assert "does not define its messages mav_msgs/msg/Actuators" in refused(humble, BATTERY)


KINDS = dict.fromkeys(("a.ulg", "a.bin", "v1", "v2")) | {"a.csv": TABLE, "a.csv.gz": TABLE}
KINDS |= {"a.bag": BATTERY, "a.db3": BATTERY}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bytes of a log of each kind."""
    folder = tmp_path_factory.mktemp("logs")
    write_ulog(folder / "a.ulg", px4_messages(), {"THR_MDL_FAC": 0.3})
    write_dataflash(folder / "a.bin", dataflash_messages(), SERVOS)
    for version in (1, 2):
        write_usd(folder / f"v{version}", usd_events(times(100), times(10)), version)
    table = write_csv(folder / "a.csv", own_table(times(100))).read_bytes()
    (folder / "a.csv.gz").write_bytes(gzip.compress(table))
    write_bag(folder / "a.bag", ros2=False, share=0.25)
    shutil.copy(write_bag(folder / "a", ros2=True, storage="SQLITE3", share=0.25) / "a.db3", folder)
    return {name: (folder / name).read_bytes() for name in KINDS}


def damaged(data, draw):
    """The bytes with a few bits turned, cut off, with a piece twice or missing, or with a number of another size."""
    data, reach = bytearray(data), min(len(data), draw.choice((64, 1000, len(data))))
    at = draw.randrange(reach)
    match draw.choice(("turn", "turn", "turn many", "cut", "twice", "lose", "number")):
        case "turn":
            data[at] ^= 1 << draw.randrange(8)
        case "turn many":
            for _ in range(30):
                data[draw.randrange(reach)] ^= 1 << draw.randrange(8)
        case "cut":
            del data[draw.randrange(len(data)) :]
        case "twice":
            data[at:at] = data[at : at + draw.choice((1, 100, 10_000))]
        case "lose":
            del data[at : at + draw.choice((1, 100, 10_000))]
        case "number":
            data[at : at + 8] = draw.choice((0, 2**31 - 1, 2**32 - 1, 2**64 - 1)).to_bytes(8, "little")
    return bytes(data)


def refused(path, columns=None):
    """What read_log says of a file that it refuses; None of one that it reads."""
    said = None
    try:
        read_log(path, columns)
    except LogError as error:
        said = str(error)
    assert said is None or ("\n" not in said and path.name in said and len(said) < 4000)
    return said


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_log_reads_or_is_refused_in_one_line_that_names_it(kind, whole, tmp_path):
    draw, path = random.Random(kind), tmp_path / kind
    path.write_bytes(whole[kind])
    assert refused(path, KINDS[kind]) is None
    said = []
    for _ in range(40):
        path.write_bytes(damaged(whole[kind], draw))
        said.append(refused(path, KINDS[kind]))
    assert any(said)
    path.write_bytes(whole[kind])
    assert refused(path, KINDS[kind]) is None  # nothing was left behind


def test_a_ulog_is_read_on_behind_what_is_damaged(whole, tmp_path):
    sync = ulog_message("S", bytes.fromhex("2f731320250cbb12"))
    data, half = whole["a.ulg"], whole["a.ulg"].index(struct.pack("<H", 14) + b"D", 150_000)
    (tmp_path / "a.ulg").write_bytes(data[:half] + b"\xff" * 1000 + sync + data[half:])
    log, plain = read_log(tmp_path / "a.ulg"), read_ulog(data, "a")[0]
    assert "the ULog is damaged: 1 messages and 0 bytes were not read" in str(log)
    again = read_ulog((tmp_path / "a.ulg").read_bytes(), "a")[0]
    assert [len(stream.time) for stream in again] == [len(stream.time) for stream in plain]


def ulog_of(*formats, count=100):
    body = b"".join(ulog_message("F", text.encode()) for text in formats)
    body += ulog_message("A", b"\0\0\0" + formats[0].split(":")[0].encode()) * count
    return ULOG + body + ulog_message("D", bytes(20))


REFUSED = {  # what is no log, or what no reader should follow to its end: a file, and what its refusal says
    "empty.csv": (b"", "is empty"),
    "zeros.bin": (b"\xa3\x95" + bytes(1000), "not a readable dataflash log"),
    "flight.bbl": (b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n", "neither position nor attitude"),
    "decoded.csv": (b"time (us), gyroADC[0], motor[0]\n0, 1, 2\n1, 2, 3\n", "a Betaflight blackbox"),
    "explorer.csv": (b'"Product","Blackbox flight data recorder by Nicholas Sherlock"\n', "a Betaflight blackbox"),
    "lfs.ulg": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "not downloaded. Write: git lfs pull"),
    "page.csv": (b"\n<!DOCTYPE html>\n<html>", "is a web page. Download the file itself"),
    "1.log": (b"FMT, 128, 89, FMT, BBnNZ, Type,Length\n", "the text of a dataflash log. Give its .bin"),
    "metadata.yaml": (b"rosbag2_bagfile_information:\n  version: 5\n", "Give the folder that it lies in"),
    "inav.csv": (b"time,gyroADC[0],motor[0],navPos[0]\n0,0,1,2\n1,1,2,3\n", "No preset knows the columns"),
    "junk.bin": (bytes(range(128, 256)), "not a log of a known kind"),
    "text.csv": (b"Dear reader,\nthis is a letter.\n", "fewer than two samples"),
    "ragged.csv": (b"t,x\n1,2\n1,2,3\n", "not a table of numbers"),
    "cut.csv.gz": (gzip.compress(random.Random(0).randbytes(2000))[:1000], "broken gz"),
    "cut.ulg": (ULOG[:8], "not a readable ULog"),
    "cut.bag": (b"#ROSBAG V2.0\n", "not a readable ROS bag"),
    "cut.usd": (b"\xbc\x02\x00\x05\x00abc", "header cannot be read: subsection not found"),
    "new.usd": (b"\xbc\x09\x00\x00\x00abcd", "version 9"),
    "nested.ulg": (ulog_of(*(f"a{k}:a{k + 1}[65535] x;" for k in range(9)), "a9:uint8_t[65535] x;"), "no sample"),
    "itself.ulg": (ulog_of("a:uint64_t timestamp;a x;"), "no sample"),
    "nothing.ulg": (ulog_of("a:uint64_t timestamp;b[65535] x;", "b:c[65535] x;", "c:"), "no sample"),
    "wide.ulg": (ulog_of(*(f"a{k}:uint64_t timestamp;uint8_t[65000] x;" for k in range(2000))), "no sample"),
    "zeros.ulg": (ULOG + bytes(10**6), "no sample"),
    "zeros.mcap": (b"\x89MCAP0\r\n" + bytes(1000), "not a readable ROS bag: Unexpected record"),
    "zeros.db3": (b"SQLite format 3\0" + bytes(1000), "not a readable ROS bag"),
    "line.csv": (b"t" * 5_000_000, "line 1 has more than 4,000,000 bytes"),
    "columns.csv": (b"," * 100_000 + b"\n1\n", "has more than 100,000 columns, the maximum"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_log_or_would_take_for_ever_is_refused_at_once(name, tmp_path):
    data, message = REFUSED[name]
    (tmp_path / name).write_bytes(data)
    assert message in refused(tmp_path / name)


def test_limits_of_size_are_named_before_memory_is_full(tmp_path, monkeypatch):
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(b"t,px,py,pz\n" + b"0,0,0,0\n" * 200_000))
    monkeypatch.setattr(sources, "MAX_UNPACKED", 10**6)
    assert "has more than 1,000,000 bytes when it is unpacked" in refused(path)
    monkeypatch.undo()
    monkeypatch.setattr(sources, "MAX_ROWS", 1000)
    assert "has more than 1,000 lines" in refused(path)
    with open(tmp_path / "large.csv", "wb") as file:
        file.truncate(10**11)  # which takes no room on the disk
    assert "has more than 2,000,000,000 bytes, the maximum" in refused(tmp_path / "large.csv")


def test_a_pipe_a_socket_and_a_device_are_refused_unopened(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "link.csv").symlink_to("/dev/zero")
    monitor = socket.socket(socket.AF_UNIX)
    monitor.bind(str(tmp_path / "socket"))
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").touch()
    os.mkfifo(folder / "a.mcap")
    for path in (tmp_path / "pipe.csv", tmp_path / "link.csv", tmp_path / "socket", folder, Path("/dev/zero")):
        assert "is not a regular file but a pipe, a socket or a device" in refused(path)
    monitor.close()
    (folder / "a.mcap").unlink()
    assert "is a folder without a ROS bag" in refused(folder) and "does not exist" in refused(tmp_path / "nowhere.csv")
    monkeypatch.setattr(Path, "is_file", lambda path: True)  # when it was looked at, before it became a pipe
    assert "is not a regular file" in refused(tmp_path / "pipe.csv")


def test_a_clock_that_jumps_ahead_is_refused_before_it_is_put_on_a_grid(tmp_path, monkeypatch):
    t = times(100)
    path = write_csv(tmp_path / "a.csv", own_table(t) | {"t": t + 1e7 * (t > 5.0)})
    with pytest.raises(GapsTooLarge, match=r"1e\+09 steps of 0.01 s; the maximum is 1,000,000. The clock of position"):
        read_log(path, TABLE)
    write_csv(path, own_table(t) | {"t": np.where(np.arange(len(t)) == 500, 1e300, t)})
    assert "1 samples of position (x, y, z) are not finite" in str(read_log(path, TABLE))  # damage, and no jump
    monkeypatch.setattr("torchrl_quad.identification.log.MAX_STEPS", 10_000)
    long = np.linspace(0.0, 90.0, 2000)
    write_csv(path, own_table(t)).write_text("t,x,y,z\n" + "".join(f"{x},0,0,0\n" for x in long))
    table = own_table(t)
    path = write_csv(path, {name: np.interp(long % 10.0, t, x) for name, x in table.items()} | {"t": long})
    refuses("Cut it into shorter logs. Write dt=0.018", read_log, path, TABLE, error=UnreadableLog, dt=0.001)


def test_values_beyond_any_flight_count_as_missing_and_wide_tables_are_read(tmp_path):
    t = times(100)
    path = write_csv(tmp_path / "a.csv", own_table(t) | {"x": np.where(t == t[500], 1e38, own_table(t)["x"])})
    log = read_log(path, TABLE)
    assert np.abs(log.position).max() < 10.0 and "beyond 1e+09" in str(log)
    head, *rows = path.read_text().splitlines()
    names = ",".join(f"c{k}" for k in range(20_000))
    path.write_text("\n".join([f"{head},{names}", *(row + ",text" * 20_000 for row in rows[:300])]))
    assert len(read_log(path, TABLE, min_duration=0.0).time) == 300
