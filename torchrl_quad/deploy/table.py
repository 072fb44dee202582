"""Flights of a bundle in simulators as rows of a table, to which more are added later."""

from __future__ import annotations

import csv
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from torchrl_quad.deploy.bundle import Bundle
from torchrl_quad.deploy.contract import naming
from torchrl_quad.deploy.judging import summary
from torchrl_quad.deploy.simulators import make_simulator
from torchrl_quad.deploy.transfer import MUTANTS, fly
from torchrl_quad.errors import UserValueError
from torchrl_quad.files import add_rows, machine, read_rows

KEY = ("bundle", "simulator", "loop", "mutant", "drone", "episodes")  # of a flight; the others are its results
SHOWN = ("task", *KEY[1:], "solved", "crash", "metrics", "seconds")


def measure(
    bundle: Bundle,
    path: Path,
    simulator: str,
    loop: str,
    mutant: str = "none",
    *,
    scale: Mapping[str, float] | None = None,
    late: int = 0,
    episodes: int | None = None,
) -> None:
    """Fly once, and add the result to a table, unless it is there; the arguments are those of ``fly``.

    Raises:
        ValueError: the file is no table of flights, or an argument is one that ``fly`` refuses.
        OSError: the result cannot be written; then it is printed.
    """
    task = bundle.contract["task"]
    about = {**(scale or {}), **({"late": late} if late else {})}
    starts = len(bundle.starts()["position"])
    with naming(bundle.folder):
        version = make_simulator(simulator, bundle.contract, loop).version
    flown = {
        "bundle": bundle.contract["digest"][:12],
        "simulator": version,
        "loop": loop,
        "mutant": mutant,
        "drone": json.dumps(about, sort_keys=True) if about else "nominal",
        "episodes": str(min(starts, episodes or starts)),
    }
    if any(all(row[name] == flown[name] for name in KEY) for row in _rows(path)):
        return
    begin = time.perf_counter()
    flight = fly(bundle, simulator, loop, MUTANTS.get(mutant), scale=scale, late=late, episodes=episodes)
    metrics = {name: x for name, x in flight["metrics"].items() if name not in ("solved", "crash")}
    totals = summary({name: task["metrics"][name] for name in metrics}, metrics)
    row = {
        "task": task["name"],
        **flown,
        **{name: f"{flight['metrics'][name].mean():.4f}" for name in ("solved", "crash")},
        "metrics": "; ".join(f"{task['metrics'][name]['label']} {value}" for name, value in totals.items()),
        "seconds": f"{time.perf_counter() - begin:.1f}",
        "faults": sum(flight["faults"].values()),
        "machine": machine(),
    }
    try:
        add_rows(path, [row])
    except BaseException:
        print(f"Flown, and not written to {path}:")
        table = csv.DictWriter(sys.stdout, row)
        table.writeheader()
        table.writerow(row)
        raise


def table(path: Path, bundle: Bundle) -> str:
    """The flights of a bundle as a table, and the path of the file."""
    own = [row for row in _rows(path) if row["bundle"] == bundle.contract["digest"][:12]]
    rows = [dict(zip(SHOWN, SHOWN, strict=True)), *own]
    widths = {name: max(len(row[name]) for row in rows) for name in SHOWN}
    lines = ["  ".join(row[name].rjust(widths[name]) for name in SHOWN) for row in rows]
    return "\n".join((*lines, "", str(path)))


def _rows(path: Path) -> list[dict[str, str]]:
    wrong, instead = f"{path} is no table of flights", "Move it away, or choose another folder=..."
    try:
        rows = read_rows(path)
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserValueError(f"{wrong}: {error}. {instead}") from error
    if not all(isinstance(row.get(name), str) for row in rows for name in (*KEY, *SHOWN)):
        raise UserValueError(f"{wrong}: a row lacks one of {', '.join(KEY)} or its results. {instead}")
    return rows
