"""ROS bags: which topics are which quantity, and the numbers in their messages, which rosbags reads."""

from __future__ import annotations

import dataclasses
import itertools
import re
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.errors import UserError, needing, one_line
from torchrl_quad.identification import layouts
from torchrl_quad.identification.errors import MissingColumns, UnreadableLog, WrongMotors
from torchrl_quad.identification.layouts import Asked, Columns, Layout
from torchrl_quad.identification.signals import Array, Stream, open_plain

LIKELY = ("pose", "odometry", "imu", "motors", "actuators", "battery")
MAGIC = (b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\0")


def read_bag(path: Path, columns: Asked) -> tuple[list[Stream], Layout, list[str]]:
    """A stream for each topic that the layout names: columns ``/topic.field.part[0]``.

    The times of a topic are its headers' stamps; where they stand still or fall to zero, when the bag received it, on
    the clock of other stamps. By default topics are found by their types, in the convention of ROS (z up, body FLU,
    x y z w) with motors in our order.
    """
    with needing("A ROS bag needs rosbags. Write: pip install '.[logs]' in a clone.", UnreadableLog):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    for part in [x for x in path.iterdir() if not x.is_dir()] if path.is_dir() else [path]:
        open_plain(part).close()
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            return _read(bag, path.name, columns)
    except UserError:
        raise
    except Exception as error:  # rosbags raises whatever its parsers meet
        if kind := re.fullmatch(r"'?(\w+/msg/\w+)'?", str(error)):
            raise UnreadableLog(
                f"{path.name} does not define its messages {kind[1]}, as bags of ROS 2 before Iron do not. Where "
                "they are installed, convert it to MCAP, which does: ros2 bag convert."
            ) from error
        raise UnreadableLog(
            f"{path.name} is not a readable ROS bag: {one_line(error) or type(error).__name__}. Copy it again, or mend "
            "it: rosbag reindex for ROS 1, mcap recover, or ros2 bag reindex."
        ) from error


def _read(bag: Any, name: str, columns: Asked) -> tuple[list[Stream], Layout, list[str]]:
    topics = {connection.topic: connection.msgtype for connection in bag.connections if connection.msgcount}
    layout = _layout(bag, topics, columns, name)
    for quantities in layouts.NEEDED:
        if not layout.columns.keys() & set(quantities):
            raise MissingColumns(f"{name} has no {' or '.join(quantities)}. {_there(topics)}")
    asked: dict[str, list[str]] = {}
    for column in sorted(layout.names):
        asked.setdefault(column.split(".")[0], []).append(column)
    places = {column: re.findall(r"[^.\[\]]+", column.partition(".")[2]) for column in layout.names}
    missing = sorted(asked.keys() - topics.keys())
    if missing:
        raise MissingColumns(f"{name} has no topic {', '.join(missing)}. {_there(topics, missing)}")
    # Times since the bag began: a float of seconds since 1970 keeps only a fraction of the nanoseconds.
    begin = bag.start_time
    received, stamped, rows = ({topic: array("d") for topic in asked} for _ in range(3))
    for connection, at, raw in bag.messages([x for x in bag.connections if x.topic in asked]):
        topic = connection.topic
        message = bag.deserialize(raw, connection.msgtype)
        try:
            rows[topic].extend([_number(message, places[column]) for column in asked[topic]])
        except (AttributeError, IndexError, TypeError, ValueError) as error:
            fields = ", ".join(field.name for field in dataclasses.fields(message))
            said = f"{topic} lacks a field of {', '.join(asked[topic])}, or it is not a number: {error}."
            raise MissingColumns(f"{said} Its messages have: {fields}.") from error
        received[topic].append((at - begin) * 1e-9)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        stamped[topic].append((stamp.sec * 10**9 + stamp.nanosec - begin) * 1e-9 if stamp else -begin * 1e-9)
    streams, notes = [], []
    times = {topic: np.frombuffer(x) for topic, x in stamped.items() if _is_clock(np.frombuffer(x), -begin * 1e-9)}
    # Simulated stamps and the wall clock may be far apart: what has no stamps comes to the clock of those that have.
    apart = float(np.median([np.median(np.frombuffer(received[topic]) - x) for topic, x in times.items()] or [0.0]))
    for topic, names in asked.items():
        if topic not in times:
            notes.append(f"messages of {topic} carry no stamp: their times are when the bag received them")
            times[topic] = np.frombuffer(received[topic]) - (apart if abs(apart) > 1.0 else 0.0)
        table = np.frombuffer(rows[topic]).reshape(-1, len(names))
        streams.append(Stream(topic, times[topic], dict(zip(names, table.T, strict=True))))
    return streams, layout, notes


def _is_clock(stamps: Array, zero: float) -> bool:
    """Whether stamps, which say ``zero`` where none was set, are those of a clock: it may begin at zero."""
    return len(stamps) > 1 and bool((stamps[1:] > zero).all()) and stamps.max() > stamps.min()


def _number(message: Any, place: Sequence[str]) -> float:
    """What lies at a place of a message, such as pose, position, x, or normalized, 0."""
    for part in place:
        message = message[int(part)] if part.isdecimal() else getattr(message, part)
    return float(message)


_ASKED_FOR = re.compile("command|setpoint|target|goal|reference|desired")  # in topics of where a drone shall be


def _layout(bag: Any, topics: Mapping[str, str], columns: Asked, name: str) -> Layout:
    if columns is not None and not isinstance(columns, Mapping):
        return layouts.choose(columns, None)
    given = columns or {}
    named, pose = set(given), {"position", "quaternion", "velocity_body"}
    places = [name for x in {"position", "quaternion"} & named for name in _names(given[x])]
    of = {topic for topic in topics if any(place.startswith(f"{topic}.") for place in places)}
    if places and not of:
        named |= pose
    rivals = {second: first for first, second in layouts.RIVALS}
    found, onboard = {}, layouts.BY_IMU
    kinds = layouts.shipped("ros_messages.yaml").items()
    for asked_for, (kind, quantities) in itertools.product((False, True), kinds):  # what a drone shall do is read last
        likely = [x for x in sorted(topics) if x in of or bool(_ASKED_FOR.search(x.lower())) == asked_for]
        for quantity, fields in quantities.items():
            own, rival = [x for x in likely if topics[x] == kind], rivals.get(quantity)
            if of and quantity in pose:  # the caller means the pose of that topic only
                own = [topic for topic in own if topic in of]
            if kind.endswith("/Actuators"):  # whose messages hold commands, or speeds
                own = [topic for topic in own if _length(bag, topic, fields["of"], name)]
            if not own or {quantity, rival} & named or quantity in found or (rival in found and rival != "velocity"):
                continue
            choice = layouts.named_alike(**fields | {"of": f"{own[0]}.{fields.get('of', '')}"})
            if len(own) > 1:
                raise MissingColumns(
                    f"{name} has several topics for {quantity}: {', '.join(own)}. Say which: "
                    f'columns={{"{quantity}": {list(choice.names)}}}, or those of another.'
                )
            if quantity == "angular_velocity" and kind == "nav_msgs/msg/Odometry":  # whose clock is that of its pose
                onboard = tuple(field for field in layouts.BY_IMU if field != quantity)
            found[quantity] = (choice,)
    if not found and not given:
        raise MissingColumns(f"{name} has no topic of a known type. {_there(topics)}")
    return layouts.choose(given, Layout(found, layouts.ROS, onboard))


def _names(columns: Any) -> list[str]:
    """The columns that a caller names for a quantity."""
    names = columns.names if isinstance(columns, Columns) else columns
    return [names] if isinstance(names, str) else [str(name) for name in names or ()]


def _length(bag: Any, topic: str, field: str, name: str) -> int:
    """How many motors the array of the first message has; more than four are refused."""
    connections = [x for x in bag.connections if x.topic == topic]
    first = next((bag.deserialize(raw, x.msgtype) for x, _, raw in bag.messages(connections)), None)
    count = len(getattr(first, field, ()))
    if count > 4:
        raise WrongMotors(f"{name}: {topic} drives {count} motors. Only drones with four rotors are fitted.")
    return count


def _there(topics: Mapping[str, str], asked: Sequence[str] = ()) -> str:
    there = layouts.listed([f"{topic} ({kind})" for topic, kind in topics.items()], [*asked, *LIKELY])
    return f'Name columns as columns={{"position": ["/topic.field.x", ...]}}. There are{there}.'
