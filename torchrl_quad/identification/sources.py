"""Files of every kind as streams: CSV here, and PX4's ULog, ROS bags, and the Crazyflie's uSD log elsewhere."""

from __future__ import annotations

import codecs
import collections
import contextlib
import csv
import gzip
import io
import itertools
import os
import re
import zlib
from array import array
from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.errors import shown
from torchrl_quad.identification.autopilots import HEAD, PACKED, read_dataflash, read_ulog, read_usd, unpacked
from torchrl_quad.identification.bags import MAGIC, read_bag
from torchrl_quad.identification.errors import MissingColumns, UnreadableLog
from torchrl_quad.identification.layouts import LAYOUTS, NEEDED, Asked, Layout, blackbox, choose, listed, match
from torchrl_quad.identification.signals import MAX_COLUMNS, Stream, open_plain, too_many

Read = tuple[list[Stream], Layout, list[str]]
# Of a file, which may be packed, and of what it unpacks to. All is read in time and memory proportional to its size.
MAX_BYTES, MAX_UNPACKED = 2 * 10**9, 500 * 10**6
MAX_LINE, MAX_ROWS = 4 * 10**6, 5 * 10**6  # bytes and lines of a CSV file
_CUT = "Cut it into shorter logs."
_NO_LOG = {  # by what it begins with
    rb"version https://git-lfs": "stands for a file that was not downloaded. Write: git lfs pull",
    rb"\s*<(!doctype )?html": "is a web page. Download the file itself, which GitHub calls raw.",
    rb"\s*(\{|\[\s*[\[{\"\d-])": "is JSON, or like it. Export it as CSV.",
    rb"[\t -~]+\r[\t\r -~]+\Z": "ends its lines with carriage returns alone. Save it as CSV with line feeds.",
    rb"FMT, *128": "is the text of a dataflash log. Give its .bin.",
    rb"rosbag2_bagfile_information": "only describes a ROS bag. Give the folder that it lies in.",
}
# By the first bytes.
_READERS = {b"ULog\x01\x12\x35": (read_ulog, "px4"), b"\xbc": (read_usd, "crazyflie")}
_READERS[HEAD] = (read_dataflash, "ardupilot")


def read_streams(path: Path, columns: Asked) -> Read:
    """The streams of a file, what is where in it, and notes. Its first bytes tell the kind of file."""
    if not path.exists():
        raise UnreadableLog(f"{path} does not exist. Give the path of a log.")
    if path.is_dir():
        if not any(x.suffix in (".db3", ".mcap", ".zstd") for x in path.iterdir()):
            raise UnreadableLog(f"{path} is a folder without a ROS bag. Give the path of the log in it.")
        return read_bag(path, columns)
    with open_plain(path) as file:
        start = file.peek(16)[:16]
        if start.startswith(MAGIC):
            return read_bag(path, columns)
        if os.fstat(file.fileno()).st_size > MAX_BYTES:
            raise too_many(path.name, MAX_BYTES, "bytes", _CUT)
        if not start.startswith(b"\x1f\x8b"):
            return _read(file, path.name, columns, MAX_BYTES)
        try:
            with io.BufferedReader(gzip.GzipFile(fileobj=file), 1 << 20) as unpacked:  # whose own lines are slow
                return _read(unpacked, path.name, columns, MAX_UNPACKED)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise UnreadableLog(f"{path.name} is a broken gz file: {error}. Copy it again.") from error


