"""PX4's ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format.html), and the log of a Crazyflie on its micro SD
card (``src/deck/drivers/src/usddeck.c`` of the firmware); both are little-endian."""

from __future__ import annotations

import itertools
import re
import struct
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from torchrl_quad.deploy.frames import motor_signal
from torchrl_quad.errors import shown
from torchrl_quad.identification.errors import UnreadableLog
from torchrl_quad.identification.signals import MAX_COLUMNS, Array, Stream

_SYNC = bytes.fromhex("2f731320250cbb12")
_KINDS = frozenset(b"BFIMPQARDLCSO")
_TYPES = {f"{sign}int{8 * size}_t": f"<{sign[:1] or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)}
_TYPES |= {"float": "<f4", "double": "<f8", "bool": "<i1", "char": "<i1"}
_FIELD = re.compile(r"([\w/-]+)(?:\[(\d+)\])? (\w+)")
_TICKS = {1: ("<u4", 1e-3), 2: ("<u8", 1e-6)}
_VARIABLE = re.compile(r"(.+)\(([bBhHiIqQfd?])\)")


@dataclass
class _Subscription:
    """A message that is logged, and where in the file its samples are."""

    name: str
    instance: int
    record: np.dtype
    starts: array = field(default_factory=lambda: array("Q"))


def read_ulog(data: bytes, name: str) -> tuple[list[Stream], list[str]]:
    """A stream for each message: columns ``message.field``, or ``message#1.field`` of its second instance.

    Where a message says when its data were sampled, that is its time. A motor that is stopped has the command 0.
    ``actuator_motors.signal`` is what leaves for the motors: PX4 undoes the thrust curve of THR_MDL_FAC after it has
    logged ``actuator_motors.control`` (``FunctionMotors.hpp``). The file is read once, in time and memory proportional
    to its size; the notes say what could not be read.
    """
    log = _Log(data)
    log.scan()
    used = sorted((s for s in log.subscriptions if s.starts), key=lambda s: (s.name, s.instance))
    if not used:
        raise UnreadableLog(f"{name} is not a readable ULog: it holds no sample of any message. Copy it again.")
    notes = []
    if log.damage or log.unread:
        notes.append(f"the ULog is damaged: {log.damage} messages and {log.unread} bytes were not read")
    if log.dropouts:
        lost = sum(log.dropouts) / 1000.0
        notes.append(f"the logger lost {lost:.2f} s in {len(log.dropouts)} dropouts: gaps where samples are missing")
    streams = []
    for message in used:
        parts = message.record.names or ()
        if "timestamp" not in parts or message.record["timestamp"].kind not in "iu":
            notes.append(f"{message.name} was left out: it has no timestamp")
            continue
        rows = pick(data, message.starts, message.record)
        stem = message.name + (f"#{message.instance}" if message.instance else "")
        columns = {f"{stem}.{part}": rows[part] for part in parts}
        sampled = columns.get(f"{stem}.timestamp_sample")
        time = columns[f"{stem}.timestamp"] if sampled is None or not sampled.all() else sampled
        for k in range(4 if message.name == "actuator_motors" else 0):
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


class _Log:
    """What a file says, before any message is looked up by its name."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.formats: dict[str, list[tuple[str, int, str]]] = {}  # type, length (0: no array), field
        self.room = MAX_COLUMNS  # for those of subscribed messages
        self.subscriptions: list[_Subscription] = []
        self.current: dict[int, _Subscription] = {}
        self.curve = 0.0
        self.dropouts: list[int] = []  # [ms]
        self.ends: list[int] = []  # where the autopilot appended after a crash
        self.damage = self.unread = 0
        self.flying = False  # whether the definitions are over

    def scan(self) -> None:
        """Take every message once, from the first byte to the last."""
        data, at = self.data, 16
        while at + 3 <= len(data):
            end = next((end for end in self.ends if end > at), len(data))
            if at + 3 > end:
                at = end
                continue
            size, kind = data[at] | data[at + 1] << 8, data[at + 2]
            stop = at + 3 + size
            good = stop <= end and kind in _KINDS
            self.flying = self.flying or (good and kind in b"ALC")
            try:
                if good:
                    self._take(kind, at + 3, stop)
            except (ValueError, IndexError, struct.error):
                good = False
            if not good:
                self.damage += 1
                if stop > end or (stop + 2 < end and data[stop + 2] not in _KINDS):  # its size is wrong, too
                    found = data.find(_SYNC, at + 1, end)
                    if found < 0:
                        self.unread += end - at
                    stop = end if found < 0 else found + len(_SYNC)
            at = stop
        self.unread += len(data) - at

    def _take(self, kind: int, start: int, stop: int) -> None:
        data = self.data
        if kind == ord("D"):
            subscription = self.current.get(data[start] | data[start + 1] << 8) if stop - start > 1 else None
            if subscription is None or subscription.record.itemsize != stop - start - 2:
                raise ValueError
            subscription.starts.append(start + 2)
        elif kind == ord("A"):
            instance, number = struct.unpack_from("<BH", data, start)
            message = data[start + 3 : stop].decode(errors="ignore")
            before = self.current.get(number)
            if before is None or (before.name, before.instance) != (message, instance):
                columns = list(itertools.islice(self._columns(message), self.room + 1))
                while columns and columns[-1][0].startswith("_padding"):  # which is not logged at the end
                    columns.pop()
                if len(columns) > self.room:
                    del self.formats[message]  # so that it is not unfolded again and again
                    raise ValueError
                self.current[number] = _Subscription(message, instance, np.dtype(columns))
                self.subscriptions.append(self.current[number])
                self.room -= len(columns)
        elif kind == ord("F") and not self.flying:
            message, _, fields = data[start:stop].decode(errors="ignore").partition(":")
            self.formats[message] = [(kind, int(length or 0), name) for kind, length, name in _FIELD.findall(fields)]
        elif kind == ord("P") and not self.flying:
            value = start + 1 + data[start]
            if data[start + 1 : value] == b"float THR_MDL_FAC":
                (self.curve,) = struct.unpack("<f", data[value:stop])
                if not 0.0 <= self.curve <= 1.0:
                    self.curve = 0.0
                    raise ValueError
        elif kind == ord("B"):
            flags, *offsets = struct.unpack_from("<8xB7x3Q", data, start)
            self.ends = sorted(offset for offset in offsets if flags & 1 and start < offset < len(data))
        elif kind == ord("O"):
            self.dropouts += struct.unpack("<H", data[start:stop])

    def _columns(self, message: str, prefix: str = "") -> Iterator[tuple[str, str]]:
        """The name and the type of each column of a message, with those of the messages in it."""
        if not self.formats.get(message) or prefix.count(".") > 9:
            raise ValueError
        for kind, length, name in self.formats[message]:
            for k in range(length or 1):
                place = f"{prefix}{name}{f'[{k}]' if length else ''}"
                if kind in _TYPES:
                    yield place, _TYPES[kind]
                else:
                    yield from self._columns(kind, f"{place}.")


def read_usd(data: bytes, name: str) -> tuple[list[Stream], list[str]]:
    """A stream for each kind of event."""
    notes = []
    body = data[:-4]
    if zlib.crc32(body) != int.from_bytes(data[-4:], "little"):
        # A card that is pulled out, or a battery that runs empty, leaves a file without its end.
        notes.append("the checksum of the uSD log does not match: the end of the file may be missing")
        body = data
    try:
        version, kinds = struct.unpack_from("<HH", body, 1)
        if version not in _TICKS:
            raise ValueError(f"version {version}, and 1 and 2 are known")
        tick, unit = _TICKS[version]
        records, names, at = {}, {}, 5
        for _ in range(kinds):
            (kind,) = struct.unpack_from("<H", body, at)
            names[kind], at = _text(body, at + 2)
            (count,) = struct.unpack_from("<H", body, at)
            at += 2
            fields: list[tuple[str, Any]] = [("id", "<u2"), ("tick", tick)]
            for _ in range(count):
                variable, at = _text(body, at)
                found = _VARIABLE.fullmatch(variable)
                if found is None:
                    raise ValueError(f"a variable of unknown type, {shown(variable)}")
                fields.append((found[1], np.dtype(found[2]).newbyteorder("<")))
            records[kind] = np.dtype(fields)
    except (struct.error, ValueError) as error:
        raise UnreadableLog(
            f"{name} begins like a uSD log, but its header cannot be read: {error}. Copy it again, or export it as CSV."
        ) from error
    starts, left = _events(body, at, {kind: record.itemsize for kind, record in records.items()})
    if left:
        notes.append(f"the last {left} bytes of the uSD log were not read: they are not whole events")
    streams = []
    for kind, record in records.items():
        rows = pick(body, starts[kind], record)
        with np.errstate(invalid="ignore"):  # NaN of some patterns warn
            values = {field: rows[field].astype(float) for field in record.names[2:]}
        if "stateEstimateZ.quat" in values and rows["stateEstimateZ.quat"].dtype.kind in "iu":
            q = decompress_quaternions(rows["stateEstimateZ.quat"])
            values |= {f"stateEstimateZ.q{axis}": q[:, k] for k, axis in enumerate("xyzw")}
        streams.append(Stream(names[kind], rows["tick"] * unit, values))
    return streams, notes


def _events(body: bytes, at: int, sizes: dict[int, int]) -> tuple[dict[int, array], int]:
    """Where the events of each kind begin, and how many bytes at the end belong to none."""
    starts = {kind: array("Q") for kind in sizes}
    while at + 2 <= len(body):
        kind = body[at] | body[at + 1] << 8
        if kind not in sizes or at + sizes[kind] > len(body):
            break
        starts[kind].append(at)
        at += sizes[kind]
    return starts, len(body) - at


def decompress_quaternions(compressed: NDArray[np.integer]) -> Array:
    """Quaternions (N, 4), x y z w, of ``stateEstimateZ.quat`` (``quatcompress.h``): the top two bits name the largest
    component, which is positive; the others follow in ten bits each, a sign and a share of sqrt(1/2) of nine bits."""
    code = np.asarray(compressed).astype(np.uint64) & np.uint64(0xFFFFFFFF)
    largest = (code >> np.uint64(30)).astype(int)
    q = np.zeros((len(code), 4))
    for k in (3, 2, 1, 0):
        rows = largest != k
        part = (code[rows] & np.uint64(0x3FF)).astype(int)
        q[rows, k] = np.where(part >> 9, -1.0, 1.0) * (part & 0x1FF) / 511.0 * 0.5**0.5
        code[rows] >>= np.uint64(10)
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(1.0 - (q * q).sum(-1), 0.0))
    return q


def _text(body: bytes, at: int) -> tuple[str, int]:
    end = body.index(b"\0", at)
    return body[at:end].decode(), end + 1


def pick(data: bytes, starts: array, record: np.dtype) -> NDArray[np.void]:
    """The records (N) of one kind that begin at some places of the data."""
    if not starts:
        return np.empty(0, record)
    windows = sliding_window_view(np.frombuffer(data, np.uint8), record.itemsize)
    return windows[np.frombuffer(starts, np.uint64)].view(record)[:, 0]
