"""The folder of a bundle: replaced as a whole, and never together with files that are not its own."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from torchrl_quad.deploy import contract as contracts
from torchrl_quad.files import is_running


def restore(folder: Path) -> None:
    """Bring back a bundle that a killed export had set aside, and delete what else it left behind."""
    old = folder.with_name(f".{folder.name}.old")
    if old.exists() and not any(folder.glob("*")):
        os.replace(old, folder)
    shutil.rmtree(old, ignore_errors=True)
    temporary = re.compile(rf"\.{re.escape(folder.name)}\.(\d+)\.new")
    for other in folder.parent.glob(".*.new"):
        match = temporary.fullmatch(other.name)
        if match and not is_running(int(match[1])):
            shutil.rmtree(other, ignore_errors=True)


def require_replaceable(folder: Path) -> None:
    """Refuse a folder that holds something else than a bundle, or files beside one.

    Raises:
        FileExistsError: it does.
    """
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if folder.is_file() or (names and not (folder / "contract.json").is_file()):
        raise FileExistsError(f"{folder} exists and is no bundle. Choose another folder, or empty this one.")
    if others := sorted(names - {*contracts.FILES, "contract.json"}):
        raise FileExistsError(
            f"{folder} also holds {', '.join(others)}: an export replaces the folder, and would delete that. Move it "
            "away, or choose another folder."
        )


@contextlib.contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that takes the place of ``folder`` when the block ends, and disappears when it raises."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary, old = (folder.with_name(f".{folder.name}.{end}") for end in (f"{os.getpid()}.new", "old"))
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
        yield temporary
        require_replaceable(folder)  # again: flying took its time
        if folder.exists():
            os.replace(folder, old)
        os.replace(temporary, folder)
    except BaseException:
        if old.exists() and not folder.exists():
            os.replace(old, folder)
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)
