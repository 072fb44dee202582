"""The folder of a run: made for it alone, and locked while it runs."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from filelock import Timeout
from omegaconf import OmegaConf

from torchrl_quad.files import locked, make_folder

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
    with contextlib.ExitStack() as stack:
        folder = _claim(folder, named, stack)
        try:
            yield folder
        finally:
            stack.close()
            if not named:
                with contextlib.suppress(OSError):  # not empty: it has results
                    folder.rmdir()


def _claim(folder: Path, named: bool, stack: contextlib.ExitStack) -> Path:
    for number in itertools.count(1):
        path = make_folder(folder if number == 1 else folder.with_name(f"{folder.name}_{number}"))
        with contextlib.ExitStack() as claim:
            try:
                lock = claim.enter_context(locked(path / LOCK, wait=False))
            except Timeout:
                if not named:
                    continue
                holder = "another process"
                with contextlib.suppress(OSError):  # it has ended just now
                    holder = (path / LOCK).read_text().strip() or holder
                raise FileExistsError(
                    f"{path} is in use by {holder}. Wait for it, stop it, or choose another hydra.run.dir."
                ) from None
            if not named and any(other.name != LOCK for other in path.iterdir()):  # a run that is over
                continue
            lock.write_text(
                f"process {os.getpid()} on {socket.gethostname()} since {datetime.now():%Y-%m-%d %H:%M:%S}\n"
            )
            stack.push(claim.pop_all())
            return path
    raise AssertionError
