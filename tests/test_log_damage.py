"""Logs that are damaged, or made to never end: each reads, or is refused by a LogError in one line that names it."""

import gzip
import os
import random
import shutil
import socket
import struct
from pathlib import Path

import numpy as np
import pytest
from log_writers import ULOG, flight, ulog_message, write_csv, write_ulog, write_usd
from test_log_files import px4_messages, times, usd_events, write_bag
from test_log_tables import OURS, own_table

from torchrl_quad.identification import GapsTooLarge, LogError, UnreadableLog, read_log, sources
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


REFUSED = {  # what is no log, or what no reader should follow to its end: a file, and what its refusal says
    "empty.csv": (b"", "is empty"),
    "junk.bin": (bytes(range(128, 256)), "not a log of a known kind"),
    "text.csv": (b"Dear reader,\nthis is a letter.\n", "fewer than two samples"),
    "ragged.csv": (b"t,x\n1,2\n1,2,3\n", "not a table of numbers"),
    "cut.csv.gz": (gzip.compress(random.Random(0).randbytes(2000))[:1000], "broken gz"),
    "cut.ulg": (ULOG[:8], "not a readable ULog"),
    "cut.bag": (b"#ROSBAG V2.0\n", "not a readable ROS bag"),
    "cut.usd": (b"\xbc\x02\x00\x05\x00abc", "header cannot be read: subsection not found"),
    "new.usd": (b"\xbc\x09\x00\x00\x00abcd", "version 9"),
    "nested.ulg": (ulog_of(*(f"a{k}:a{k + 1}[65535] x;" for k in range(9)), "a9:uint8_t[65535] x;"), "no sample"),
    "itself.ulg": (ulog_of("a:uint64_t timestamp;a x;"), "no sample"),
    "nothing.ulg": (ulog_of("a:uint64_t timestamp;b[65535] x;", "b:c[65535] x;", "c:"), "no sample"),
    "wide.ulg": (ulog_of(*(f"a{k}:uint64_t timestamp;uint8_t[65000] x;" for k in range(2000))), "no sample"),
    "zeros.ulg": (ULOG + bytes(10**6), "no sample"),
    "zeros.bag": (b"#ROSBAG V2.0\n" + bytes(1000), "not a readable ROS bag"),
    "zeros.mcap": (b"\x89MCAP0\r\n" + bytes(1000), "not a readable ROS bag: Unexpected record"),
    "zeros.db3": (b"SQLite format 3\0" + bytes(1000), "not a readable ROS bag"),
    "line.csv": (b"t" * 5_000_000, "line 1 has more than 4,000,000 bytes"),
    "columns.csv": (b"," * 100_000 + b"\n1\n", "has more than 100,000 columns, the maximum"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_log_or_would_take_for_ever_is_refused_at_once(name, tmp_path):
    data, message = REFUSED[name]
    (tmp_path / name).write_bytes(data)
    assert message in refused(tmp_path / name)


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


def test_a_pipe_a_socket_and_a_device_are_refused_unopened(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "link.csv").symlink_to("/dev/zero")
    monitor = socket.socket(socket.AF_UNIX)
    monitor.bind(str(tmp_path / "socket"))
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").touch()
    os.mkfifo(folder / "a.mcap")
    for path in (tmp_path / "pipe.csv", tmp_path / "link.csv", tmp_path / "socket", folder, Path("/dev/zero")):
        assert "is not a regular file but a pipe, a socket or a device" in refused(path)
    monitor.close()
    monkeypatch.setattr(Path, "is_file", lambda path: True)  # when it was looked at, before it became a pipe
    assert "is not a regular file" in refused(tmp_path / "pipe.csv")


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
    log = read_log(write_bag(tmp_path / ("a" if ros2 else "a.bag"), ros2=ros2, storage=storage, pack=pack), BATTERY)
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
