"""Files and folders are complete or not there, and what is neither file nor folder is never replaced."""

import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from helpers import refuses

from torchrl_quad import files
from torchrl_quad.files import add_rows, locked, make_folder, read_rows, replacing, replacing_folder, write_rows


def socket_file(path):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def link(make):
    """Makes a link to what another function makes."""

    def make_link(path):
        make(path.parent / "target")
        path.symlink_to(path.parent / "target")

    return make_link


def plain_file(path):
    path.write_text("mine")


fifo, folder, link_to_a_file = os.mkfifo, os.mkdir, link(plain_file)


def write_a_file(path):
    with replacing(path) as temporary:
        temporary.write_text("ours")


def write_a_folder(path):
    with replacing_folder(path, lambda _: None) as temporary:
        (temporary / "file").write_text("ours")


def lock(path):
    with locked(path):
        path.write_text("ours")


dangling_link, looping_link = link(lambda path: None), lambda path: path.symlink_to(path)
NEITHER = [fifo, socket_file, link_to_a_file, link(folder), dangling_link, looping_link]
FILES = write_a_file, lock, lambda path: write_rows(path, [{"a": 1}]), lambda path: add_rows(path, [{"a": 1}])
WRITERS = {  # what a path must not be for each
    **{write: [*NEITHER, folder] for write in FILES},
    write_a_folder: [*NEITHER, plain_file],
    make_folder: [fifo, socket_file, link_to_a_file, dangling_link, looping_link, plain_file],
}


def everything_in(folder):
    found = sorted(folder.iterdir())
    return [(x.name, os.lstat(x).st_ino, os.lstat(x).st_mode, x.read_text() if x.is_file() else "") for x in found]


@pytest.mark.parametrize(("write", "make"), [(write, make) for write, kinds in WRITERS.items() for make in kinds])
def test_what_is_neither_file_nor_folder_is_refused_and_stays(write, make, tmp_path):
    path = tmp_path / "place"
    make(path)
    before = everything_in(tmp_path)
    refuses(rf"{path} is a (pipe|socket|link|folder|file), and no", write, path, error=FileExistsError)
    assert everything_in(tmp_path) == before


@pytest.mark.parametrize("make", [fifo, link_to_a_file])
def test_what_takes_the_place_while_a_file_is_written_stays_too(make, tmp_path):
    with pytest.raises(FileExistsError, match="place is a"), replacing(tmp_path / "place"):
        make(tmp_path / "place")
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_threads_and_nested_writers_of_one_file_do_not_meet(tmp_path):
    path = tmp_path / "table.csv"

    def write(number):
        for _ in range(50):
            with replacing(path) as temporary:
                temporary.write_text(f"{number}" * 1000)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(8)))
    assert len(set(path.read_text())) == 1 and len(path.read_text()) == 1000
    with replacing(path) as outer:
        outer.write_text("outer")
        write_a_file(path)
    assert path.read_text() == "outer" and list(tmp_path.iterdir()) == [path]


def test_leftovers_of_dead_processes_go_and_those_of_other_machines_and_the_living_stay(tmp_path, monkeypatch):
    path, dead = tmp_path / "table.csv", 2**22 + 1  # more than Linux counts processes
    prefix = files._prefix(path)
    left = tmp_path / f"{prefix}{dead}.0.csv"
    living = tmp_path / f"{prefix}{os.getpid()}.999999.csv"
    monkeypatch.setattr(socket, "gethostname", lambda: "elsewhere")
    theirs = tmp_path / f"{files._prefix(path)}{dead}.0.csv"
    monkeypatch.undo()
    for other in (left, living, theirs):
        other.touch()
    write_a_file(path)
    assert set(tmp_path.iterdir()) == {path, living, theirs}


def test_processes_that_add_to_one_table_lose_no_row(tmp_path):
    path = tmp_path / "results.csv"
    program = "import sys; from torchrl_quad.files import add_rows\n"
    program += "for i in range(20): add_rows(sys.argv[1], [{'who': sys.argv[2], 'i': i, f'own{sys.argv[2]}': 1}])"
    running = [subprocess.Popen([sys.executable, "-c", program, path, str(who)]) for who in range(4)]
    assert [process.wait() for process in running] == [0] * 4
    wanted = [(str(w), i) for w in range(4) for i in range(20)]
    assert sorted((row["who"], int(row["i"])) for row in read_rows(path)) == wanted
    assert list(tmp_path.iterdir()) == [path]
    add_rows(path, [{"who": "2", "i": 3, "own2": 5}], same=("who", "i"))
    assert [row["own2"] for row in read_rows(path) if (row["who"], row["i"]) == ("2", "3")] == ["5"]
    assert len(read_rows(path)) == 80
