"""A flight whose every quantity is known at every time, and writers of logs that share no code with the readers."""

import struct
import zlib

import numpy as np
from scipy.spatial.transform import Rotation

END = 10.0  # [s]
G = 9.80665
# By rotors front left, back left, back right, front right: how each turns the drone about x, y and z.
TURNING = np.array([[1, 1, -1, -1], [-1, 1, 1, -1], [1, -1, 1, -1]])
OURS = {"position": ("x", "y", "z"), "quaternion": ("qw", "qx", "qy", "qz"), "velocity": ("vx", "vy", "vz")}
OURS |= {"angular_velocity": ("wx", "wy", "wz"), "acceleration": ("fx", "fy", "fz")}
OURS |= {"motor_command": ("u0", "u1", "u2", "u3")}
TABLE = {"time": "t", **OURS}
ULOG = b"ULog\x01\x12\x35\x01" + bytes(8)  # its header


def matrix(q):
    """Rotation matrices (T, 3, 3) of quaternions w x y z."""
    return Rotation.from_quat(q, scalar_first=True).as_matrix()


def _position(t):
    rise = np.clip((t - 1.0) / 2.0, 0.0, 1.0) * np.clip((9.0 - t) / 2.0, 0.0, 1.0)
    s = rise**4 * (35.0 - 84.0 * rise + 70.0 * rise**2 - 20.0 * rise**3)  # three derivatives begin and end at 0
    return np.stack((s * np.sin(1.7 * t), 0.8 * s * np.sin(2.3 * t + 0.4), 0.05 + 1.2 * s), -1)


def _attitude(t):
    """Leaning where it accelerates, as a quadrotor must, and turning about its thrust."""
    h = 1e-3
    pull = (_position(t + h) - 2.0 * _position(t) + _position(t - h)) / h**2 + (0.0, 0.0, G)
    size = np.linalg.norm(pull, axis=-1)
    x, y, z = (pull / size[:, None]).T
    lean = np.stack((1.0 + z, -y, x, np.zeros_like(x)), -1)
    yaw = 1.2 * np.sin(0.8 * t) * (t > 0.0)
    return Rotation.from_quat(lean, scalar_first=True) * Rotation.from_rotvec(yaw[:, None] * (0, 0, 1)), size


def flight(t):
    """What is true at times t [s]: it stands for a second, flies for eight, lands and stands again."""
    h = 1e-4
    attitude, size = _attitude(t)
    turned = _attitude(t - h)[0].inv() * _attitude(t + h)[0]
    on = ((t > 0.7) & (t < 9.3))[:, None]
    rates = [(_attitude(x - h)[0].inv() * _attitude(x + h)[0]).as_rotvec() / (2.0 * h) for x in (t - h, t + h)]
    thrust = 0.35 * size[:, None] / G + 0.004 * np.clip((rates[1] - rates[0]) / (2.0 * h), -20.0, 20.0) @ TURNING
    true = {"position": _position(t), "velocity": (_position(t + h) - _position(t - h)) / (2.0 * h)}
    true |= {"quaternion": attitude.as_quat(scalar_first=True), "angular_velocity": turned.as_rotvec() / (2.0 * h)}
    true |= {"acceleration": size[:, None] * (0.0, 0.0, 1.0), "battery_voltage": 4.1 - 0.04 * t}
    return true | {"motor_command": on * np.sqrt(np.clip(thrust, 0.01, 1.0))}


def own_table(t, **changes):
    true = flight(t) | changes
    columns = {"t": t}
    for quantity, names in OURS.items():
        columns |= dict(zip(names, true[quantity].T, strict=True))
    return columns | {"v": true["battery_voltage"]}


def write_csv(path, columns):
    table = np.stack(list(columns.values()), -1)
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.10g")
    return path


def ned(true):
    """What PX4 logs of a flight in our frames: x east becomes y east; body y left becomes y right."""
    world = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    body = np.diag([1.0, -1.0, -1.0])
    rotation = Rotation.from_matrix(world @ matrix(true["quaternion"]) @ body)
    return {
        "position": true["position"] @ world.T,
        "velocity": true["velocity"] @ world.T,
        "quaternion": rotation.as_quat(scalar_first=True),
        "angular_velocity": true["angular_velocity"] @ body,
        "acceleration": true["acceleration"] @ body,
    }


