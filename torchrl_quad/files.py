"""Files that are complete or not there, tables in them, and the name of the machine that results come from."""

from __future__ import annotations

import contextlib
import csv
import os
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file atomically: ``with replacing(path) as temporary: temporary.write_text(...)``.

    The temporary file sits beside ``path``, carries the process id in its name, and keeps the suffix. It replaces
    ``path`` when the block ends, and disappears when the block raises. What a killed process left behind is deleted by
    the next one that writes the same path.

    Raises:
        OSError: the folder does not exist, is read-only or is full; ``path`` is then as it was.
    """
    path = Path(path)
    _delete_leftovers(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def is_running(pid: int) -> bool:
    """Whether a process of this machine is alive."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it belongs to somebody else
        return True
    return True


def machine() -> str:
    """Name the processor, such as "AMD EPYC (25-17)", for results whose seconds depend on it.

    Linux says it in /proc/cpuinfo; family and model, in brackets, tell the generations of a make apart. Elsewhere it is
    what Python knows, at least the architecture, such as "arm64".
    """
    try:
        lines = [line.split(":", 1) for line in Path("/proc/cpuinfo").read_text().splitlines() if ":" in line]
        said = {key.strip(): value.strip() for key, value in reversed(lines)}
        generation = "-".join(said[key] for key in ("cpu family", "model") if key in said)
        return f"{said['model name']} ({generation})" if generation else said["model name"]
    except (OSError, KeyError):
        return platform.processor() or platform.machine()


def _delete_leftovers(path: Path) -> None:
    name = re.compile(rf"\.{re.escape(path.stem)}\.(\d+){re.escape(path.suffix)}")
    for other in path.parent.glob(".*"):
        match = name.fullmatch(other.name)
        if match and not is_running(int(match[1])):
            other.unlink(missing_ok=True)


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file; no rows where there is no file."""
    path = Path(path)
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def write_rows(path: str | Path, rows: Sequence[Mapping[str, Any]], missing: object = "") -> None:
    """Write rows to a CSV file, all or nothing. It has the columns of all rows; a cell may be ``missing``."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with replacing(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, names, restval=missing, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
