"""One flight, written as every kind of file by writers that share no code with the readers, is one FlightLog."""

import numpy as np
import pytest
from log_writers import END, flight, matrix, ned, write_ulog, write_usd

from torchrl_quad.identification import MissingColumns, UnreadableLog, WrongUnit, read_log
from torchrl_quad.identification.autopilots import decompress_quaternions

TOLERANCES = dict.fromkeys(("position", "quaternion", "motor_command", "battery_voltage"), 2e-3)
TOLERANCES |= {"velocity": 1e-2, "angular_velocity": 2e-2, "acceleration": 2e-2}


def times(rate, start=0.0):
    return start + np.arange(int((END - start) * rate)) / rate


def same(log, begin=0.0, pieces=1, **tolerances):
    """Whether a log is the flight, in its pieces; it begins at ``begin``."""
    assert len(log.segments) == pieces
    true = flight(log.time + begin)
    rows = np.concatenate([np.arange(start, stop) for start, stop in log.segments])
    rows = rows[(np.abs(true["position"][rows, 2] - 1.25) < 0.9)]
    assert len(rows) * log.dt > 5.0
    true["quaternion"] *= np.sign((true["quaternion"] * log.quaternion).sum(-1, keepdims=True))
    for name, tolerance in (TOLERANCES | tolerances).items():
        np.testing.assert_allclose(getattr(log, name)[rows], true[name][rows], atol=tolerance, rtol=0, err_msg=name)


def px4_messages():
    rates = {"position": 50, "quaternion": 100, "imu": 250, "motors": 200, "battery": 5, "setpoint": 10}
    t = {name: times(rate, 0.0) for name, rate in rates.items()}
    true = {name: flight(times_) for name, times_ in t.items()}
    theirs = {name: ned(x) for name, x in true.items()}
    signal = true["motors"]["motor_command"][:, [3, 1, 0, 2]]  # front right, back left, front left, back right
    control = np.where(signal > 0.0, 0.3 * signal**2 + 0.7 * signal, np.nan)  # a motor that stands is NaN
    late = {"timestamp_sample": ("uint64_t", np.round((t["imu"] + 5.0) * 1e6))}
    place = np.concatenate((theirs["position"]["position"], theirs["position"]["velocity"]), 1)
    return {
        "vehicle_local_position": (
            t["position"] + 5.0,
            {name: ("float", x) for name, x in zip(("x", "y", "z", "vx", "vy", "vz"), place.T, strict=True)},
        ),
        "vehicle_attitude": (t["quaternion"] + 5.0, {"q": ("float", theirs["quaternion"]["quaternion"])}),
        # Published 4 ms after they were sampled.
        "vehicle_angular_velocity": (t["imu"] + 5.004, late | {"xyz": ("float", theirs["imu"]["angular_velocity"])}),
        "vehicle_acceleration": (t["imu"] + 5.004, late | {"xyz": ("float", theirs["imu"]["acceleration"])}),
        "actuator_motors": (t["motors"] + 5.0, {"control": ("float", np.pad(control, ((0, 0), (0, 8))))}),
        "battery_status": (t["battery"] + 5.0, {"voltage_v": ("float", true["battery"]["battery_voltage"])}),
        "trajectory_setpoint": (t["setpoint"] + 5.0, {"position": ("float", theirs["setpoint"]["position"])}),
    }


def test_a_ulog_is_read_in_our_frames_with_what_leaves_for_the_motors(tmp_path):
    messages = px4_messages()
    log = read_log(write_ulog(tmp_path / "flight.ulg", messages, {"THR_MDL_FAC": 0.3}))
    assert (log.name, log.dt, log.onboard) == ("flight", 0.01, ())
    same(log)
    assert "position comes at 50 Hz only" in str(log) and "THR_MDL_FAC = 0.3" in str(log)
    held = flight(np.floor(log.time * 10 + 1e-6) / 10)["position"]
    np.testing.assert_allclose(log.setpoint["position"], held, atol=1e-5)

    with pytest.raises(MissingColumns, match="no column batery_status.voltage_v, named for battery_voltage"):
        read_log(tmp_path / "flight.ulg", {"battery_voltage": "batery_status.voltage_v"})

    # Older firmware logs pulses; a logger that loses half a second leaves a gap.
    t, _ = messages.pop("actuator_motors")
    signal = flight(t - 5.0)["motor_command"][:, [3, 1, 0, 2]]
    messages["actuator_outputs"] = (t, {"output": ("float", 1000.0 + 1000.0 * signal)})
    lost = (messages["vehicle_attitude"][0] > 10.0) & (messages["vehicle_attitude"][0] < 10.5)
    q = messages["vehicle_attitude"][1]["q"][1]
    messages["vehicle_attitude"] = (messages["vehicle_attitude"][0][~lost], {"q": ("float", q[~lost])})
    log = read_log(write_ulog(tmp_path / "old.ulg", messages, {}))
    same(log, pieces=2)
    assert "no actuator_motors" in str(log) and "1 gap(s) of up to 0.5" in str(log)
    del messages["actuator_outputs"]
    with pytest.raises(MissingColumns, match="has no motor_command: looked for actuator_motors"):
        read_log(write_ulog(tmp_path / "none.ulg", messages, {}))


