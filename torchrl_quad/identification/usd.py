"""The log that a Crazyflie writes to its micro SD card.

Format (``src/deck/drivers/src/usddeck.c`` of the firmware), little-endian: the byte 0xBC; version (1 or 2) and the
number of kinds of events, 16 bits each; for each kind its id (16 bits), its name and a zero, the number of variables
(16 bits), and each variable as "name(t)" and a zero, where t is a letter of Python's ``struct``. Then come the events:
id, time (version 1: 32 bits, ms; version 2: 64 bits, us) and values. The last four bytes are the CRC-32 of all others.
"""

from __future__ import annotations

import re
import struct
import zlib
from array import array
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from torchrl_quad.errors import shown
from torchrl_quad.identification.errors import UnreadableLog
from torchrl_quad.identification.signals import MAX_COLUMNS, MAX_RECORDS, Array, Stream, too_many

_TICKS = {1: ("<u4", 1e-3), 2: ("<u8", 1e-6)}
_VARIABLE = re.compile(r"(.+)\(([bBhHiIqQfd?])\)")


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
            raise UnreadableLog(f"{name} is a uSD log of version {version}; 1 and 2 are known. Export it as CSV.")
        tick, unit = _TICKS[version]
        records, names, at, columns = {}, {}, 5, 0
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
                    raise UnreadableLog(f"{name} has a variable of unknown type, {shown(variable)}. Export it as CSV.")
                columns += 1
                if columns > MAX_COLUMNS:
                    raise too_many(name, MAX_COLUMNS, "variables", "Log fewer.")
                fields.append((found[1], np.dtype(found[2]).newbyteorder("<")))
            records[kind] = np.dtype(fields)
    except UnreadableLog:
        raise
    except (struct.error, ValueError) as error:
        raise UnreadableLog(f"{name} begins like a uSD log, but its header is cut off. Copy it again.") from error
    starts, left = _events(body, at, {kind: record.itemsize for kind, record in records.items()}, name)
    if left:
        notes.append(f"the last {left} bytes of the uSD log were not read: they are no whole events")
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


def pick(data: bytes, starts: array, record: np.dtype) -> NDArray[np.void]:
    """The records (N) of one kind that begin at some places of the data."""
    if not starts:
        return np.empty(0, record)
    windows = sliding_window_view(np.frombuffer(data, np.uint8), record.itemsize)
    return windows[np.frombuffer(starts, np.uint64)].view(record)[:, 0]


def _events(body: bytes, at: int, sizes: dict[int, int], name: str) -> tuple[dict[int, array], int]:
    """Where the events of each kind begin, and how many bytes at the end are no event."""
    starts = {kind: array("Q") for kind in sizes}
    for _ in range(MAX_RECORDS):
        if at + 2 > len(body):
            break
        kind = body[at] | body[at + 1] << 8
        if kind not in sizes or at + sizes[kind] > len(body):
            break
        starts[kind].append(at)
        at += sizes[kind]
    else:
        raise too_many(name, MAX_RECORDS, "events", "Log fewer.")
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
