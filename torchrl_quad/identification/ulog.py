"""The log of a PX4 autopilot.

Format (https://docs.px4.io/main/en/dev_log/ulog_file_format.html), little-endian: 16 bytes of header; then messages:
size (16 bits), type (a letter) and body. Definitions come first: F says which fields a message has, as in
"name:float[3] x;uint8_t y;", where a type may be another message; P is a parameter. In the data, A subscribes a message
by a number, D is one sample of it, O a dropout, and S eight bytes by which a reader finds its way back after damage.
"""

from __future__ import annotations

import itertools
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from torchrl_quad.deploy.frames import motor_signal
from torchrl_quad.identification.errors import UnreadableLog
from torchrl_quad.identification.streams import Stream

MAX_COLUMNS, MAX_MESSAGES = 100_000, 20 * 10**6  # columns of all kinds of messages together
_MAGIC = b"ULog\x01\x12\x35"
_SYNC = bytes.fromhex("2f731320250cbb12")
_KINDS = frozenset(b"BFIMPQARDLCSO")
_TYPES = {f"{sign}int{8 * size}_t": f"<{sign[:1] or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)}
_TYPES |= {"float": "<f4", "double": "<f8", "bool": "<i1", "char": "<i1"}


class _Damaged(Exception):
    """A message that makes no sense."""


@dataclass
class _Subscription:
    """A message that is logged, and where in the file its samples are."""

    name: str
    instance: int
    size: int  # of a sample [bytes]
    columns: int
    starts: array = field(default_factory=lambda: array("Q"))


@dataclass
class _Log:
    """What a file says before it is looked at by name."""

    formats: dict[str, list[tuple[str, int, str]]] = field(default_factory=dict)  # type, length (0: no array), field
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)  # bytes and columns
    subscriptions: list[_Subscription] = field(default_factory=list)
    current: dict[int, _Subscription] = field(default_factory=dict)
    curve: float = 0.0
    dropouts: list[int] = field(default_factory=list)  # [ms]
    ends: list[int] = field(default_factory=list)  # where the autopilot appended after a crash
    damage: int = 0
    unread: int = 0


def read_ulog(data: bytes, name: str) -> tuple[list[Stream], list[str]]:
    """A stream for each message: columns ``message.field``, or ``message#1.field`` of its second instance.

    Where a message says when its data were sampled, that is its time. A motor that is stopped has the command 0.
    ``actuator_motors.signal`` is what leaves for the motors: PX4 undoes the thrust curve of THR_MDL_FAC after it has
    logged ``actuator_motors.control`` (``FunctionMotors.hpp``). The file is read once, in time and memory proportional
    to its size; what makes no sense is left out, and the notes say so.

    Raises:
        UnreadableLog: no message of the file can be read, or it has too many of them, or of columns.
    """
    log = _scan(data, name)
    notes = []
    if log.damage or log.unread:
        notes.append(f"the ULog is damaged: {log.damage} messages and {log.unread} bytes were not read")
    if log.dropouts:
        lost = sum(log.dropouts) / 1000.0
        notes.append(f"the logger lost {lost:.2f} s in {len(log.dropouts)} dropouts: gaps where samples are missing")
    streams, every = [], np.frombuffer(data, np.uint8)
    for message in sorted((s for s in log.subscriptions if s.starts), key=lambda s: (s.name, s.instance)):
        fields = dict(itertools.islice(_columns(log, message.name), message.columns))
        if len(fields) < message.columns or fields.get("timestamp", "")[1:2] not in ("i", "u"):
            notes.append(f"{message.name} was left out: it has no timestamp, or two fields of one name")
            continue
        rows = sliding_window_view(every, message.size)[np.frombuffer(message.starts, np.uint64)]
        rows = rows.view(np.dtype(list(fields.items())))[:, 0]
        stem = message.name + (f"#{message.instance}" if message.instance else "")
        columns = {f"{stem}.{part}": rows[part] for part in fields}
        sampled = columns.get(f"{stem}.timestamp_sample")
        time = columns[f"{stem}.timestamp"] if sampled is None or not sampled.all() else sampled
        if message.name == "actuator_motors":
            for k in range(4):
                control = columns.get(f"{stem}.control[{k}]")
                if control is not None:
                    with np.errstate(invalid="ignore", over="ignore"):  # NaN of some patterns warn
                        thrust = np.nan_to_num(control.astype(float))
                        columns[f"{stem}.signal[{k}]"] = motor_signal(thrust, log.curve)
        streams.append(Stream(stem, time * 1e-6, columns))
    if "actuator_motors" not in {stream.name for stream in streams}:
        notes.append("no actuator_motors: motor commands are actuator_outputs, taken as 1000 to 2000 us")
    elif log.curve:
        notes.append(f"motor commands are what is left after the thrust curve of THR_MDL_FAC = {log.curve:g}")
    return streams, notes


