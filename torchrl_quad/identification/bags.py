"""ROS bags: ROS 1 files, and ROS 2 folders or files."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.identification.errors import MissingColumns, UnreadableLog
from torchrl_quad.identification.layouts import BY_IMU, ROS, Columns, Layout, choose
from torchrl_quad.identification.streams import Stream

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
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise UnreadableLog("A ROS bag needs rosbags. Write: pip install '.[logs]' in a clone.") from error
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            topics = {topic: info.msgtype or "" for topic, info in reader.topics.items() if info.msgcount}
            layout = _layout(topics, columns, path.name)
            asked = {column for choices in layout.columns.values() for c in choices for column in c.names}
            missing = sorted({column.split(".")[0] for column in asked} - topics.keys())
            if missing:
                raise MissingColumns(f"{path.name} has no topic {', '.join(missing)}. {_there(topics)}")
            notes: list[str] = []
            streams = [_stream(reader, topic, asked, notes) for topic in {column.split(".")[0] for column in asked}]
    except (MissingColumns, UnreadableLog):
        raise
    except Exception as error:  # rosbags raises whatever its parsers meet in a broken file
        raise UnreadableLog(f"{path.name} is no readable ROS bag: {error}. Record or copy it again.") from error
    return streams, layout, notes


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


def _stream(reader: Any, topic: str, asked: set[str], notes: list[str]) -> Stream:
    names = sorted(column for column in asked if column.split(".")[0] == topic)
    getters = [_getter(name.split(".", 1)[1] if "." in name else "") for name in names]
    begin = reader.start_time  # whole nanoseconds: a float of seconds since 1970 keeps only a fraction of them
    times, rows = [], []
    for connection, received, raw in reader.messages([c for c in reader.connections if c.topic == topic]):
        message = reader.deserialize(raw, connection.msgtype)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        stamped = stamp is not None and stamp.sec > 0
        times.append(((stamp.sec * 10**9 + stamp.nanosec if stamped else received) - begin) * 1e-9)
        try:
            rows.append([get(message) for get in getters])
        except (AttributeError, IndexError) as error:
            fields = [f for f in dir(message) if not f.startswith("_")]
            raise MissingColumns(
                f"{topic} lacks a field of {', '.join(names)}: {error}. Its messages have: {', '.join(fields)}."
            ) from error
        if len(times) == 1 and not stamped:
            notes.append(f"messages of {topic} carry no stamp: their times are when the bag received them")
    table = np.array(rows, float).reshape(len(times), len(names))
    return Stream(topic, np.array(times), dict(zip(names, table.T, strict=True)))


def _getter(path: str) -> Callable[[Any], float]:
    """What reads ``field.part[0]`` from a message."""
    found = re.fullmatch(r"(.+?)\[(\d+)\]", path)
    if found is None:
        return attrgetter(path)
    get, index = attrgetter(found[1]), int(found[2])
    return lambda message: get(message)[index]


def _there(topics: Mapping[str, str]) -> str:
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "none"
    return f'Name columns as columns={{"position": ["/topic.field.x", ...]}}. There are: {listed}.'
