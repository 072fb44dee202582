"""Every file and folder that the package writes: complete or not there, and never replacing anything else.

Nothing here follows a link in the last part of a path, or replaces a pipe, a socket or a device. What several processes
write, on one machine or on a shared disk, they write one after the other.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import itertools
import os
import platform
import re
import shutil
import socket
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

_NUMBERS = itertools.count()  # of this process's temporaries, in whatever thread
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EINVAL)  # what a file system says that has none


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file atomically: ``with replacing(path) as temporary: temporary.write_text(...)``.

    The temporary file is in the same folder, with the same suffix. It replaces ``path`` when the block ends, unless
    that is a folder, a link, or anything else but a plain file (FileExistsError), and disappears when the block raises.
    """
    path = Path(path)
    check_place(path)
    temporary = _temporary(path)
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        check_place(path)  # again: writing took its time
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(folder: Path, check: Callable[[Path], None]) -> Iterator[Path]:
    """Replace a folder as a whole, or make it, by what the block writes into a temporary one.

    ``check`` raises for a folder that must not be replaced, before the block and after it; so does what is no folder.
    """
    make_folder(folder.parent)
    check_place(folder, "folder")
    temporary = _temporary(folder)
    check(folder)
    old = temporary.with_name(f"{temporary.name}.old")  # from which the next writer brings it back, if need be
    temporary.mkdir()
    try:
        yield temporary
        check_place(folder, "folder")
        check(folder)
        if folder.exists():
            os.replace(folder, old)
        os.replace(temporary, folder)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def make_folder(path: str | Path) -> Path:
    """Make a folder, with its parents; a link to one will do. FileExistsError for anything else of that name."""
    path = Path(path)
    if (kind := _kind(path)) and not path.is_dir():
        raise FileExistsError(f"{path} is {kind}, and no folder. Choose another folder.")
    path.mkdir(parents=True, exist_ok=True)
    return path


def check_place(path: Path, wanted: str = "file") -> None:
    """Raise FileExistsError for what exists and is not a plain file, or not a "folder": it must not be replaced."""
    if (kind := _kind(path)) not in (None, f"a {wanted}"):
        raise FileExistsError(f"{path} is {kind}, and no plain {wanted}: it is not replaced. Choose another path.")


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[Path]:
    """Hold a lock file, into which the holder may write, and which is deleted at the end.

    The system frees the lock of a process that dies. Where a file system has no locks, the block runs without. Without
    ``wait``, filelock.Timeout says that another process or thread holds it.
    """
    check_place(path)
    lock = FileLock(path, timeout=-1 if wait else 0, fallback_to_soft=False, thread_local=False)
    try:
        lock.acquire(poll_interval=0.02)
    except OSError as error:
        if isinstance(error, Timeout) or error.errno not in _WITHOUT_LOCKS:
            raise
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)  # while it is held: a process that waits for it makes another
        lock.release()


def machine() -> str:
    """Name the processor, such as "AMD EPYC (25-17)", for results whose seconds depend on it.

    Linux knows its family and model, in brackets; elsewhere it is what Python knows, such as "arm64".
    """
    with contextlib.suppress(OSError, KeyError):
        lines = re.findall(r"^(.+?)\s*: *(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        said = dict(reversed(lines))  # of the first processor
        generation = f" ({said['cpu family']}-{said['model']})" if "cpu family" in said else ""
        return said["model name"] + generation
    return platform.processor() or platform.machine()


# -- tables ------------------------------------------------------------------------------------------------------------


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file, none if it is missing; FileExistsError for a folder, a pipe or the like."""
    path = Path(path)
    if not path.exists():
        return []
    if not path.is_file():
        raise FileExistsError(f"{path} is {_kind(path)}, and no plain file. Give the path of a CSV file.")
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def write_rows(path: str | Path, rows: Sequence[Mapping[str, Any]], missing: object = "") -> None:
    """Write rows to a CSV file, all or nothing. It has the columns of all rows; a cell may be ``missing``."""
    path = Path(path)
    make_folder(path.parent)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with replacing(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, names, restval=missing, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def add_rows(path: str | Path, rows: Sequence[Mapping[str, Any]], same: Sequence[str] = ()) -> None:
    """Add rows to a CSV file, or make it, while other processes add to it, too.

    Rows that agree with one that is added in all of the columns ``same`` give way to it.
    """
    path = Path(path)
    make_folder(path.parent)
    check_place(path)
    with locked(path.with_name(f".{path.name}.lock")):
        own = {tuple(str(row[name]) for name in same) for row in rows} if same else set()
        others = [row for row in read_rows(path) if tuple(row.get(name) for name in same) not in own]
        write_rows(path, [*others, *rows])


# -- temporaries -------------------------------------------------------------------------------------------------------


def _temporary(path: Path) -> Path:
    """A name in the folder of a path that nobody uses; what dead processes of this machine left behind for it goes.

    A folder that was set aside and not replaced comes back.
    """
    name = re.compile(rf"{re.escape(_prefix(path))}(\d+)\.\d+{re.escape(path.suffix)}(\.old)?")
    for other, match in [(other, match) for other in path.parent.glob(".*") if (match := name.fullmatch(other.name))]:
        with contextlib.suppress(OSError):  # another process has deleted it just now
            if match[2] and not any(path.glob("*")):
                os.replace(other, path)
            elif _is_dead(int(match[1])):
                shutil.rmtree(other) if other.is_dir() else other.unlink()
    return path.with_name(f"{_prefix(path)}{os.getpid()}.{next(_NUMBERS)}{path.suffix}")


def _prefix(path: Path) -> str:
    """How this machine's temporaries of a path begin. Containers count as machines: their pids overlap."""
    space = ""
    with contextlib.suppress(OSError):
        space = os.readlink("/proc/self/ns/pid")
    here = hashlib.sha256(f"{socket.gethostname()} {space}".encode()).hexdigest()[:8]
    return f".{path.stem[:40]}.{here}."


def _is_dead(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (OSError, OverflowError) as error:  # others: it belongs to another user, or is no process of this system
        return isinstance(error, ProcessLookupError)
    return False


def _kind(path: Path) -> str | None:
    """What a path is, in words; None where there is nothing."""
    try:
        letter = stat.filemode(os.lstat(path).st_mode)[0]
    except (FileNotFoundError, NotADirectoryError):
        return None
    kinds = {"d": "a folder", "-": "a file", "l": "a link", "p": "a pipe", "s": "a socket"}
    return kinds.get(letter, "a device")
