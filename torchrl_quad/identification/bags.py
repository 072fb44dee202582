"""ROS bags: which topics are which quantity, and the numbers in their messages by the definitions of their types."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.errors import shown
from torchrl_quad.identification.bag_files import MAGIC, BagFile, Connection
from torchrl_quad.identification.errors import MissingColumns, UnreadableLog
from torchrl_quad.identification.layouts import BY_IMU, ROS, Columns, Layout, choose
from torchrl_quad.identification.signals import Stream

__all__ = ["MAGIC", "read_bag"]

MAX_DEFINITION = 100_000  # characters
# What the messages of a type hold; the first type counts. Motion capture often sends odometry as well as poses.
_TYPES: dict[str, dict[str, tuple[str, str]]] = {
    "geometry_msgs/msg/PoseStamped": {
        "position": ("pose.position", ".x .y .z"),
        "quaternion": ("pose.orientation", ".x .y .z .w"),
    },
    "geometry_msgs/msg/TransformStamped": {
        "position": ("transform.translation", ".x .y .z"),
        "quaternion": ("transform.rotation", ".x .y .z .w"),
    },
    "sensor_msgs/msg/Imu": {
        "angular_velocity": ("angular_velocity", ".x .y .z"),
        "acceleration": ("linear_acceleration", ".x .y .z"),
    },
    "nav_msgs/msg/Odometry": {
        "position": ("pose.pose.position", ".x .y .z"),
        "quaternion": ("pose.pose.orientation", ".x .y .z .w"),
        "velocity_body": ("twist.twist.linear", ".x .y .z"),  # its twist is in the frame of the child: the body
        "angular_velocity": ("twist.twist.angular", ".x .y .z"),
    },
    "sensor_msgs/msg/BatteryState": {"battery_voltage": ("voltage", "")},
    "mav_msgs/msg/Actuators": {"motor_command": ("normalized", "[0] [1] [2] [3]")},
    "actuator_msgs/msg/Actuators": {"motor_command": ("normalized", "[0] [1] [2] [3]")},
}
_NUMBERS = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_STAMP = ("header.stamp.sec", "header.stamp.nanosec")


def read_bag(path: Path, columns: str | Layout | Mapping[str, object] | None) -> tuple[list[Stream], Layout, list[str]]:
    """A stream for each topic that the layout names: columns ``/topic.field.part[0]``.

    The time of a message is its header's stamp; without one, when the bag received it. By default topics are found by
    their types, in the convention of ROS (z up, body FLU, x y z w) with motors in our order.
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
    for column in sorted(layout.names):
        asked.setdefault(column.split(".")[0], []).append(column)
    missing = sorted(asked.keys() - topics.keys())
    if missing:
        raise MissingColumns(f"{path.name} has no topic {', '.join(missing)}. {_there(topics)}")
    notes: list[str] = []
    try:
        streams = _streams(bag, connections, asked, begin, notes)
    except _Damaged as error:
        raise bag.broken(error) from error
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
        raise bag.broken("it holds no messages")
    return found, begin


def _layout(topics: Mapping[str, str], columns: str | Layout | Mapping[str, object] | None, name: str) -> Layout:
    if columns is not None and not isinstance(columns, Mapping):
        return choose(columns, None)
    given = columns or {}
    named = set(given)
    if named & {"position", "quaternion"}:  # the caller means the pose of that topic only
        named |= {"position", "quaternion", "velocity_body"}
    if "velocity" in named:
        named.add("velocity_body")
    found: dict[str, tuple[Columns, ...]] = {}
    onboard = BY_IMU
    for message, quantities in _TYPES.items():
        own = sorted(topic for topic, kind in topics.items() if kind == message)
        for quantity, (stem, parts) in quantities.items():
            if not own or quantity in named or quantity in found:
                continue
            names = tuple(f"{own[0]}.{stem}{part}" for part in parts.split(" "))
            if len(own) > 1:
                raise MissingColumns(
                    f"{name} has several topics for {quantity}: {', '.join(own)}. Say which: "
                    f'columns={{"{quantity}": [{", ".join(names[:2])}, ...]}}.'
                )
            if quantity == "angular_velocity" and message == "nav_msgs/msg/Odometry":  # whose clock is that of its pose
                onboard = tuple(field for field in BY_IMU if field != quantity)
            found[quantity] = (Columns(names),)
    if not found and not given:
        raise MissingColumns(f"{name} has no topic of a known type. {_there(topics)}")
    return choose(given, Layout(found, ROS, onboard))


def _there(topics: Mapping[str, str]) -> str:
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "none"
    return f'Name columns as columns={{"position": ["/topic.field.x", ...]}}. There are: {listed}.'


def _streams(
    bag: BagFile, connections: Mapping[str, Connection], asked: Mapping[str, list[str]], begin: int, notes: list[str]
) -> list[Stream]:
    parts = {topic: [name.partition(".")[2] for name in names] for topic, names in asked.items()}
    decoders = {topic: _Decoder(connections[topic], parts[topic]) for topic in asked}
    # Since the bag began: a float of seconds since 1970 keeps only a fraction of the nanoseconds.
    times: dict[str, array] = {topic: array("d") for topic in asked}
    rows: dict[str, array] = {topic: array("d") for topic in asked}
    for connection, received, raw in bag.messages():
        topic = connection.topic
        if topic not in asked:
            continue
        found = decoders[topic].read(raw)
        lacking = [part for part in parts[topic] if part not in found]
        if lacking:
            raise MissingColumns(
                f"{topic} lacks a field of {', '.join(asked[topic])}: {', '.join(lacking)} is not a number there. Its "
                f"messages have: {', '.join(decoders[topic].fields)}."
            )
        seconds, rest = (int(found.get(part, 0)) for part in _STAMP)
        if not times[topic] and seconds <= 0:
            notes.append(f"messages of {topic} carry no stamp: their times are when the bag received them")
        times[topic].append(((seconds * 10**9 + rest if seconds > 0 else received) - begin) * 1e-9)
        rows[topic].extend([found[part] for part in parts[topic]])
    streams = []
    for topic, names in asked.items():
        table = np.frombuffer(rows[topic]).reshape(-1, len(names))
        streams.append(Stream(topic, np.frombuffer(times[topic]), dict(zip(names, table.T, strict=True))))
    return streams


