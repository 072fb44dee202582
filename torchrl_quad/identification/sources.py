"""Files of every kind as streams: CSV, PX4's ULog, ROS bags, and the Crazyflie's uSD log."""

from __future__ import annotations

import codecs
import collections
import gzip
import io
import itertools
import os
import zlib
from array import array
from collections.abc import Callable, Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO

import numpy as np

from torchrl_quad.identification.bags import MAGIC, read_bag
from torchrl_quad.identification.errors import MissingColumns, UnreadableLog
from torchrl_quad.identification.layouts import LAYOUTS, Layout, choose, match
from torchrl_quad.identification.streams import Stream, open_plain
from torchrl_quad.identification.ulog import read_ulog
from torchrl_quad.identification.usd import read_usd

Asked = str | Layout | Mapping[str, object] | None
# Of a file, which may be packed, and of what it unpacks to. All is read in time and memory proportional to its size.
MAX_BYTES, MAX_UNPACKED = 2 * 10**9, 500 * 10**6
MAX_LINE, MAX_COLUMNS, MAX_ROWS = 4 * 10**6, 100_000, 5 * 10**6  # of a CSV file: bytes, names, samples


def read_streams(path: Path, columns: Asked) -> tuple[list[Stream], Layout, list[str]]:
    """The streams of a file, what is where in it, and notes. The first bytes say of what kind it is.

    Raises:
        UnreadableLog: the file is empty, broken, too large, no plain file, or of no known kind.
        MissingColumns: no preset knows its columns.
    """
    if not path.exists():
        raise UnreadableLog(f"{path} does not exist. Give the path of a log.")
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise UnreadableLog(f"{path} is a folder without metadata.yaml, so no ROS 2 bag. Give the path of a log.")
        return read_bag(path, columns)
    with open_plain(path) as file:
        start = file.peek(16)[:16]
        if start.startswith(MAGIC):
            return read_bag(path, columns)
        size = os.fstat(file.fileno()).st_size
        if size > MAX_BYTES:
            raise UnreadableLog(f"{path.name} has {size:,} bytes; the most is {MAX_BYTES:,}. Cut it into shorter logs.")
        if not start.startswith(b"\x1f\x8b"):
            return _read(file, path.name, columns, MAX_BYTES)
        try:
            with io.BufferedReader(gzip.GzipFile(fileobj=file), 1 << 20) as unpacked:  # whose own lines are slow
                return _read(unpacked, path.name, columns, MAX_UNPACKED)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise UnreadableLog(f"{path.name} is a broken gz file: {error}. Copy it again.") from error


def _read(file: BinaryIO, name: str, columns: Asked, most: int) -> tuple[list[Stream], Layout, list[str]]:
    readers: dict[bytes, tuple[Callable[..., tuple[list[Stream], list[str]]], str]] = {
        b"ULog\x01\x12\x35": (read_ulog, "px4"),
        b"\xbc": (read_usd, "crazyflie"),
    }
    start = file.peek(8192)  # type: ignore[attr-defined]
    for magic, (reader, preset) in readers.items():
        if start.startswith(magic):
            layout = LAYOUTS[preset] if columns is None else choose(columns, LAYOUTS[preset])
            data = b"".join(_counted(iter(lambda: file.read(1 << 20), b""), name, most))
            streams, notes = reader(data, name)
            return streams, layout, notes
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError as error:
        raise UnreadableLog(
            f"{name} is no log of a known kind: its bytes are no text, and begin like no ULog, ROS bag or uSD log "
            "(versions 1 and 2). Export it as CSV."
        ) from error
    return _read_csv(_counted(iter(lambda: file.readline(MAX_LINE + 1), b""), name, most), name, columns)


def _counted(parts: Iterator[bytes], name: str, most: int) -> Iterator[bytes]:
    total = 0
    for part in parts:
        total += len(part)
        if total > most:
            raise UnreadableLog(
                f"{name} unpacks to more than {most:,} bytes; that is the most. Cut it into shorter logs."
            )
        yield part


