"""What ROS bags hold, read from the first byte to the last: ROS 1 bags, MCAP and SQLite files, and ROS 2 folders.

Their indices are not used: they may be missing, broken, or name a message a million times. Chunks are unpacked one at a
time, and never to more than ``MAX_CHUNK``.
"""

from __future__ import annotations

import bz2
import io
import itertools
import os
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, BinaryIO

from torchrl_quad.dynamics import presets
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.identification.errors import UnreadableLog
from torchrl_quad.identification.signals import MAX_RECORDS, open_plain, too_many

MAX_CHUNK, MAX_RATIO = 256 * 10**6, 100  # [bytes] of what a chunk unpacks to; of all of them to the file
MAX_FILE = 2 * 10**9  # [bytes] of what a file that is packed as a whole unpacks to
_ROS1, _MCAP, _SQLITE = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"
MAGIC = (b"#ROSBAG V", _MCAP, _SQLITE)
# What the readers of records, numbers, texts, chunks and tables say of damaged ones.
_BROKEN = (struct.error, KeyError, UnicodeDecodeError, OSError, EOFError, RuntimeError, sqlite3.Error)


@dataclass(frozen=True)
class Connection:
    """A topic of a file."""

    topic: str
    kind: str  # of its messages, "pkg/msg/Type"
    definition: str  # of that kind; empty where the file has none
    language: str  # of the definition: "msg" or "idl"
    is_cdr: bool  # else ROS 1


Message = tuple[Connection, int, bytes]  # when it was received [ns], and its bytes


