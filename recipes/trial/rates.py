"""Train every recipe with half and twice its learning rate: is what ships the best of the three?

python recipes/trial/rates.py --cores 2
python recipes/trial/rates.py --tasks landing --methods shac ppo

Every method gets the same: three rates, each with three seeds that are reported nowhere else. A rate is judged by the
worst of its seeds. The hybrid has no rate of its own choice: its bound on the KL divergence takes the place.

It may be stopped at any moment. Started again, it skips what is in docs/results/data/rates.csv, and resumes what was
cut off. docs/ablations.md shows the table.
"""

from __future__ import annotations

import argparse
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from comparison import LABELS, column
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from reproduce import DATA, RECIPES, stop, write
from results import fill
from shipped import ADDING, METHODS, TASKS, overrides, train
from tables import table

from torchrl_quad.files import read_rows as read

SEEDS = (101, 102, 103)
FACTORS = {"0.5": "half", "1": "as it ships", "2": "twice"}
OF_METHODS = ("bptt", "shac", "abpt", "hybrid", "ppo")


def scaled(task: str, method: str, factor: str) -> list[str]:
    """Multiply the learning rates of the policy, from first to last, or what takes their place."""
    names = ["actor.max_kl"] if method == "hybrid" else ["actor.lr", "actor.final_lr"]
    with initialize_config_dir(str(RECIPES / "config"), version_base=None):
        cfg = compose(method, overrides(task, method))
    return [f"{name}={float(factor) * OmegaConf.select(cfg, name):g}" for name in names]


def fly(task: str, method: str, factor: str, seed: int, output: Path, data: Path, quick: bool) -> None:
    """Train once, and add the final evaluation to the results."""
    folder = output / task / method / f"x{factor}" / f"seed{seed}"
    row = train(task, method, seed, folder, quick, scaled(task, method, factor))
    with ADDING:
        write(data / "rates.csv", [*read(data / "rates.csv"), {"factor": factor} | row])


def summary(data: Path) -> str:
    """Show the worst seed of each rate, and how many have flown where some are missing."""
    groups: dict[tuple[str, str], dict[str, list[dict[str, str]]]] = {}
    for row in read(data / "rates.csv"):
        groups.setdefault((row["task"], row["algorithm"]), {}).setdefault(row["factor"], []).append(row)
    lines = []
    for task, method in sorted(groups, key=lambda x: (list(TASKS).index(x[0]), OF_METHODS.index(x[1]))):
        cells = []
        for factor in FACTORS:
            runs = groups[task, method].get(factor, [])
            cell = "{:.4g}, {:.1%}".format(*(min(column(runs, x)) for x in ("return", "solved"))) if runs else ""
            cells.append(cell + (f", {len(runs)} of {len(SEEDS)} seeds" if 0 < len(runs) < len(SEEDS) else ""))
        lines.append([LABELS.get(task, task), METHODS[method], *cells])
    return table(["task", "", *FACTORS.values()], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cores", type=int, default=os.cpu_count(), help="runs at the same time")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--methods", nargs="+", default=list(OF_METHODS), choices=OF_METHODS)
    parser.add_argument("--factors", nargs="+", default=list(FACTORS), choices=list(FACTORS))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the results")
    parser.add_argument("--output", type=Path, default=Path("outputs/rates"), help="folder of the runs")
    parser.add_argument("--quick", action="store_true", help="runs of a few steps, to see that everything works")
    args = parser.parse_args()
    ships = args.data.resolve() == DATA.resolve()
    if args.quick and ships:
        parser.error("--quick gives no results to keep: name another folder with --data.")
    names = ("task", "algorithm", "factor", "seed")
    kept = {tuple(row[name] for name in names) for row in read(args.data / "rates.csv")}
    jobs = [(t, m, f, s) for t in args.tasks for m in args.methods for s in args.seeds for f in args.factors]
    todo = [job for job in jobs if (*job[:3], str(job[3])) not in kept]
    with ThreadPoolExecutor(args.cores) as pool:
        for future in [pool.submit(fly, *job, args.output, args.data, args.quick) for job in todo]:
            future.result()
    fill((DATA.parents[1] if ships else args.data) / "ablations.md", {"rates": summary(args.data)})


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, stop)
    main()
