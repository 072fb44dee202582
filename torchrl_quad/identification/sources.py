"""Files of every kind as streams: CSV, PX4's ULog, ROS bags, and the Crazyflie's uSD log."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from torchrl_quad.identification.bags import read_bag
from torchrl_quad.identification.errors import MissingColumns, UnreadableLog
from torchrl_quad.identification.layouts import LAYOUTS, Layout, choose, match
from torchrl_quad.identification.streams import Stream
from torchrl_quad.identification.ulog import read_ulog
from torchrl_quad.identification.usd import read_usd

Asked = str | Layout | Mapping[str, object] | None
BAG = (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3")


def read_streams(path: Path, columns: Asked) -> tuple[list[Stream], Layout, list[str]]:
    """The streams of a file, what is where in it, and notes. The first bytes say of what kind it is.

    Raises:
        UnreadableLog: the file is empty, broken, or of no known kind.
        MissingColumns: no preset knows its columns.
    """
    if not path.exists():
        raise UnreadableLog(f"{path} does not exist. Give the path of a log.")
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            raise UnreadableLog(f"{path} is a folder without metadata.yaml, so no ROS 2 bag. Give the path of a log.")
        return read_bag(path, columns)
    with open(path, "rb") as file:
        start = file.read(16)
    if start.startswith(BAG):
        return read_bag(path, columns)
    data = path.read_bytes()
    if start.startswith(b"\x1f\x8b"):
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as error:
            raise UnreadableLog(f"{path.name} is a broken gz file: {error}. Copy it again.") from error
    if not data.strip():
        raise UnreadableLog(f"{path.name} is empty. Give a log that has samples.")
    readers: dict[bytes, tuple[Callable[..., tuple[list[Stream], list[str]]], str]] = {
        b"ULog\x01\x12\x35": (read_ulog, "px4"),
        b"\xbc": (read_usd, "crazyflie"),
    }
    for magic, (reader, preset) in readers.items():
        if data.startswith(magic):
            layout = LAYOUTS[preset] if columns is None else choose(columns, LAYOUTS[preset])
            streams, notes = reader(data, path.name)
            return streams, layout, notes
    return _read_csv(data, path, columns)


def _read_csv(data: bytes, path: Path, columns: Asked) -> tuple[list[Stream], Layout, list[str]]:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnreadableLog(
            f"{path.name} is no log of a known kind: its bytes are no text, and begin like no ULog, ROS bag or uSD log "
            "(versions 1 and 2). Export it as CSV."
        ) from error
    first = text.split("\n", 1)[0]
    mark = max(",;\t", key=first.count)
    header = [name.strip().strip('"') for name in first.split(mark)]
    repeated = {name for name in header if header.count(name) > 1}
    try:
        table = np.genfromtxt(io.StringIO(text), delimiter=mark, skip_header=1, ndmin=2)
    except ValueError as error:
        reason = str(error).splitlines()[0]
        raise UnreadableLog(
            f"{path.name} is no table of numbers: {reason} Give a CSV file whose first row names the columns."
        ) from error
    if len(table) < 2 or table.shape[1] != len(header):
        raise UnreadableLog(
            f"{path.name} has {len(table)} rows of {table.shape[1]} numbers under {len(header)} names. Give a CSV file "
            "whose first row names the columns, and whose others are samples."
        )
    if columns is None:
        layout = match(header, path.name)
    else:  # a mapping without a position changes a preset; one with it describes the whole file
        partial = isinstance(columns, Mapping) and "position" not in columns
        layout = choose(columns, match(header, path.name) if partial else None)
    asked = {*layout.time.names, *(n for choices in layout.columns.values() for c in choices for n in c.names)}
    if layout.time.names[0] not in header:
        raise MissingColumns(
            f"{path.name} has no column {layout.time.names[0]} of the time. There are: {', '.join(header[:60])}. "
            'Name it: columns={"time": ...}.'
        )
    if asked & repeated:
        raise UnreadableLog(f"{path.name} has several columns of one name: {', '.join(sorted(repeated))}. Rename them.")
    values = dict(zip(header, table.T, strict=True))
    time = (values[layout.time.names[0]] - np.asarray(layout.time.offset)) * np.asarray(layout.time.scale)
    return [Stream("csv", time, values)], layout, []