def ulog_message(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


def write_ulog(path, messages, parameters):
    """A ULog, by its published format: header, formats, parameters, subscriptions, data.

    ``messages`` maps a name to (times [s], {field: (type, array)}); arrays of shape (T, n) are fields of n.
    """
    out = [ULOG, ulog_message("B", bytes(40))]
    letters = {"float": "f4", "uint64_t": "u8", "uint8_t": "u1"}
    for name, (_, fields) in messages.items():
        parts = ["uint64_t timestamp"]
        for field, (kind, values) in fields.items():
            parts.append(f"{kind}[{values.shape[1]}] {field}" if values.ndim == 2 else f"{kind} {field}")
        out.append(ulog_message("F", f"{name.partition('#')[0]}:{';'.join(parts)};".encode()))
    for name, value in parameters.items():
        kind, letter = ("int32_t", "i") if isinstance(value, int) else ("float", "f")
        key = f"{kind} {name}".encode()
        out.append(ulog_message("P", bytes([len(key)]) + key + struct.pack(f"<{letter}", value)))
    for k, name in enumerate(messages):
        stem, _, instance = name.partition("#")
        out.append(ulog_message("A", bytes([int(instance or 0)]) + struct.pack("<H", k) + stem.encode()))
    rows = []
    for k, (times, fields) in enumerate(messages.values()):
        stamps = np.round(times * 1e6).astype("<u8")
        parts = [v.astype("<" + letters[kind]).reshape(len(times), -1) for kind, v in fields.values()]
        for i, stamp in enumerate(stamps):
            rows.append((stamp, struct.pack("<H", k) + stamp.tobytes() + b"".join(p[i].tobytes() for p in parts)))
    out += [ulog_message("D", body) for _, body in sorted(rows, key=lambda row: row[0])]
    path.write_bytes(b"".join(out))
    return path


def write_usd(path, events, version):
    """A uSD log: ``events`` maps a name to (times [s], {variable: (letter, array)})."""
    out = [b"\xbc", struct.pack("<HH", version, len(events))]
    rows = []
    for k, (name, (times, variables)) in enumerate(events.items()):
        out.append(struct.pack("<H", 7 + k) + name.encode() + b"\0" + struct.pack("<H", len(variables)))
        out += [f"{variable}({letter})".encode() + b"\0" for variable, (letter, _) in variables.items()]
        layout = "<H" + {1: "I", 2: "Q"}[version] + "".join(letter for letter, _ in variables.values())
        ticks = np.round(times * {1: 1e3, 2: 1e6}[version]).astype(int)
        columns = [v.tolist() for _, v in variables.values()]
        rows += [(t, struct.pack(layout, 7 + k, t, *x)) for t, *x in zip(ticks.tolist(), *columns, strict=True)]
    data = b"".join(out + [row for _, row in sorted(rows, key=lambda row: row[0])])
    path.write_bytes(data + struct.pack("<I", zlib.crc32(data)))
    return path


def write_dataflash(path, messages, parameters):
    """A dataflash log: a message FMT of 89 bytes for each kind, then the messages, each behind a3 95 and its number.

    ``messages`` maps a name to (times [s], format of its columns, {column: array})."""
    sizes, out, rows = {"Q": 8, "f": 4, "B": 1, "H": 2, "N": 16, "c": 2}, [], []

    def describe(number, name, letters, columns):
        size = 3 + sum(sizes[letter] for letter in letters)
        packed = struct.pack("<BB4s16s64s", number, size, name.encode(), letters.encode(), ",".join(columns).encode())
        out.append(b"\xa3\x95\x80" + packed)

    describe(1, "PARM", "QNf", ["TimeUS", "Name", "Value"])
    out += [b"\xa3\x95\x01" + struct.pack("<Q16sf", 0, name.encode(), value) for name, value in parameters.items()]
    for k, (name, (times, letters, columns)) in enumerate(messages.items(), 2):
        describe(k, name, f"Q{letters}", ["TimeUS", *columns])
        layout = "<Q" + letters.replace("c", "h")
        stamps = np.round(1e6 * times).astype(int).tolist()
        for at, *row in zip(stamps, *(x.tolist() for x in columns.values()), strict=True):
            rows.append((at, b"\xa3\x95" + bytes([k]) + struct.pack(layout, at, *row)))
    path.write_bytes(b"".join(out + [row for _, row in sorted(rows, key=lambda row: row[0])]))
    return path


def times(rate):
    return np.arange(int(END * rate)) / rate


def px4_messages():
    rates = {"position": 50, "quaternion": 100, "imu": 250, "motors": 200, "battery": 5, "setpoint": 10}
    t = {name: times(rate) for name, rate in rates.items()}
    true = {name: flight(x) for name, x in t.items()}
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


def dataflash_messages():
    t, slow = times(100), times(10)
    true, battery = flight(t), flight(slow)
    theirs = ned(true)
    angles = Rotation.from_quat(theirs["quaternion"], scalar_first=True).as_euler("ZYX", degrees=True)[:, ::-1]
    pulses = np.round(1000.0 + 900.0 * true["motor_command"]).astype(int)
    place = np.hstack((theirs["position"], theirs["velocity"])).T
    kf = dict(zip(("PN", "PE", "PD", "VN", "VE", "VD"), place, strict=True))
    imu = np.hstack((theirs["angular_velocity"], theirs["acceleration"])).T
    which = {"C": np.zeros(len(t), int)}
    return {
        "XKF1": (t, "Bffffff", which | kf),
        "ATT": (t, "ccc", dict(zip(("Roll", "Pitch", "Yaw"), np.round(100.0 * angles.T).astype(int), strict=True))),
        "IMU": (t, "ffffff", dict(zip(("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"), imu, strict=True))),
        # Outputs 5 to 8 drive motors 1 to 4: front right, back left, front left, back right.
        "RCOU": (t, "HHHH", {f"C{5 + k}": pulses[:, x] for k, x in enumerate((3, 1, 0, 2))}),
        "BAT": (slow, "Bf", {"Inst": np.zeros(len(slow), int), "Volt": battery["battery_voltage"]}),
    }


SERVOS = {f"SERVO{5 + k}_FUNCTION": 33.0 + k for k in range(4)} | {"MOT_PWM_MIN": 1000.0, "MOT_PWM_MAX": 1900.0}


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


ACTUATORS = "std_msgs/Header header\nfloat64[] angles\nfloat64[] angular_velocities\nfloat64[] normalized\n"


def ros_messages(store, stamped, speeds, share):
    """Topics of a flight in motion capture: poses of the tracker, an IMU, the motors, odometry, and a battery.

    ``stamped`` is the first second of the stamps, None for none; of ``speeds`` each motor has this many [rad/s]."""
    make = {kind.rpartition("/")[2]: cls for kind, cls in reversed(store.types.items())}
    extra = {"seq": 0} if "seq" in make["Header"].__dataclass_fields__ else {}
    zeros, covariance = np.zeros(9), np.zeros(36)
    for rate, topic, kind in (
        (100, "pose", "geometry_msgs/msg/PoseStamped"),
        (50, "odom", "nav_msgs/msg/Odometry"),
        (125, "imu", "sensor_msgs/msg/Imu"),
        (100, "motors", "mav_msgs/msg/Actuators"),
        (5, "battery", "geometry_msgs/msg/Vector3"),  # any message may carry the battery: a mapping names it
    ):
        t = times(share * rate)
        true = flight(t)
        true["body"] = np.einsum("nji,nj->ni", matrix(true["quaternion"]), true["velocity"])
        for i, at in enumerate(t):
            now = {name: x[i] for name, x in true.items()}
            seconds = (stamped or 0) + (0 if stamped is None else int(at))
            stamp = make["Time"](seconds, 0 if stamped is None else round(at % 1 * 1e9))
            header = make["Header"](stamp=stamp, frame_id="world", **extra)
            pose = make["Pose"](make["Point"](*now["position"]), make["Quaternion"](*np.roll(now["quaternion"], -1)))
            rates, speed, force = (make["Vector3"](*now[x]) for x in ("angular_velocity", "body", "acceleration"))
            twist = make["TwistWithCovariance"](make["Twist"](speed, rates), covariance)
            values = {
                "pose": (header, pose),
                "odom": (header, "drone", make["PoseWithCovariance"](pose, covariance), twist),
                "imu": (header, pose.orientation, zeros, rates, zeros, force, zeros),
                "motors": (header, zeros[:0], zeros[:0], now["motor_command"])
                if not len(speeds)
                else (header, zeros[:0], np.resize(now["motor_command"], len(speeds)) * speeds, zeros[:0]),
                "battery": (now["battery_voltage"], 0.0, 0.0),
            }
            yield topic, kind, int((1_700_000_000 + at) * 1e9), store.types[kind](*values[topic])


def write_bag(path, ros2, storage="MCAP", twin=None, stamped=1_700_000_000, speeds=(), share=1.0):
    """A bag of either version; ``twin`` is a topic that it has twice, and ``share`` that of the usual rates."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(ACTUATORS, "mav_msgs/msg/Actuators"))
    connections = {}
    with Writer2(path, version=9, storage_plugin=StoragePlugin[storage]) if ros2 else Writer1(path) as writer:
        for topic, kind, received, message in ros_messages(store, stamped, np.asarray(speeds), share):
            raw = store.serialize_cdr(message, kind) if ros2 else bytes(store.serialize_ros1(message, kind))
            for name in (topic, *([f"{topic}2"] if topic == twin else [])):
                if name not in connections:
                    connections[name] = writer.add_connection(f"/drone/{name}", kind, typestore=store)
                writer.write(connections[name], received, raw)
    return path
