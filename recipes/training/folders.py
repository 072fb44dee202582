"""The folder of a run: made for it alone, and locked while it runs."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import socket
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import IO

from omegaconf import OmegaConf

LOCK = "run.lock"  # names the process that writes into the folder

# A run that resumes goes on in the folder of its checkpoint; hydra.run.dir asks for it by this name.
OmegaConf.register_new_resolver(
    "folder_of", lambda resume, new: new if resume in (None, "auto") else str(Path(resume).parent), replace=True
)


@contextlib.contextmanager
def own_folder(folder: Path, named: bool) -> Iterator[Path]:
    """Hold a folder that no other process writes into, and give it back at the end.

    A folder that the user has named is taken as it is. Otherwise its name is only a proposal: when another run has it,
    the next free one of ``folder_2``, ``folder_3`` and so on is made.

    Raises:
        FileExistsError: another process runs in the folder that was named.
    """
    folder, lock = _claim(folder, named)
    try:
        yield folder
    finally:
        (folder / LOCK).unlink(missing_ok=True)
        lock.close()
        if not named:
            with contextlib.suppress(OSError):  # not empty: it has results
                folder.rmdir()


def _claim(folder: Path, named: bool) -> tuple[Path, IO[str]]:
    for number in itertools.count(1):
        path = folder if number == 1 else folder.with_name(f"{folder.name}_{number}")
        path.mkdir(parents=True, exist_ok=True)
        lock = _lock(path / LOCK)
        if lock is None and named:
            holder = "another process"
            with contextlib.suppress(FileNotFoundError):  # it has ended just now
                holder = (path / LOCK).read_text().strip() or holder
            raise FileExistsError(
                f"{path} is in use by {holder}. Wait for it, stop it, or choose another hydra.run.dir."
            )
        if lock is None:
            continue
        if not named and any(other.name != LOCK for other in path.iterdir()):  # a run that is over
            (path / LOCK).unlink()
            lock.close()
            continue
        lock.write(f"process {os.getpid()} on {socket.gethostname()} since {datetime.now():%Y-%m-%d %H:%M:%S}\n")
        lock.flush()
        return path, lock
    raise AssertionError


def _lock(path: Path) -> IO[str] | None:
    """Lock a file, or return None if a live process holds it. The system drops the lock of a process that dies."""
    while True:
        file = open(path, "a+")  # noqa: SIM115, it stays open as long as the run has the folder
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            return None
        except OSError:  # a file system without locks: go on without
            pass
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                file.truncate(0)
                return file
        file.close()  # its holder has deleted it in between