class _Damaged(Exception):
    """A message, or the definition of one, that cannot be read."""


class _Decoder:
    """Reads some numbers of the messages of a connection, ``pose.position.x`` or ``normalized[0]``, from the
    serialisation of ROS 1, or from CDR, that of ROS 2."""

    def __init__(self, connection: Connection, wanted: Sequence[str]) -> None:
        self.definitions = _definitions_of(connection)
        self.kind, self.is_cdr = connection.kind, connection.is_cdr
        self.wanted = {*wanted, *_STAMP}
        self.above = {path[:k] for path in self.wanted for k, letter in enumerate(path) if letter in ".["}
        self.fields = [name for name, _ in self.definitions[self.kind]]

    def read(self, raw: bytes) -> dict[str, float]:
        """The wanted numbers that a message has, and its stamp."""
        self.found: dict[str, float] = {}
        self.raw, self.order = raw, "<"
        if self.is_cdr:
            if raw[:1] != b"\0" or raw[1:2] not in (b"\0", b"\1"):
                raise _Damaged("an unknown encapsulation")
            self.raw, self.order = raw[4:], "<" if raw[1] else ">"
        self.steps = len(self.raw) + 1000  # each step reads a byte or more, but those of empty messages
        try:
            end = self._message(self.kind, "", 0, 0)
        except struct.error as error:
            raise _Damaged("it is too short") from error
        if end > len(self.raw):
            raise _Damaged("it is too short")
        return self.found

    def _message(self, kind: str, path: str | None, at: int, depth: int) -> int:
        if depth > 20 or kind not in self.definitions:
            raise _Damaged(f"{kind} has no definition")
        for name, what in self.definitions[kind]:
            place = None if path is None else f"{path}.{name}" if path else name
            at = self._value(what, place if place in self.above or place in self.wanted else None, at, depth)
        return at

    def _value(self, what: tuple[Any, Any], path: str | None, at: int, depth: int) -> int:
        """Read what is wanted of a value, and say where the next begins; of an unwanted one the path is None."""
        self.steps -= 1
        if self.steps < 0 or at > len(self.raw):
            raise _Damaged("it is too short")
        node, about = what[0].name, what[1]
        if node == "NAME":
            return self._message(about, path, at, depth + 1)
        if node == "BASE":
            name = about[0]
            if name == "string":
                at, size = self._number("uint32", at)
                return at + int(size)
            if name not in _NUMBERS:
                raise _Damaged(f"values of the type {name} are not known")
            after, value = self._number(name, at)
            if path in self.wanted:
                self.found[path] = value
            return after
        inner, count = about if node == "ARRAY" else (about[0], 0)
        if node == "SEQUENCE":
            at, count = self._number("uint32", at)
        if inner[0].name == "BASE" and inner[1][0] in _NUMBERS:  # only the wanted numbers of an array are looked at
            size = struct.calcsize(f"={_NUMBERS[inner[1][0]]}")
            at += -at % size if self.is_cdr and count else 0
            prefix = f"{path}["
            for place in self.wanted if path is not None else ():
                index = place.removeprefix(prefix).removesuffix("]")
                if place.startswith(prefix) and index.isdecimal() and int(index) < count:
                    _, self.found[place] = self._number(inner[1][0], at + int(index) * size)
            return at + int(count) * size
        for k in range(int(count)):
            at = self._value(inner, None if path is None else f"{path}[{k}]", at, depth + 1)
        return at

    def _number(self, name: str, at: int) -> tuple[int, float]:
        form = _NUMBERS[name]
        size = struct.calcsize(f"={form}")
        at += -at % size if self.is_cdr else 0  # CDR aligns numbers to their size
        return at + size, struct.unpack_from(self.order + form, self.raw, at)[0]


def _definitions_of(connection: Connection) -> dict[str, list[tuple[str, tuple[Any, Any]]]]:
    """The fields of the kind of a connection, and of those in it, by name: its own definition's, or the usual ones."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    found: dict[str, Any] = dict(get_typestore(Stores.LATEST).fielddefs)
    if len(connection.definition) > MAX_DEFINITION:
        raise _Damaged(f"the definition of {connection.kind} has more than {MAX_DEFINITION:,} characters")
    try:
        if connection.language == "msg" and connection.definition:
            found |= get_types_from_msg(connection.definition, connection.kind)
        elif connection.definition:  # several files one after the other, each with its name
            for part in connection.definition.split("=" * 80 + "\n"):
                text = part.partition("\n")[2] if part.startswith("IDL: ") else part
                found |= get_types_from_idl(text) if text.strip() else {}
    except Exception as error:  # rosbags raises whatever its parser meets
        raise _Damaged(f"the definition of {connection.kind} is broken: {shown(str(error))}") from error
    if connection.kind not in found:
        raise _Damaged(f"{connection.kind} has no definition")
    return {name: fields for name, (_, fields) in found.items()}