def usd_events(t, slow):
    true, battery = flight(t), flight(slow)
    columns = {}
    for stem, axes, values in (
        ("stateEstimate.", "xyz", true["position"]),
        ("stateEstimate.v", "xyz", true["velocity"]),
        ("stateEstimate.q", "wxyz", true["quaternion"]),
        ("gyro.", "xyz", np.degrees(true["angular_velocity"])),
        ("acc.", "xyz", true["acceleration"] / 9.80665),
    ):
        columns |= {stem + axis: ("f", values[:, k]) for k, axis in enumerate(axes)}
    pulses = np.round(65535 * true["motor_command"]).astype(int)  # m1 is front right, and then clockwise
    columns |= {f"motor.m{k + 1}": ("H", pulses[:, place]) for k, place in enumerate((3, 2, 1, 0))}
    return {"fixedFrequency": (t, columns), "battery": (slow, {"pm.vbat": ("f", battery["battery_voltage"])})}


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
    with pytest.raises(UnreadableLog, match=r"a variable of unknown type, 'gyro.x\(e\)'.*export it as CSV"):
        read_log(path)


def test_compressed_states_of_a_crazyflie_are_unpacked(tmp_path):
    t = times(100)
    true = flight(t)
    q = true["quaternion"][:, [1, 2, 3, 0]]
    code = np.zeros(len(t), np.uint64)
    for row, x in enumerate(q):  # the largest component is left out, made positive; the others take ten bits each
        largest = int(np.argmax(np.abs(x)))
        word = largest
        for k in range(4):
            if k != largest:
                negative = (x[k] < 0) != (x[largest] < 0)
                word = word << 10 | int(negative) << 9 | round(abs(x[k]) * 2**0.5 * 511)
        code[row] = word
    back = decompress_quaternions(code)
    assert (1.0 - np.abs((back * q).sum(-1))).max() < 1e-5
    event = usd_events(t, times(10))["fixedFrequency"][1]
    small = {name: x for name, x in event.items() if name.startswith(("acc", "motor"))}
    for k, axis in enumerate("xyz"):
        small[f"stateEstimateZ.{axis}"] = ("h", np.round(1e3 * true["position"][:, k]).astype(int))
        small[f"stateEstimateZ.v{axis}"] = ("h", np.round(1e3 * true["velocity"][:, k]).astype(int))
    for name, x in zip(("Roll", "Pitch", "Yaw"), (true["angular_velocity"] * (1, -1, 1)).T, strict=True):
        small[f"stateEstimateZ.rate{name}"] = ("h", np.round(1e3 * x).astype(int))
    small["stateEstimateZ.quat"] = ("I", code.astype(int))
    log = read_log(write_usd(tmp_path / "log01", {"fixedFrequency": (t, small)}, 2))
    assert log.battery_voltage is None
    log = type(log)(**{**vars(log), "battery_voltage": flight(log.time)["battery_voltage"]})
    same(log, quaternion=4e-3)
    events = usd_events(t, times(10)) | {"second": (t, {"gyro.w": ("f", t)})}
    path = write_usd(tmp_path / "log02", events, 2)
    with pytest.raises(UnreadableLog, match="different streams"):
        read_log(path, {"angular_velocity": ("gyro.x", "gyro.y", "gyro.w")})


ACTUATORS = "std_msgs/Header header\nfloat64[] angles\nfloat64[] angular_velocities\nfloat64[] normalized\n"