def _read(file: io.BufferedReader[Any], name: str, columns: Asked, most: int) -> Read:
    start = file.peek(8192)
    is_blackbox = re.match(rb'H Product:Blackbox|"?Product"?,"?Blackbox', start) is not None
    if is_blackbox and (start.startswith(b"H ") or not isinstance(columns, Mapping)):
        raise blackbox(name)
    for beginning, why in _NO_LOG.items():
        if re.match(beginning, start, re.IGNORECASE):
            raise UnreadableLog(f"{name} {why}")
    for magic, (reader, preset) in _READERS.items():
        if start.startswith(magic):
            if isinstance(columns, Mapping) and "time" in columns:
                raise MissingColumns(f"{name}: columns names a time, but such a log has its own clock. Leave time out.")
            layout = LAYOUTS[preset] if columns is None else choose(columns, LAYOUTS[preset])
            data = b"".join(_counted(iter(lambda: file.read(1 << 20), b""), name, most))
            streams, notes = reader(data, name)
            return streams, layout, notes
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError as error:
        if start[:2] in (b"\xff\xfe", b"\xfe\xff") or (
            0 not in start and sum(x > 126 for x in start) < 0.1 * len(start)
        ):
            raise UnreadableLog(f"{name} is text, but not in UTF-8. Save it as CSV in UTF-8.") from error
        raise UnreadableLog(
            f"{name} is not a log of a known kind: it is not text, and does not begin like a ULog, dataflash log, ROS "
            "bag or uSD log (versions 1 and 2). Export it as CSV."
        ) from error
    lines = _counted(iter(lambda: file.readline(MAX_LINE + 1), b""), name, most)
    if is_blackbox:  # whose table begins after its settings
        lines = itertools.dropwhile(lambda line: not re.match(rb'"?(loopIteration|time)\b', line), lines)
    return _read_csv(lines, name, columns)


def _counted(parts: Iterator[bytes], name: str, most: int) -> Iterator[bytes]:
    total = 0
    for part in parts:
        total += len(part)
        if total > most:
            raise too_many(name, most, "bytes when it is unpacked", _CUT)
        yield part


def _read_csv(lines: Iterator[bytes], name: str, columns: Asked) -> Read:
    """Only the columns that are asked for become numbers; cells without a number become NaN."""
    rows = _rows(lines, name)
    first = next(rows, "")
    if not first:
        raise UnreadableLog(f"{name} is empty. Give a log that has samples.")
    mark = _mark(first)
    header = [part.strip().strip('"') for part in _split(first, mark)]
    unnamed = UnreadableLog(f"{name}: its first row holds numbers. Put a row above it that names the columns.")
    is_unnamed = all(_number(x, mark) == _number(x, mark) for x in header)
    if is_unnamed and not isinstance(columns, Mapping):
        raise unnamed
    if len(header) > MAX_COLUMNS:
        raise too_many(name, MAX_COLUMNS, "columns", "Leave some out.")
    samples = list(itertools.islice(rows, 2))
    if len(samples) < 2:
        raise UnreadableLog(f"{name} has fewer than two samples below its header. Give the log of a flight.")
    if len(header) < 3 and max(row.count(_mark(row) or " ") for row in samples) > 2:
        raise UnreadableLog(
            f"{name}: its first row, {shown(first)}, names no columns: delete the lines above their names."
        )
    if samples[0].count(mark or " ") == len(header) and samples[0].endswith(mark or " "):
        header.append("")  # a separator ends each row but the first
    for k, row in enumerate(samples):  # before anything is said of its columns: it may be no table
        _cells(row, mark, len(header), name, k)
    layout = match(header, name) if columns is None else choose(columns, _preset(header, name, columns))
    (clock,) = layout.time.names
    if clock not in header and is_unnamed:
        raise unnamed
    if clock not in header:
        raise MissingColumns(
            f"{name} has no column {clock} of the time. There are{listed(header, [clock, 'time', 'stamp'])}. "
            'Name it: columns={"time": ...}.'
        )
    asked = layout.names | {clock, PACKED}
    repeated = sorted(column for column, count in collections.Counter(header).items() if count > 1 and column in asked)
    if repeated:
        raise UnreadableLog(f"{name} has several columns of one name: {', '.join(repeated)}. Rename them.")
    place = {column: k for k, column in enumerate(header) if column in asked}
    flat, pick = array("d"), itemgetter(*place.values(), place[clock])  # of a single place it would not give a tuple
    notes = list[str]()
    for k, row in enumerate(itertools.chain(samples, rows)):
        try:
            picked = pick(_cells(row, mark, len(header), name, k))[:-1]
        except UnreadableLog:
            if next(rows, None) is not None:
                raise
            notes.append(f"the last row, {k + 1}, is cut off: left out")
            break
        try:
            flat.extend([float(cell) for cell in picked])
        except ValueError:
            flat.extend([_number(cell, mark) for cell in picked])
    table = np.frombuffer(flat).reshape(-1, len(place))
    values = dict.fromkeys(header, np.broadcast_to(np.nan, len(table)))  # the others are never read
    values |= dict(zip(place, table.T, strict=True))
    values |= unpacked(values)
    time = (values[clock] - np.asarray(layout.time.offset)) * np.asarray(layout.time.scale)
    told = np.isfinite(table).any(1)  # other rows are empty
    if not told.any() or np.isfinite(time[told]).mean() < 0.5:
        odd = next((k for k in range(len(samples)) if not np.isfinite(time[k])), None)
        cell = "" if odd is None else _cells(samples[odd], mark, len(header), name, odd)[header.index(clock)]
        said = f", but {shown(cell)}" if cell else " in most rows"
        raise UnreadableLog(f"{name}: the time in {clock} is no number{said}. Write it in seconds, as 1234.5.")
    return [Stream("csv", time, values)], layout, notes


