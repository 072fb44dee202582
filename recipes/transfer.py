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

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchrl_quad.deploy import Bundle, load_bundle
from torchrl_quad.deploy.judging import PRECISION
from torchrl_quad.deploy.simulators import make_simulator, simulator_class
from torchrl_quad.deploy.transfer import MUTANTS, fly
from torchrl_quad.errors import UserValueError
from torchrl_quad.files import add_rows, machine, read_rows

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
KEY = ("bundle", "simulator", "loop", "mutant", "drone", "episodes")  # of a flight; others are its results
SHOWN = ("task", *KEY[1:], "solved", "crash", "precision", "seconds")


def main() -> None:
    if {"-h", "--help"} & set(sys.argv):
        print(__doc__)
        raise SystemExit(0)
    cfg = settings(sys.argv[1:])
    bundle = load_bundle(cfg["bundle"], on_fault="hover")
    bundle.check()
    folder = Path(cfg["folder"] or Path(cfg["bundle"]).resolve().parent)
    loops = [cfg["loop"]] if cfg["loop"] else simulator_class(cfg["simulator"]).loops
    shows_queue = bundle.contract["action_queue"]["observed"]  # else nobody misses it
    mistakes = [name for name in MUTANTS if shows_queue or name != "queue"]
    for loop in loops:
        for mutant in [None, *(mistakes if cfg["mutants"] else [])]:
            measure(bundle, cfg, loop, mutant, folder / "transfer.csv")
    show(folder / "transfer.csv", bundle.contract["digest"][:12])
    if cfg["pictures"]:
        from training.drawing import draw_transfer

        draw_transfer(bundle, cfg["simulator"], loops[0], folder / f"transfer_{cfg['simulator']}")


def measure(bundle: Bundle, cfg: dict, loop: str, mutant: str | None, path: Path) -> None:
    """Fly once, and add the result to the table, unless it is there."""
    contract, about = bundle.contract, {**cfg["scale"], **({"late": cfg["late"]} if cfg["late"] else {})}
    task = contract["task"]["name"]
    starts = len(bundle.starts()["position"])
    flown = {
        "bundle": contract["digest"][:12],
        "simulator": make_simulator(cfg["simulator"], contract, loop).version,
        "loop": loop,
        "mutant": mutant or "none",
        "drone": json.dumps(about, sort_keys=True) if about else "nominal",
        "episodes": str(min(starts, cfg["episodes"] or starts)),
    }
    rows = read_rows(path)
    if any(all(row[name] == flown[name] for name in KEY) for row in rows):
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
    add_rows(path, [{"task": task, **flown, **result}])


def show(path: Path, bundle: str) -> None:
    """Print the flights of a bundle as a table."""
    rows = [dict(zip(SHOWN, SHOWN, strict=True)), *(row for row in read_rows(path) if row["bundle"] == bundle)]
    widths = [max(len(row[name]) for row in rows) for name in SHOWN]
    for row in rows:
        print("  ".join(row[name].rjust(width) for name, width in zip(SHOWN, widths, strict=True)))
    print(f"\n{path}")


def settings(arguments: list[str]) -> dict[str, Any]:
    """The settings of a command line, ``name=value`` with values in YAML.

    Raises:
        ValueError: one is unknown, missing, or of another type.
    """
    cfg = {name: default for name, (_, default) in SETTINGS.items()}
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name not in SETTINGS or not equals:
            raise UserValueError(
                f"unknown setting {argument!r}. Choose from: {', '.join(f'{x}=...' for x in SETTINGS)}."
            )
        cfg[name] = yaml.safe_load(value)
        if cfg[name] is None:
            cfg[name] = SETTINGS[name][1]
        elif type(cfg[name]) is not SETTINGS[name][0]:
            raise UserValueError(f"{argument}: {name} must be a {SETTINGS[name][0].__name__}.")
    if cfg["bundle"] is None:
        raise UserValueError("bundle is missing: write bundle=FOLDER, of a policy that recipes/export.py has written.")
    if cfg["late"] < 0 or (cfg["episodes"] is not None and cfg["episodes"] < 1):
        raise UserValueError(
            f"late must be at least 0, and episodes at least 1; got {cfg['late']} and {cfg['episodes']}."
        )
    return cfg


if __name__ == "__main__":
    try:
        main()
    except (ValueError, OSError, ImportError) as error:
        print(f"Error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("Stopped. What is finished is kept.", file=sys.stderr)
        raise SystemExit(130) from None
