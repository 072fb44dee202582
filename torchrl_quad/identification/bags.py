"""ROS bags: ROS 1 files, and ROS 2 folders or files."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchrl_quad.identification.errors import MissingColumns, UnreadableLog
from torchrl_quad.identification.layouts import BY_IMU, ROS, Columns, Layout, choose
from torchrl_quad.identification.ros_files import MAGIC, BagFile, Connection
from torchrl_quad.identification.ros_messages import STAMP, Damaged, Decoder
from torchrl_quad.identification.streams import Stream

__all__ = ["MAGIC", "read_bag"]

_AXES = ("x", "y", "z")
# What the messages of a type hold. Poses first: whoever flies in motion capture has them, too, as odometry.
_TYPES: dict[str, dict[str, tuple[str, tuple[str, ...]]]] = {
    "geometry_msgs/msg/PoseStamped": {
        "position": ("pose.position", _AXES),
        "quaternion": ("pose.orientation", (*_AXES, "w")),
    },
    "geometry_msgs/msg/TransformStamped": {
        "position": ("transform.translation", _AXES),
        "quaternion": ("transform.rotation", (*_AXES, "w")),
    },
    "nav_msgs/msg/Odometry": {
        "position": ("pose.pose.position", _AXES),
        "quaternion": ("pose.pose.orientation", (*_AXES, "w")),
        "velocity_body": ("twist.twist.linear", _AXES),  # its twist is in the frame of the child: the body
        "angular_velocity": ("twist.twist.angular", _AXES),
    },
    "sensor_msgs/msg/Imu": {
        "angular_velocity": ("angular_velocity", _AXES),
        "acceleration": ("linear_acceleration", _AXES),
    },
    "sensor_msgs/msg/BatteryState": {"battery_voltage": ("voltage", ())},
    "mav_msgs/msg/Actuators": {"motor_command": ("normalized", ("[0]", "[1]", "[2]", "[3]"))},
    "actuator_msgs/msg/Actuators": {"motor_command": ("normalized", ("[0]", "[1]", "[2]", "[3]"))},
}
_PREFERRED = {"angular_velocity": "sensor_msgs/msg/Imu"}


def read_bag(path: Path, columns: str | Layout | Mapping[str, object] | None) -> tuple[list[Stream], Layout, list[str]]:
    """A stream for each topic that the layout names: columns ``/topic.field.part[0]``.

    The time of a message is its header's stamp; without one, when the bag received it. By default topics are found by
    their types, in the convention of ROS (z up, body FLU, x y z w) with motors in our order.

    Raises:
        UnreadableLog: the bag is broken, or rosbags is not installed.
        MissingColumns: it lacks a topic or field that was asked for, or several topics could be meant.
    """
    try:
        import rosbags.typesys  # noqa: F401
    except ModuleNotFoundError as error:
        raise UnreadableLog("A ROS bag needs rosbags. Write: pip install '.[logs]' in a clone.") from error
    bag = BagFile(path)
    connections, begin = _connections(bag)
    topics = {topic: connection.kind for topic, connection in connections.items()}
    layout = _layout(topics, columns, path.name)
    asked: dict[str, list[str]] = {}
    for column in sorted({column for choices in layout.columns.values() for c in choices for column in c.names}):
        asked.setdefault(column.split(".")[0], []).append(column)
    missing = sorted(asked.keys() - topics.keys())
    if missing:
        raise MissingColumns(f"{path.name} has no topic {', '.join(missing)}. {_there(topics)}")
    notes: list[str] = []
    try:
        streams = _streams(bag, {topic: connections[topic] for topic in asked}, asked, begin, notes)
    except Damaged as error:
        raise UnreadableLog(f"{path.name} is no readable ROS bag: {error}. Record or copy it again.") from error
    if bag.unread:
        notes.append(f"the last {bag.unread} bytes of the bag were not read: it is cut off, or damaged")
    return streams, layout, notes


def _connections(bag: BagFile) -> tuple[dict[str, Connection], int]:
    """The topics that have messages, and when the first of all messages was received [ns]."""
    found: dict[str, Connection] = {}
    begin: int | None = None
    for connection, received, _ in bag.messages():
        other = found.setdefault(connection.topic, connection)
        if other.kind != connection.kind:
            raise UnreadableLog(
                f"{bag.name}: {connection.topic} has messages of two kinds, {other.kind} and {connection.kind}. Filter "
                "one of them out."
            )
        begin = received if begin is None else min(begin, received)
    if begin is None:
        raise UnreadableLog(f"{bag.name} is no readable ROS bag: it holds no messages. Record or copy it again.")
    return found, begin


def _layout(topics: Mapping[str, str], columns: str | Layout | Mapping[str, object] | None, name: str) -> Layout:
    if columns is not None and not isinstance(columns, Mapping):
        return choose(columns, None)
    given = columns or {}
    candidates: dict[str, list[str]] = {}
    for message in _TYPES:
        for topic in sorted(topic for topic, kind in topics.items() if kind == message):
            for quantity in _TYPES[message]:
                candidates.setdefault(quantity, []).append(topic)
    if "position" in given or "quaternion" in given:  # whoever names one of the pose means that topic alone
        for quantity in ("position", "quaternion", "velocity_body"):
            candidates.pop(quantity, None)
    if "velocity" in given:
        candidates.pop("velocity_body", None)
    found = {}
    for quantity, choices in candidates.items():
        if quantity in given:
            continue
        best = [t for t in choices if topics[t] == _PREFERRED.get(quantity)] or choices
        best = [t for t in best if topics[t] == topics[best[0]]]
        if len(best) > 1:
            raise MissingColumns(
                f"{name} has several topics for {quantity}: {', '.join(best)}. Say which: "
                f'columns={{"{quantity}": [{", ".join(_columns(best[0], topics[best[0]], quantity)[:2])}, ...]}}.'
            )
        found[quantity] = _columns(best[0], topics[best[0]], quantity)
    if not found and not given:
        raise MissingColumns(f"{name} has no topic of a known type. {_there(topics)}")
    onboard = BY_IMU
    if found.get("angular_velocity") and topics[found["angular_velocity"][0].split(".")[0]] == "nav_msgs/msg/Odometry":
        onboard = tuple(field for field in BY_IMU if field != "angular_velocity")
    default = Layout({quantity: (Columns(tuple(names)),) for quantity, names in found.items()}, ROS, onboard)
    return choose(given, default)


def _columns(topic: str, message: str, quantity: str) -> list[str]:
    stem, parts = _TYPES[message][quantity]
    return [f"{topic}.{stem}{part if part.startswith('[') else f'.{part}'}" for part in parts] or [f"{topic}.{stem}"]


def _streams(
    bag: BagFile, connections: Mapping[str, Connection], asked: Mapping[str, list[str]], begin: int, notes: list[str]
) -> list[Stream]:
    parts = {topic: [name.partition(".")[2] for name in names] for topic, names in asked.items()}
    decoders = {topic: Decoder(connections[topic], parts[topic]) for topic in asked}
    times: dict[str, array] = {
        topic: array("d") for topic in asked
    }  # since the bag began: a float of seconds since 1970
    rows: dict[str, array] = {topic: array("d") for topic in asked}  # keeps only a fraction of the nanoseconds
    for connection, received, raw in bag.messages():
        topic = connection.topic
        if topic not in asked:
            continue
        found = decoders[topic].read(raw)
        lacking = [part for part in parts[topic] if part not in found]
        if lacking:
            raise MissingColumns(
                f"{topic} lacks a field of {', '.join(asked[topic])}: {', '.join(lacking)} is no number in it. Its "
                f"messages have: {', '.join(decoders[topic].fields)}."
            )
        seconds, rest = (int(found.get(part, 0)) for part in STAMP)
        if not times[topic] and seconds <= 0:
            notes.append(f"messages of {topic} carry no stamp: their times are when the bag received them")
        times[topic].append(((seconds * 10**9 + rest if seconds > 0 else received) - begin) * 1e-9)
        rows[topic].extend([found[part] for part in parts[topic]])
    streams = []
    for topic, names in asked.items():
        table = np.frombuffer(rows[topic]).reshape(-1, len(names))
        streams.append(Stream(topic, np.frombuffer(times[topic]), dict(zip(names, table.T, strict=True))))
    return streams


def _there(topics: Mapping[str, str]) -> str:
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "none"
    return f'Name columns as columns={{"position": ["/topic.field.x", ...]}}. There are: {listed}.'
