"""Logs that are damaged, or made to never end: each reads, or is refused by a LogError in one line that names it."""

import bz2
import gzip
import os
import random
import shutil
import socket
import sqlite3
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from log_writers import ULOG, flight, ulog_message, write_csv, write_ulog, write_usd
from test_log_files import px4_messages, times, usd_events, write_bag
from test_log_tables import OURS, own_table

from torchrl_quad.identification import GapsTooLarge, LogError, UnreadableLog, bag_files, read_log, sources
from torchrl_quad.identification.autopilots import read_ulog

BATTERY = {"battery_voltage": "/drone/battery.x"}
TABLE = {"time": "t", **OURS}
KINDS = {
    "a.ulg": None, "v1": None, "v2": None, "a.csv": TABLE, "a.csv.gz": TABLE, "a.bag": BATTERY, "a.mcap": BATTERY,
    "a.db3": BATTERY,
}  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bytes of a log of each kind."""
    from rosbags.rosbag2 import StoragePlugin

    folder = tmp_path_factory.mktemp("logs")
    write_ulog(folder / "a.ulg", px4_messages(), {"THR_MDL_FAC": 0.3})
    for version in (1, 2):
        write_usd(folder / f"v{version}", usd_events(times(100), times(10)), version)
    table = write_csv(folder / "a.csv", own_table(times(100))).read_bytes()
    (folder / "a.csv.gz").write_bytes(gzip.compress(table))
    write_bag(folder / "a.bag", ros2=False)
    for name, plugin in (("mcap", StoragePlugin.MCAP), ("db3", StoragePlugin.SQLITE3)):
        bag = write_bag(folder / name, ros2=True, storage=plugin)
        shutil.copy(next(bag.glob(f"*.{name}")), folder / f"a.{name}")
    return {name: (folder / name).read_bytes() for name in KINDS}


def damaged(data, draw):
    """The bytes with a few bits turned, cut off, with a piece twice or missing, or with a number of another size."""
    data, reach = bytearray(data), min(len(data), draw.choice((64, 1000, len(data))))
    at = draw.randrange(reach)
    match draw.choice(("turn", "turn", "turn many", "cut", "twice", "lose", "number")):
        case "turn":
            data[at] ^= 1 << draw.randrange(8)
        case "turn many":
            for _ in range(30):
                data[draw.randrange(reach)] ^= 1 << draw.randrange(8)
        case "cut":
            del data[draw.randrange(len(data)) :]
        case "twice":
            data[at:at] = data[at : at + draw.choice((1, 100, 10_000))]
        case "lose":
            del data[at : at + draw.choice((1, 100, 10_000))]
        case "number":
            data[at : at + 8] = draw.choice((0, 2**31 - 1, 2**32 - 1, 2**64 - 1)).to_bytes(8, "little")
    return bytes(data)


def refused(path, columns=None):
    """What read_log says of a file that it refuses; None of one that it reads."""
    said = None
    try:
        read_log(path, columns)
    except LogError as error:
        said = str(error)
    assert said is None or ("\n" not in said and path.name in said and len(said) < 4000)
    return said


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_log_reads_or_is_refused_in_one_line_that_names_it(kind, whole, tmp_path):
    draw, path = random.Random(kind), tmp_path / kind
    path.write_bytes(whole[kind])
    assert refused(path, KINDS[kind]) is None
    said = []
    for _ in range(60):
        path.write_bytes(damaged(whole[kind], draw))
        said.append(refused(path, KINDS[kind]))
    assert any(said)
    path.write_bytes(whole[kind])
    assert refused(path, KINDS[kind]) is None  # nothing was left behind


def test_a_ulog_is_read_on_behind_what_is_damaged(whole, tmp_path):
    sync = ulog_message("S", bytes.fromhex("2f731320250cbb12"))
    data, half = whole["a.ulg"], whole["a.ulg"].index(struct.pack("<H", 14) + b"D", 150_000)
    (tmp_path / "a.ulg").write_bytes(data[:half] + b"\xff" * 1000 + sync + data[half:])
    log, plain = read_log(tmp_path / "a.ulg"), read_ulog(data, "a")[0]
    assert "the ULog is damaged: 1 messages and 0 bytes were not read" in str(log)
    again = read_ulog((tmp_path / "a.ulg").read_bytes(), "a")[0]
    assert [len(stream.time) for stream in again] == [len(stream.time) for stream in plain]


def ulog_of(*formats, count=100):
    body = b"".join(ulog_message("F", text.encode()) for text in formats)
    body += ulog_message("A", b"\0\0\0" + formats[0].split(":")[0].encode()) * count
    return ULOG + body + ulog_message("D", bytes(20))


def mcap_record(op, body):
    return struct.pack("<BQ", op, len(body)) + body


def sized(*texts):
    return b"".join(struct.pack("<I", len(text)) + text.encode() for text in texts)


def mcap_of(definition, *messages):
    body = mcap_record(3, struct.pack("<H", 1) + sized("geometry_msgs/msg/PoseStamped", "ros2msg", definition))
    body += mcap_record(4, struct.pack("<HH", 1, 1) + sized("/pose", "cdr", ""))
    return body + b"".join(mcap_record(5, struct.pack("<HIQQ", 1, 0, 9, 9) + message) for message in messages)


def mcap_chunk(data, compression, size):
    head = struct.pack("<QQQI", 0, 1, size, 0) + sized(compression) + struct.pack("<Q", len(data))
    return mcap_record(6, head + data)


MCAP = b"\x89MCAP0\r\n"
PACK = {"zstd": bag_files._zstd().compress, "lz4": lz4.frame.compress, "bz2": bz2.compress}
MESSAGE = b"\0\1\0\0" + bytes(200)
ENDLESS = {  # what no reader should follow to its end: a file, and what its refusal says
    "nested.ulg": (ulog_of(*(f"a{k}:a{k + 1}[65535] x;" for k in range(9)), "a9:uint8_t[65535] x;"), "no sample"),
    "itself.ulg": (ulog_of("a:uint64_t timestamp;a x;"), "no sample"),
    "nothing.ulg": (ulog_of("a:uint64_t timestamp;b[65535] x;", "b:c[65535] x;", "c:"), "no sample"),
    "wide.ulg": (ulog_of(*(f"a{k}:uint64_t timestamp;uint8_t[65000] x;" for k in range(2000))), "no sample"),
    "chunks.mcap": (MCAP + mcap_chunk(mcap_chunk(b"", "", 0), "", 99), "a chunk within a chunk"),
    "array.mcap": (MCAP + mcap_of("float64[9999999999] x", MESSAGE), "too short"),
    "texts.mcap": (MCAP + mcap_of("string[4000000000] x", MESSAGE), "too short"),
    "itself.mcap": (MCAP + mcap_of("geometry_msgs/PoseStamped x", MESSAGE), "no definition"),
    "definition.mcap": (MCAP + mcap_of("int32 x\n" * 20_000, MESSAGE), "more than 100,000 characters"),
    "zeros.bag": (b"#ROSBAG V2.0\n" + bytes(1000), "not a readable ROS bag"),
    "line.csv": (b"t" * 5_000_000, "line 1 has more than 4,000,000 bytes"),
    "columns.csv": (b"," * 100_000 + b"\n1\n", "has more than 100,000 columns, the maximum"),
    "zeros.ulg": (ULOG + bytes(10**6), "no sample"),
}


@pytest.mark.parametrize("name", ENDLESS)
def test_what_would_take_for_ever_is_refused_at_once(name, tmp_path):
    data, message = ENDLESS[name]
    (tmp_path / name).write_bytes(data)
    assert message in refused(tmp_path / name)


@pytest.mark.parametrize(("name", "pack"), PACK.items())
@pytest.mark.parametrize("lies", [False, True])
def test_chunks_unpack_to_what_they_may_and_no_further(name, pack, lies, tmp_path, monkeypatch):
    monkeypatch.setattr(bag_files, "MAX_CHUNK", 10**5)
    size, path = 1000 if lies else 10**6, tmp_path / "a.mcap"
    path.write_bytes(MCAP + mcap_chunk(pack(bytes(10**6)), name, size))
    asked, unpack = [], bag_files.BagFile._unpack
    monkeypatch.setattr(bag_files.BagFile, "_unpack", lambda *a: asked.append(unpack(*a)) or asked[-1])
    assert ("a record of the kind 0" if lies else "unpacks to 1,000,000 bytes; the maximum is 100,000") in refused(path)
    assert all(len(chunk) <= 1000 for chunk in asked) and len(asked) == lies


def test_limits_of_size_are_named_before_memory_is_full(tmp_path, monkeypatch):
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(b"t,px,py,pz\n" + b"0,0,0,0\n" * 200_000))
    monkeypatch.setattr(sources, "MAX_UNPACKED", 10**6)
    assert "has more than 1,000,000 bytes when it is unpacked" in refused(path)
    monkeypatch.undo()
    monkeypatch.setattr(sources, "MAX_ROWS", 1000)
    assert "has more than 1,000 lines" in refused(path)
    with open(tmp_path / "large.csv", "wb") as file:
        file.truncate(10**11)  # which takes no room on the disk
    assert "has more than 2,000,000,000 bytes, the maximum" in refused(tmp_path / "large.csv")


def test_a_pipe_a_socket_and_a_device_are_refused_unopened(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "link.csv").symlink_to("/dev/zero")
    monitor = socket.socket(socket.AF_UNIX)
    monitor.bind(str(tmp_path / "socket"))
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [a.mcap]}")
    os.mkfifo(folder / "a.mcap")
    for path in (tmp_path / "pipe.csv", tmp_path / "link.csv", tmp_path / "socket", folder, Path("/dev/zero")):
        assert "is not a regular file but a pipe, a socket or a device" in refused(path)
    monitor.close()


TOPICS = "CREATE TABLE topics(id, name, type, serialization_format);"
TOPICS += "INSERT INTO topics VALUES(1, '/pose', 'geometry_msgs/msg/PoseStamped', 'cdr'), (NULL, NULL, 5, 'cdr');"
RECURSIVE = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT 1 topic_id, x timestamp, x'00' data"
ROWS = "CREATE TABLE messages(topic_id, timestamp, data);"
BASES = {  # tables of messages: without end, made, of other columns or types, and none
    f"CREATE VIEW messages AS {RECURSIVE} FROM c;": "no plain table of messages",
    "CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(9)));": "no plain table",
    "CREATE TABLE messages(a, b);": "no such column",
    f"{ROWS}INSERT INTO messages VALUES(1, 'a', 5);": "no messages",
    "": "no plain table of messages",
}


@pytest.mark.parametrize(("sql", "message"), BASES.items())
def test_a_database_that_is_no_bag_is_refused(sql, message, tmp_path):
    with sqlite3.connect(tmp_path / "a.db3") as connection:
        connection.executescript(TOPICS + sql)
    connection.close()
    assert message in refused(tmp_path / "a.db3")


@pytest.mark.parametrize("packed", ["STORAGE", "FILE", "MESSAGE", "bz2", "lz4"])
def test_packed_bags_are_read(packed, tmp_path):
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin

    def pack(writer):
        if ros2:
            writer.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
        else:
            writer.set_compression(Writer1.CompressionFormat[packed.upper()])

    ros2 = packed.isupper()
    storage = StoragePlugin.MCAP if packed == "STORAGE" else StoragePlugin.SQLITE3
    log = read_log(write_bag(tmp_path / "a.bag", ros2=ros2, storage=storage, pack=pack), BATTERY)
    np.testing.assert_allclose(log.position[200:800], flight(log.time)["position"][200:800], atol=2e-3)


def test_a_clock_that_jumps_ahead_is_refused_before_it_is_put_on_a_grid(tmp_path):
    t = times(100)
    path = write_csv(tmp_path / "a.csv", own_table(t) | {"t": t + 1e7 * (t > 5.0)})
    with pytest.raises(GapsTooLarge, match=r"1e\+09 steps of 0.01 s; the maximum is 1,000,000. The clock of position"):
        read_log(path, TABLE)
    write_csv(path, own_table(t) | {"t": np.where(np.arange(len(t)) == 500, 1e300, t)})
    assert "1 samples of position (x, y, z) are not finite" in str(read_log(path, TABLE))  # damage, and no jump
    long = np.linspace(0.0, 9000.0, 20_000)
    write_csv(path, own_table(t)).write_text("t,x,y,z\n" + "".join(f"{x},0,0,0\n" for x in long))
    table = own_table(t)
    path = write_csv(path, {name: np.interp(long % 10.0, t, x) for name, x in table.items()} | {"t": long})
    with pytest.raises(UnreadableLog, match="Cut it into shorter logs, or give a larger dt"):
        read_log(path, TABLE, dt=0.001)


def test_values_beyond_any_flight_count_as_missing_and_wide_tables_are_read(tmp_path):
    t = times(100)
    columns = own_table(t)
    columns["x"] = np.where(np.arange(len(t)) == 500, 1e38, columns["x"])
    path = write_csv(tmp_path / "a.csv", columns)
    log = read_log(path, TABLE)
    assert np.abs(log.position).max() < 10.0 and "beyond 1e+09" in str(log)
    head, *rows = path.read_text().splitlines()
    names = ",".join(f"c{k}" for k in range(20_000))
    path.write_text("\n".join([f"{head},{names}", *(row + ",text" * 20_000 for row in rows[:300])]))
    assert len(read_log(path, TABLE, min_duration=0.0).time) == 300
