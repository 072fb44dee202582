"""Tables of what was measured, on the screen and as CSV, with the machine that was measured on."""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

from torchrl_quad.files import machine, write_rows

RESULTS = Path(__file__).parent / "results"


def command_line(doc: str, output: str, **options: Any) -> argparse.Namespace:
    """The options of a program with their defaults, which give their types; those with a list take several values."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    for name, default in options.items():
        several = isinstance(default, list)
        kind, count = type((default or [""])[0] if several else default), {"nargs": "*"} if several else {}
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, default=default, **count)
    parser.add_argument("--output", type=Path, default=RESULTS / output)
    torch.set_num_threads(1)
    return parser.parse_args()


def save(path: Path, rows: list[dict[str, Any]], **about: Any) -> None:
    """Print rows of results, and write them to a CSV file, each with what they are about."""
    about |= {"threads": torch.get_num_threads(), "machine": machine(), "torch": torch.__version__}
    columns = list(dict.fromkeys(key for row in rows for key in row if key not in about))
    widths = [max(len(str(row.get(key, ""))) for row in [*rows, {key: key}]) for key in columns]
    for row in [dict(zip(columns, columns, strict=True)), *rows]:
        print("  ".join(str(row.get(key, "")).rjust(width) for key, width in zip(columns, widths, strict=True)))
    write_rows(path, [{name: ({**about, **row}).get(name, "") for name in [*columns, *about]} for row in rows])
    print(f"\n{path}: {about}")


def in_own_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns in a fresh process, whose memory and modules are its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()