def _preset(header: list[str], name: str, columns: Asked) -> Layout | None:
    """What a mapping changes; None for one that describes the whole file, or will be told what it lacks."""
    if not isinstance(columns, Mapping) or all(set(columns) & set(quantities) for quantities in NEEDED):
        return None
    clocks = [x for layout in LAYOUTS.values() for x in layout.time.names] if "time" in columns else []
    with contextlib.suppress(MissingColumns) if "position" in columns else contextlib.nullcontext():
        return match([*header, *clocks], name)


def _rows(lines: Iterator[bytes], name: str) -> Iterator[str]:
    """The rows of a table as text, without comments and empty ones. The last comment above rows of numbers is the first
    row, which names their columns; some may hold text."""
    remark, begun = "", False
    for k, line in enumerate(lines):
        if k >= MAX_ROWS:
            raise too_many(name, MAX_ROWS, "lines", _CUT)
        if len(line) > MAX_LINE:
            raise too_many(f"{name}: line {k + 1}", MAX_LINE, "bytes", "Export it as CSV again.")
        try:
            text = line.decode()
        except UnicodeDecodeError as error:
            raise UnreadableLog(f"{name}: line {k + 1} is not text in UTF-8. Export it as CSV again.") from error
        text = text.strip(" \r\n\ufeff")
        if not begun and text.lower().startswith("sep="):  # of a table calculation
            continue
        if not begun and text[:1] in ("#", "%"):
            remark = text.lstrip("#% ") or remark
            continue
        text = re.sub(r"#(?!N/A).*", "", text).strip(" ") if begun and "#" in text else text
        if not begun and text:
            begun, mark = True, _mark(remark)
            cells, names = (x.strip(mark).split(mark) for x in (text, remark))
            numbers, words = (sum(_number(x, mark) == _number(x, mark) for x in row) for row in (cells, names))
            if remark and (numbers == len(cells) or (numbers and not words and len(cells) == len(names))):
                yield remark
        if text:
            yield text


def _mark(header: str) -> str | None:
    """What separates the cells; None is white space."""
    mark = max(",;\t", key=header.count)
    return mark if mark in header else "|" if header.count("|") > 1 else None


def _cells(row: str, mark: str | None, width: int, name: str, k: int) -> list[str]:
    cells = _split(row, mark)
    if len(cells) != width:
        above = "Give a CSV file whose first row names the columns: delete the lines above that one."
        raise UnreadableLog(
            f"{name} is not a table of numbers: row {k + 1} has {len(cells)} cells, and the first row names {width}. "
            f"{'Leave that row out.' if k > 1 else above}"
        )
    return cells


def _split(row: str, mark: str | None) -> list[str]:
    return next(csv.reader([row], delimiter=mark)) if mark and '"' in row else row.replace('"', "").split(mark)


def _number(cell: str, mark: str | None) -> float:
    try:
        return float(cell if mark == "," else cell.replace(",", "."))
    except ValueError:
        return np.nan