def _read_csv(lines: Iterator[bytes], name: str, columns: Asked) -> tuple[list[Stream], Layout, list[str]]:
    """Of a table, only the columns that are asked for become numbers; cells that are none become NaN."""
    rows = _rows(lines, name)
    first = next(rows, "").removeprefix("\ufeff")
    if not first:
        raise UnreadableLog(f"{name} is empty. Give a log that has samples.")
    mark = max(",;\t", key=first.count)
    header = [part.strip().strip('"') for part in first.split(mark)]
    if len(header) > MAX_COLUMNS:
        raise UnreadableLog(f"{name} has {len(header):,} columns; the most is {MAX_COLUMNS:,}. Leave some out.")
    repeated = {column for column, count in collections.Counter(header).items() if count > 1}
    samples = list(itertools.islice(rows, 2))
    if len(samples) < 2 or samples[0].count(mark) + 1 != len(header):
        cells = samples[0].count(mark) + 1 if samples else 0
        raise UnreadableLog(
            f"{name} has rows of {cells} cells under {len(header)} names, or fewer than two. Give a CSV file whose "
            "first row names the columns, and whose others are samples."
        )
    _cells(samples[1], mark, len(header), name, 1)
    if columns is None:
        layout = match(header, name)
    else:  # a mapping without a position changes a preset; one with it describes the whole file
        partial = isinstance(columns, Mapping) and "position" not in columns
        layout = choose(columns, match(header, name) if partial else None)
    asked = {*layout.time.names, *(n for choices in layout.columns.values() for c in choices for n in c.names)}
    if layout.time.names[0] not in header:
        raise MissingColumns(
            f"{name} has no column {layout.time.names[0]} of the time. There are: {', '.join(header[:60])}. "
            'Name it: columns={"time": ...}.'
        )
    if asked & repeated:
        raise UnreadableLog(
            f"{name} has several columns of one name: {', '.join(sorted(asked & repeated))}. Rename them."
        )
    place = {column: k for k, column in enumerate(header) if column in asked}
    table = _numbers(itertools.chain(samples, rows), mark, len(header), list(place.values()), name)
    values = dict.fromkeys(header, np.broadcast_to(np.nan, len(table)))  # nobody reads the others
    values |= dict(zip(place, table.T, strict=True))
    time = (values[layout.time.names[0]] - np.asarray(layout.time.offset)) * np.asarray(layout.time.scale)
    return [Stream("csv", time, values)], layout, []


def _rows(lines: Iterator[bytes], name: str) -> Iterator[str]:
    """The rows of a table as text, without comments and empty ones."""
    for k, line in enumerate(lines):
        if k > MAX_ROWS:
            raise UnreadableLog(f"{name} has more than {MAX_ROWS:,} lines; that is the most. Cut it into shorter logs.")
        if len(line) > MAX_LINE:
            raise UnreadableLog(f"{name}: line {k + 1} has more than {MAX_LINE:,} bytes; that is the most.")
        try:
            text = line.decode()
        except UnicodeDecodeError as error:
            raise UnreadableLog(f"{name}: line {k + 1} is no text in UTF-8. Export it as CSV again.") from error
        if k and "#" in text:
            text = text.partition("#")[0]
        text = text.strip(" \r\n")
        if text:
            yield text


def _numbers(rows: Iterator[str], mark: str, width: int, places: list[int], name: str) -> np.ndarray:
    """Some columns of a table (N, len(places))."""
    flat, pick = array("d"), itemgetter(*places, places[0])  # of one place alone it would give no tuple
    for k, row in enumerate(rows):
        picked = pick(_cells(row, mark, width, name, k))[:-1]
        try:
            flat.extend([float(cell) for cell in picked])
        except ValueError:
            flat.extend([_number(cell) for cell in picked])
    return np.frombuffer(flat).reshape(-1, len(places))


def _cells(row: str, mark: str, width: int, name: str, k: int) -> list[str]:
    cells = row.split(mark)
    if len(cells) != width:
        raise UnreadableLog(
            f"{name} is no table of numbers: row {k + 1} has {len(cells)} cells, and the first row names {width}. "
            "Give a CSV file whose first row names the columns."
        )
    return cells


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan
