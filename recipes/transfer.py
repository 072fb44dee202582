"""Fly an exported policy in a simulator that nobody here wrote, through its contract and without torch.

python recipes/transfer.py bundle=outputs/.../policy simulator=mujoco

It flies one episode from each of the bundle's fresh starts with each rate loop of the simulator, judges them as the
package's own evaluation does, adds a row to ``transfer.csv`` beside the bundle, and prints them. What is there is not
flown again. Settings:

    simulator=mujoco     or rotorpy, crazyflow, torchrl_quad (our own, which needs torch)
    loop=pid             one rate loop alone: contract, pid, pd, or own, RotorPy's
    mutants=true         fly mistakes of a port too, each of which must fail
    scale={mass: 1.2}    fly another drone than the policy was told of
    late=1               control steps by which commands are later than the contract says
    episodes=64          fewer of the starts
    folder=PATH          where transfer.csv and pictures go
    pictures=true        film the first drones beside our own simulator, and write a replay; needs torch and an extra
"""

import csv
import json
import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.deploy import Bundle, load_bundle
from torchrl_quad.deploy.contract import naming
from torchrl_quad.deploy.judging import PRECISION
from torchrl_quad.deploy.simulators import make_simulator, simulator_class
from torchrl_quad.deploy.transfer import MUTANTS, fly
from torchrl_quad.errors import MissingPackage, UserError, UserValueError, shown
from torchrl_quad.files import add_rows, machine, make_folder, read_rows

SETTINGS = {
    "bundle": (str, None),
    "simulator": (str, "mujoco"),
    "loop": (str, None),
    "mutants": (bool, False),
    "scale": (dict, {}),
    "late": (int, 0),
    "episodes": (int, None),
    "folder": (str, None),
    "pictures": (bool, False),
}
LEAST = {"late": 0, "episodes": 1}
KEY = ("bundle", "simulator", "loop", "mutant", "drone", "episodes")  # of a flight; others are its results
SHOWN = ("task", *KEY[1:], "solved", "crash", "precision", "seconds")


def main() -> None:
    sys.stdout.reconfigure(errors="backslashreplace")  # names of files may be anything
    if {"-h", "--help"} & set(sys.argv):
        print(__doc__)
        raise SystemExit(0)
    cfg = settings(sys.argv[1:])
    loops = [cfg["loop"]] if cfg["loop"] else simulator_class(cfg["simulator"]).loops
    if cfg["pictures"]:
        try:
            from torchrl_quad.training.drawing import draw_transfer
        except ImportError as error:
            what = 'pictures=true needs torch and the extra render: pip install ".[render]"'
            raise MissingPackage(f"{what} ({error})") from error
    bundle = load_bundle(cfg["bundle"], on_fault="hover")
    bundle.check()
    folder = make_folder(cfg["folder"] or Path(cfg["bundle"]).resolve().parent)
    shows_queue = bundle.contract["action_queue"]["observed"]  # else nobody misses it
    mistakes = [name for name in MUTANTS if shows_queue or name != "queue"]
    for loop in loops:
        for mutant in [None, *(mistakes if cfg["mutants"] else [])]:
            measure(bundle, cfg, loop, mutant, folder / "transfer.csv")
    show(folder / "transfer.csv", bundle.contract["digest"][:12])
    if cfg["pictures"]:
        with naming(bundle.folder):
            draw_transfer(bundle, cfg["simulator"], loops[0], folder / f"transfer_{cfg['simulator']}")


def measure(bundle: Bundle, cfg: dict, loop: str, mutant: str | None, path: Path) -> None:
    """Fly once, and add the result to the table, unless it is there."""
    contract, about = bundle.contract, {**cfg["scale"], **({"late": cfg["late"]} if cfg["late"] else {})}
    task = contract["task"]["name"]
    starts = len(bundle.starts()["position"])
    with naming(bundle.folder):
        version = make_simulator(cfg["simulator"], contract, loop).version
    flown = {
        "bundle": contract["digest"][:12],
        "simulator": version,
        "loop": loop,
        "mutant": mutant or "none",
        "drone": json.dumps(about, sort_keys=True) if about else "nominal",
        "episodes": str(min(starts, cfg["episodes"] or starts)),
    }
    if any(all(row[name] == flown[name] for name in KEY) for row in flights(path)):
        return
    begin = time.perf_counter()
    wrong = MUTANTS.get(mutant)
    options = {name: cfg[name] for name in ("scale", "late", "episodes")}
    flight = fly(bundle, cfg["simulator"], loop, wrong, **options)
    metric, total, unit, factor = PRECISION[task]
    known = np.isfinite(flight[metric]).any()
    result = {
        "solved": f"{flight['solved'].mean():.4f}",
        "crash": f"{flight['crash'].mean():.4f}",
        "precision": f"{factor * total(flight[metric]):.3g} {unit}" if known else "none",
        "seconds": f"{time.perf_counter() - begin:.1f}",
        "faults": sum(flight["faults"].values()),
        "machine": machine(),
    }
    row, written = {"task": task, **flown, **result}, False
    try:
        add_rows(path, [row])
        written = True
    finally:
        if not written:  # for whatever reason
            print(f"Flown, and not written to {path}:")
            table = csv.DictWriter(sys.stdout, row)
            table.writeheader()
            table.writerow(row)


