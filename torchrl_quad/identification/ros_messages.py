"""Numbers of ROS messages, by the definition of their kind: ROS 1's serialisation, and CDR of ROS 2."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_quad.errors import shown
from torchrl_quad.identification.ros_files import Connection

MAX_DEFINITION = 100_000  # characters
_NUMBERS = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
STAMP = ("header.stamp.sec", "header.stamp.nanosec")


class Damaged(Exception):
    """A message, or the definition of one, that makes no sense."""


class Decoder:
    """Reads some numbers of the messages of a connection: ``pose.position.x``, ``normalized[0]``."""

    def __init__(self, connection: Connection, wanted: Sequence[str]) -> None:
        self.definitions = definitions_of(connection)
        self.kind, self.is_cdr = connection.kind, connection.is_cdr
        self.wanted = {*wanted, *STAMP}
        self.above = {path[:k] for path in self.wanted for k, letter in enumerate(path) if letter in ".["}

    @property
    def fields(self) -> list[str]:
        """The fields of the messages."""
        return [name for name, _ in self.definitions[self.kind]]

    def read(self, raw: bytes) -> dict[str, float]:
        """The wanted numbers that a message has, and its stamp.

        Raises:
            Damaged: its bytes do not fit the definition.
        """
        self.found: dict[str, float] = {}
        self.raw, self.order = raw, "<"
        if self.is_cdr:
            if raw[:1] != b"\0" or raw[1:2] not in (b"\0", b"\1"):
                raise Damaged("an unknown encapsulation")
            self.raw, self.order = raw[4:], "<" if raw[1] else ">"
        self.steps = len(self.raw) + 1000  # each step reads a byte or more, but those of empty messages
        try:
            end = self._message(self.kind, "", 0, 0)
        except struct.error as error:
            raise Damaged("it is too short") from error
        if end > len(self.raw):
            raise Damaged("it is too short")
        return self.found

    def _message(self, kind: str, path: str | None, at: int, depth: int) -> int:
        if depth > 20 or kind not in self.definitions:
            raise Damaged(f"{kind} has no definition")
        for name, what in self.definitions[kind]:
            place = None if path is None else f"{path}.{name}" if path else name
            at = self._value(what, place if place in self.above or place in self.wanted else None, at, depth)
        return at

    def _value(self, what: tuple[Any, Any], path: str | None, at: int, depth: int) -> int:
        """Read what is wanted of a value, and say where the next begins."""
        self.steps -= 1
        if self.steps < 0 or at > len(self.raw):
            raise Damaged("it is too short")
        node, about = what[0].name, what[1]
        if node == "NAME":
            return self._message(about, path, at, depth + 1)
        if node == "BASE":
            name = about[0]
            if name == "string":
                at, size = self._number("uint32", at)
                return at + int(size)
            if name not in _NUMBERS:
                raise Damaged(f"values of the type {name} are not known")
            after, value = self._number(name, at)
            if path in self.wanted:
                self.found[path] = value
            return after
        inner, count = about if node == "ARRAY" else (about[0], 0)
        if node == "SEQUENCE":
            at, count = self._number("uint32", at)
        if inner[0].name == "BASE" and inner[1][0] in _NUMBERS:
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
        at += -at % size if self.is_cdr else 0
        return at + size, struct.unpack_from(self.order + form, self.raw, at)[0]


def definitions_of(connection: Connection) -> Mapping[str, list[tuple[str, tuple[Any, Any]]]]:
    """The fields of the kind of a connection, and of those in it, by name: its own definition's, or the usual ones.

    Raises:
        Damaged: the definition cannot be read, or there is none.
    """
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    found = {name: fields for name, (_, fields) in get_typestore(Stores.LATEST).fielddefs.items()}
    if len(connection.definition) > MAX_DEFINITION:
        raise Damaged(f"the definition of {connection.kind} has more than {MAX_DEFINITION:,} characters")
    if connection.definition:
        try:
            if connection.language == "msg":
                own = get_types_from_msg(connection.definition, connection.kind)
            else:  # several files one after the other, each with its name
                own = {}
                for part in connection.definition.split("=" * 80 + "\n"):
                    text = part.partition("\n")[2] if part.startswith("IDL: ") else part
                    own |= get_types_from_idl(text) if text.strip() else {}
        except Exception as error:  # rosbags raises whatever its parser meets
            raise Damaged(f"the definition of {connection.kind} is broken: {shown(str(error))}") from error
        found |= {name: fields for name, (_, fields) in own.items()}
    if connection.kind not in found:
        raise Damaged(f"{connection.kind} has no definition")
    return found