def _scan(data: bytes, name: str) -> _Log:
    """Every message once, from the first byte to the last."""
    log, at, flying = _Log(), 16, False
    for count in itertools.count():
        if count > MAX_MESSAGES:
            raise UnreadableLog(f"{name} has more than {MAX_MESSAGES:,} messages; that is the most. Log fewer.")
        end = next((end for end in log.ends if end > at), len(data))
        if at + 3 > end:
            if end == len(data):
                break
            at = end
            continue
        size, kind = data[at] | data[at + 1] << 8, data[at + 2]
        stop = at + 3 + size
        good = stop <= end and kind in _KINDS
        flying = flying or (good and kind in b"ALC")
        try:
            if good:
                _take(log, kind, data, at + 3, stop, flying)
        except (_Damaged, ValueError, IndexError, struct.error):
            good = False
        if not good:
            log.damage += 1
            if stop > end or (stop + 2 < end and data[stop + 2] not in _KINDS):  # its size is wrong, too
                found = data.find(_SYNC, at + 1, end)
                if found < 0:
                    log.unread += end - at
                stop = end if found < 0 else found + len(_SYNC)
        at = stop
    log.unread += len(data) - at
    columns = sum(s.columns for s in log.subscriptions if s.starts)
    if columns > MAX_COLUMNS:
        raise UnreadableLog(f"{name} has {columns:,} columns; the most is {MAX_COLUMNS:,}. Log fewer messages.")
    if not any(s.starts for s in log.subscriptions):
        raise UnreadableLog(f"{name} is no readable ULog: it holds no sample of any message. Copy it again.")
    return log


def _take(log: _Log, kind: int, data: bytes, start: int, stop: int, flying: bool) -> None:
    """Read one message."""
    if kind == ord("D"):
        subscription = log.current.get(data[start] | data[start + 1] << 8) if stop - start > 1 else None
        if subscription is None or subscription.size != stop - start - 2:
            raise _Damaged
        subscription.starts.append(start + 2)
    elif kind == ord("A"):
        instance, number = struct.unpack_from("<BH", data, start)
        message = data[start + 3 : stop].decode(errors="ignore")
        size, columns = _measure(log, message)
        for part, length, name in reversed(log.formats[message]):
            if not name.startswith("_padding") or part not in _TYPES:
                break
            size, columns = size - (length or 1) * int(_TYPES[part][2]), columns - (length or 1)  # it is not logged
        before = log.current.get(number)
        if before is None or (before.name, before.instance) != (message, instance):
            log.current[number] = _Subscription(message, instance, size, columns)
            log.subscriptions.append(log.current[number])
    elif kind == ord("F") and not flying:
        message, _, fields = data[start:stop].decode(errors="ignore").partition(":")
        log.formats[message] = [_field(text) for text in fields.split(";") if text]
    elif kind == ord("P") and not flying:
        key = data[start + 1 : start + 1 + data[start]]
        if key == b"float THR_MDL_FAC":
            (log.curve,) = struct.unpack("<f", data[start + 1 + data[start] : stop])
            if not 0.0 <= log.curve <= 1.0:
                log.curve = 0.0
                raise _Damaged
    elif kind == ord("B"):
        flags, *offsets = struct.unpack_from("<8xB7x3Q", data, start)
        log.ends = sorted(offset for offset in offsets if flags & 1 and start < offset < len(data))
    elif kind == ord("O"):
        log.dropouts += struct.unpack("<H", data[start:stop])


def _field(text: str) -> tuple[str, int, str]:
    kind, name = text.split()
    kind, bracket, length = kind.partition("[")
    return kind, int(length.removesuffix("]")) if bracket else 0, name


def _measure(log: _Log, message: str, depth: int = 0) -> tuple[int, int]:
    """The bytes and the columns of a message, with those of the messages in it, from its formats alone.

    Raises:
        _Damaged: a type is unknown, empty, or in itself.
    """
    if message not in log.sizes:
        log.sizes[message] = (0, 0)  # while it is looked at, and if it makes no sense
        size = columns = 0
        for kind, length, _ in log.formats.get(message, ()):
            own = (
                (int(_TYPES[kind][2]), 1) if kind in _TYPES else (0, 0) if depth > 9 else _measure(log, kind, depth + 1)
            )
            if not own[0]:
                raise _Damaged
            size, columns = size + (length or 1) * own[0], columns + (length or 1) * own[1]
        log.sizes[message] = (size, columns)
    if not log.sizes[message][0]:
        raise _Damaged
    return log.sizes[message]


def _columns(log: _Log, message: str, prefix: str = "") -> Iterator[tuple[str, str]]:
    """The name and the type of each column of a message."""
    for kind, length, name in log.formats[message]:
        for k in range(length or 1):
            place = f"{prefix}{name}{f'[{k}]' if length else ''}"
            if kind in _TYPES:
                yield place, _TYPES[kind]
            else:
                yield from _columns(log, kind, f"{place}.")