class BagFile:
    """The messages of a bag."""

    def __init__(self, path: Path) -> None:
        self.name, self.packed, self.unread = path.name, "", 0
        self.paths = self._from_metadata(path) if path.is_dir() else [path]

    def messages(self) -> Iterator[Message]:
        """Every message, in the order of the files."""
        self.unread = 0
        read = self._read_packed if self.packed == "file" else self._read
        messages = itertools.chain.from_iterable(map(read, self.paths))
        try:
            yield from itertools.islice(messages, MAX_RECORDS)
            if next(messages, None):
                raise too_many(self.name, MAX_RECORDS, "messages", "Split it.")
        except _BROKEN as error:
            raise self.broken(error) from error

    def broken(self, error: object) -> UnreadableLog:
        """The error of a damaged bag."""
        said = str(error)
        if isinstance(error, _BROKEN):
            said = f"{type(error).__name__}: {said}" if said else type(error).__name__
        return UnreadableLog(f"{self.name} is not a readable ROS bag: {said}. Record or copy it again.")

    def _from_metadata(self, folder: Path) -> list[Path]:
        with open_plain(folder / "metadata.yaml") as file:
            try:
                about = presets.parse(file.read(presets.MAX_BYTES + 1), f"{self.name}/metadata.yaml")
            except UserValueError as error:
                raise UnreadableLog(str(error)) from error
        about = about.get("rosbag2_bagfile_information") if isinstance(about, dict) else None
        about = about if isinstance(about, dict) else {}
        names = about.get("relative_file_paths")
        if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
            raise UnreadableLog(
                f"{self.name}/metadata.yaml names no relative_file_paths. Give the path of an .mcap or .db3 file in it."
            )
        mode = str(about.get("compression_mode") or "").lower()
        self.packed = mode if mode in ("file", "message") else ""
        paths = [folder / PurePath(name).name for name in names]
        for path in paths:
            if not path.exists():
                raise UnreadableLog(f"{self.name} lacks the file {path.name}, which its metadata.yaml names.")
        return paths

    def _read_packed(self, path: Path) -> Iterator[Message]:
        with tempfile.TemporaryDirectory() as folder:
            whole, written, zstd = Path(folder) / path.stem, 0, _zstd()
            try:
                with open_plain(path) as packed, zstd.open(packed, "rb") as file, open(whole, "wb") as out:
                    while written <= MAX_FILE and (part := file.read(1 << 20)):
                        written += out.write(part)
            except zstd.ZstdError as error:
                raise UnreadableLog(f"{path.name} is a broken zstd file: {error}. Copy it again.") from error
            if written > MAX_FILE:
                raise too_many(path.name, MAX_FILE, "bytes when it is unpacked", "Split it.")
            yield from self._read(whole)

    def _read(self, path: Path) -> Iterator[Message]:
        with open_plain(path) as file:
            start = file.read(16)
            size = os.fstat(file.fileno()).st_size
            left = [MAX_RATIO * size + MAX_CHUNK]
            if start.startswith(_SQLITE):
                messages = self._sqlite(path)
            elif start.startswith(_ROS1):
                file.seek(len(_ROS1))
                messages = self._ros1(file, size, {}, left)
            elif start.startswith(_MCAP):
                file.seek(len(_MCAP))
                messages = self._mcap(file, size, {}, {}, left)
            else:
                raise UnreadableLog(f"{path.name} is neither a ROS 1 bag of version 2.0 nor an MCAP or SQLite file.")
            for connection, time, raw in messages:
                packed = connection.is_cdr and self.packed == "message"
                yield connection, time, self._unpack("zstd", raw, MAX_CHUNK, [MAX_CHUNK]) if packed else raw

    def _ros1(self, file: BinaryIO, end: int, known: dict[int, Connection], left: list[int]) -> Iterator[Message]:
        """The records of a ROS 1 bag, or of a chunk in it: header and data, each after its size (32 bits)."""
        at = file.tell()
        while at + 8 <= end:
            (size,) = struct.unpack("<I", file.read(4))
            if at + 8 + size > end:
                break
            header = _fields(file.read(size))
            (size,) = struct.unpack("<I", file.read(4))
            if file.tell() + size > end:
                at = file.tell()
                break
            at = file.tell() + size
            op = header[b"op"]
            if op == b"\x07":  # a connection
                (number,) = struct.unpack("<I", header[b"conn"])
                about = _fields(file.read(size))
                topic, kind, text = header[b"topic"], about[b"type"], about[b"message_definition"]
                package, _, name = kind.decode().rpartition("/")
                kind = f"{package.removesuffix('/msg')}/msg/{name}"
                known.setdefault(number, Connection(topic.decode(), kind, text.decode(errors="replace"), "msg", False))
            elif op == b"\x02":  # a message
                (number,), (seconds, rest) = struct.unpack("<I", header[b"conn"]), struct.unpack("<II", header[b"time"])
                if number in known:
                    yield known[number], seconds * 10**9 + rest, file.read(size)
            elif op == b"\x05":  # a chunk
                (unpacked,) = struct.unpack("<I", header[b"size"])
                chunk = self._unpack(header[b"compression"].decode(), file.read(size), unpacked, left)
                yield from self._ros1(io.BytesIO(chunk), len(chunk), known, [])
            file.seek(at)
        self.unread += end - at

    def _mcap(
        self, file: BinaryIO, end: int, schemas: dict[int, tuple], known: dict[int, Connection], left: list[int]
    ) -> Iterator[Message]:
        """The records of an MCAP file, or of a chunk in it: a byte that says of what kind, and the size (64 bits)."""
        at = file.tell()
        while at + 9 <= end:
            op, size = struct.unpack("<BQ", file.read(9))
            if at + 9 + size > end:
                break
            at += 9 + size
            if op == 0x0F:  # the end of the data: what follows repeats it
                return
            if op == 0x05 and size >= 22:  # a message
                number, _, time, _ = struct.unpack("<HIQQ", file.read(22))
                if number in known:
                    yield known[number], time, file.read(size - 22)
            elif op == 0x03:  # a schema
                body = io.BytesIO(file.read(size))
                (number,) = struct.unpack("<H", body.read(2))
                schemas[number] = (_sized(body).decode(), _sized(body).decode(), _sized(body).decode(errors="replace"))
            elif op == 0x04:  # a channel
                body = io.BytesIO(file.read(size))
                number, schema = struct.unpack("<HH", body.read(4))
                topic, encoding = _sized(body).decode(), _sized(body).decode()
                kind, language, text = schemas.get(schema, ("unknown", "", ""))
                if encoding == "cdr":
                    known.setdefault(number, Connection(topic, kind, text, language.removeprefix("ros2")[-3:], True))
            elif op == 0x06:  # a chunk: times, size, checksum, compression, and its packed bytes after their size
                _, _, unpacked, _ = struct.unpack("<QQQI", file.read(28))
                compression = _sized(file).decode()
                (packed,) = struct.unpack("<Q", file.read(8))
                chunk = self._unpack(compression, file.read(min(packed, at - file.tell())), unpacked, left)
                yield from self._mcap(io.BytesIO(chunk), len(chunk), schemas, known, [])
            elif not 0 < op < 0x10 and op < 0x80:
                raise self.broken(f"it has a record of the kind {op}")
            file.seek(at)
        self.unread += end - at

    def _unpack(self, compression: str, data: bytes, size: int, left: list[int]) -> bytes:
        """A chunk of so many bytes; ``left`` is what all chunks of the file may still unpack to."""
        if not left:
            raise self.broken("it has a chunk within a chunk")
        size = max(size, len(data)) if compression in ("", "none") else size
        left[0] -= size
        if size > MAX_CHUNK or left[0] < 0:
            raise UnreadableLog(
                f"{self.name} has a chunk that unpacks to {size:,} bytes; the maximum is {MAX_CHUNK:,}, and "
                f"{MAX_RATIO} times the file for all of them. Record it with smaller chunks."
            )
        if compression in ("", "none"):
            return data
        if compression == "bz2":
            unpacker: Any = bz2.BZ2Decompressor()
        elif compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            unpacker = LZ4FrameDecompressor()
        elif compression == "zstd":
            unpacker = _zstd().ZstdDecompressor()
        else:
            raise UnreadableLog(f"{self.name} has a chunk of unknown compression, {shown(compression)}. Use zstd.")
        try:
            return unpacker.decompress(data, size)
        except Exception as error:  # each library raises its own
            raise self.broken(f"it has a damaged chunk: {error}") from error

    def _sqlite(self, path: Path) -> Iterator[Message]:
        """The rows of the tables messages and topics, which must be plain: a view may never end."""
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
            base.text_factory = lambda text: text.decode(errors="replace")
            base.execute("PRAGMA trusted_schema=OFF")
            tables = dict(base.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchmany(1000))
            for table in {"messages", "topics"} | ({"message_definitions"} & tables.keys()):
                hidden = base.execute(f"SELECT hidden FROM pragma_table_xinfo('{table}')").fetchall()
                if not str(tables.get(table)).upper().startswith("CREATE TABLE") or any(mark for (mark,) in hidden):
                    raise UnreadableLog(f"{self.name} is not a ROS bag: it has no plain table of {table}.")
            definitions: dict[Any, tuple[str, str]] = {}
            if "message_definitions" in tables:
                rows = base.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
                definitions = {kind: (str(text), str(language)[-3:]) for kind, language, text in rows.fetchmany(10_000)}
            rows = base.execute("SELECT id, name, type FROM topics WHERE serialization_format = 'cdr'")
            known = {
                number: Connection(str(topic), str(kind), *definitions.get(kind, ("", "msg")), True)
                for number, topic, kind in rows.fetchmany(10_000)
            }
            rows = base.execute("SELECT topic_id, timestamp, data FROM messages")
            for number, time, raw in itertools.islice(rows, MAX_RECORDS + 1):  # a broken tree may have endless ones
                if number in known and isinstance(time, int) and isinstance(raw, bytes):
                    yield known[number], time, raw


def _fields(data: bytes) -> dict[bytes, bytes]:
    """The header of a record of a ROS 1 bag: "name=value", each after its size (32 bits)."""
    found, at = {}, 0
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        found[name] = value
        at += 4 + size
    return found


def _sized(file: BinaryIO) -> bytes:
    (size,) = struct.unpack("<I", file.read(4))
    return file.read(min(size, MAX_CHUNK))


def _zstd() -> Any:
    try:
        from compression import zstd  # pyrefly: ignore[missing-import]  # which Python 3.14 has
    except ModuleNotFoundError:
        from backports import zstd
    return zstd
