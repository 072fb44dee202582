"""Tables of what was measured, on the screen and as CSV, with the machine that was measured on."""

from __future__ import annotations

import csv
import os
import platform
from pathlib import Path
from typing import Any

import torch

RESULTS = Path(__file__).parent / "results"


def save(path: Path, rows: list[dict[str, Any]], **about: Any) -> None:
    """Print rows of results, and write them to a CSV file, each with what they are about."""
    about |= {"threads": torch.get_num_threads(), "machine": machine(), "torch": torch.__version__}
    columns = list(dict.fromkeys(key for row in rows for key in row if key not in about))
    widths = [max(len(str(row.get(key, ""))) for row in [*rows, {key: key}]) for key in columns]
    for row in [dict(zip(columns, columns, strict=True)), *rows]:
        print("  ".join(str(row.get(key, "")).rjust(width) for key, width in zip(columns, widths, strict=True)))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys([*columns, *about])))
        writer.writeheader()
        writer.writerows({**about, **row} for row in rows)
    os.replace(temporary, path)
    print(f"\n{path}: {about}")


def finished(path: Path) -> list[dict[str, Any]]:
    """The rows that a CSV file of results holds already."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def machine() -> str:
    """The processor, as the system names it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