def ros_messages(store, stamped=True):
    """Topics of a flight in motion capture: poses of the tracker, an IMU, the motors, odometry, and a battery."""
    seconds, zeros = 1_700_000_000, np.zeros(9)

    def make(kind, *values, **more):
        return store.types[kind](*values, **more)

    def geometry(kind, *values):
        return make(f"geometry_msgs/msg/{kind}", *values)

    for rate, topic, kind in (
        (100, "pose", "geometry_msgs/msg/PoseStamped"),
        (50, "odom", "nav_msgs/msg/Odometry"),
        (125, "imu", "sensor_msgs/msg/Imu"),
        (100, "motors", "mav_msgs/msg/Actuators"),
        (5, "battery", "geometry_msgs/msg/Vector3"),  # any message may carry the battery: a mapping names it
    ):
        t = times(rate)
        true = flight(t)
        true["body"] = np.einsum("nji,nj->ni", matrix(true["quaternion"]), true["velocity"])
        for i, at in enumerate(t):
            now = {name: x[i].tolist() for name, x in true.items()}
            stamp = make("builtin_interfaces/msg/Time", seconds + int(at) if stamped else 0, round(at % 1 * 1e9))
            extra = {"seq": 0} if "seq" in store.types["std_msgs/msg/Header"].__dataclass_fields__ else {}
            header = make("std_msgs/msg/Header", stamp=stamp, frame_id="world", **extra)
            w, *xyz = now["quaternion"]
            pose = geometry("Pose", geometry("Point", *now["position"]), geometry("Quaternion", *xyz, w))
            rates, speed, force = (geometry("Vector3", *now[x]) for x in ("angular_velocity", "body", "acceleration"))
            values = {
                "pose": (header, pose),
                "odom": (
                    header,
                    "drone",
                    geometry("PoseWithCovariance", pose, np.zeros(36)),
                    geometry("TwistWithCovariance", geometry("Twist", speed, rates), np.zeros(36)),
                ),
                "imu": (header, geometry("Quaternion", 0.0, 0.0, 0.0, 1.0), zeros, rates, zeros, force, zeros),
                "motors": (header, zeros[:0], zeros[:0], true["motor_command"][i]),
                "battery": (now["battery_voltage"], 0.0, 0.0),
            }
            yield topic, kind, int((seconds + at) * 1e9), make(kind, *values[topic])


def write_bag(path, ros2, storage=None, twin=None, pack=None, **options):
    """A bag of either version; ``twin`` is a topic that it has twice, and ``pack`` says how it is compressed."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(ACTUATORS, "mav_msgs/msg/Actuators"))
    writer = Writer2(path, version=9, storage_plugin=storage) if ros2 else Writer1(path)
    if pack:
        pack(writer)
    with writer:
        connections = {}
        for topic, kind, received, message in ros_messages(store, **options):
            raw = store.serialize_cdr(message, kind) if ros2 else bytes(store.serialize_ros1(message, kind))
            for name in (topic, *([f"{topic}2"] if topic == twin else [])):
                if name not in connections:
                    connections[name] = writer.add_connection(f"/drone/{name}", kind, typestore=store)
                writer.write(connections[name], received, raw)
    return path


def test_bags_of_ros_1_and_2_find_topics_by_their_types(tmp_path):
    from rosbags.rosbag2 import StoragePlugin

    battery = {"battery_voltage": "/drone/battery.x"}
    log = read_log(write_bag(tmp_path / "flight.bag", ros2=False), battery)
    same(log)
    assert log.onboard == ("angular_velocity", "acceleration", "motor_command", "battery_voltage")
    assert "messages of /drone/battery carry no stamp" in str(log)
    folder = write_bag(tmp_path / "ros2", ros2=True, storage=StoragePlugin.MCAP, stamped=False)
    same(read_log(folder, battery))
    (file,) = folder.glob("*.mcap")
    odometry = {
        **{"position": [f"/drone/odom.pose.pose.position.{a}" for a in "xyz"]},
        **{"quaternion": [f"/drone/odom.pose.pose.orientation.{a}" for a in "xyzw"]},
        **{"velocity_body": [f"/drone/odom.twist.twist.linear.{a}" for a in "xyz"]},
    }
    log = read_log(file, {**battery, **odometry}, dt=0.01)
    same(log, velocity=2e-2)
    for columns, message in (
        ({"battery_voltage": "/drone/batt.x"}, "no topic /drone/batt. Name.*/drone/battery"),
        ({"battery_voltage": "/drone/battery.voltage"}, "lacks a field of .*Its messages have: x, y, z"),
    ):
        with pytest.raises(MissingColumns, match=message):
            read_log(file, columns)
    twins = write_bag(tmp_path / "twins.bag", ros2=False, twin="imu")
    with pytest.raises(MissingColumns, match="several topics for angular_velocity: /drone/imu, /drone/imu2. Say which"):
        read_log(twins, battery)