def flights(path: Path) -> list[dict[str, str]]:
    """The rows of a table of flights; none where there is no table yet.

    Raises:
        ValueError: it is another kind of file.
    """
    wrong, instead = f"{path} is no table of flights", "Move it away, or choose another folder=..."
    try:
        rows = read_rows(path)
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserValueError(f"{wrong}: {error}. {instead}") from error
    if not all(isinstance(row.get(name), str) for row in rows for name in (*KEY, *SHOWN)):
        raise UserValueError(f"{wrong}: a row lacks one of {', '.join(KEY)} or its results. {instead}")
    return rows


def show(path: Path, bundle: str) -> None:
    """Print the flights of a bundle as a table."""
    rows = [dict(zip(SHOWN, SHOWN, strict=True)), *(row for row in flights(path) if row["bundle"] == bundle)]
    widths = [max(len(row[name]) for row in rows) for name in SHOWN]
    for row in rows:
        print("  ".join(row[name].rjust(width) for name, width in zip(SHOWN, widths, strict=True)))
    print(f"\n{path}")


def settings(arguments: list[str]) -> dict[str, Any]:
    """The settings of a command line, ``name=value``; null is the default.

    Raises:
        ValueError: one is unknown, missing, given twice, or of another type.
    """
    cfg: dict[str, Any] = {}
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name not in SETTINGS or not equals:
            choices = ", ".join(f"{x}=..." for x in SETTINGS)
            raise UserValueError(f"unknown setting {shown(argument)}. Choose from: {choices}.")
        if name in cfg:
            raise UserValueError(f"{name} is given twice. Give it once.")
        kind, default = SETTINGS[name]
        cfg[name] = default if value in ("", "null") else READ[kind](name, value)
    cfg = {name: default for name, (_, default) in SETTINGS.items()} | cfg
    if cfg["bundle"] is None:
        raise UserValueError("bundle is missing: write bundle=FOLDER, of a policy that recipes/export.py has written.")
    return cfg


def as_bool(name: str, value: str) -> bool:
    if value.lower() not in ("true", "false"):
        raise UserValueError(f"{name} must be true or false, got {shown(value)}.")
    return value.lower() == "true"


def as_int(name: str, value: str) -> int:
    if not re.fullmatch("[+-]?[0-9]{1,18}", value) or int(value) < LEAST[name]:
        raise UserValueError(f"{name} must be a whole number, at least {LEAST[name]}, got {shown(value)}.")
    return int(value)


def as_factors(name: str, value: str) -> dict[str, float]:
    """A mapping such as {mass: 1.2, inertia: 1.5}, of words to numbers."""
    factors: dict[str, float] = {}
    mapping = value.strip()
    wrong = UserValueError(f"{name} must look like {{mass: 1.2, inertia: 1.5}}, got {shown(value)}.")
    if mapping[:1] != "{" or mapping[1:][-1:] != "}":
        raise wrong
    for pair in filter(str.strip, mapping[1:-1].split(",")):
        field, _, factor = (x.strip().strip("'\"") for x in pair.partition(":"))
        try:
            number = float(factor)
        except ValueError:
            raise wrong from None
        if field in factors:
            raise wrong
        factors[field] = number
    return factors


READ = {str: lambda _, value: value, bool: as_bool, int: as_int, dict: as_factors}


if __name__ == "__main__":
    try:
        main()
    except (UserError, OSError) as error:
        print("Error:", " ".join(str(error).split()), file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("Stopped. What is finished is kept.", file=sys.stderr)
        raise SystemExit(130) from None
