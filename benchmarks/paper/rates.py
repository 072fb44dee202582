"""Train every recipe with half and twice its learning rate: is what ships the best of the three?

python -m benchmarks.paper.rates --cores 2
python -m benchmarks.paper.rates --tasks landing --methods shac ppo

Every method gets the same: three rates, each with three seeds that shipped.py does not report. A rate is judged by the
worst of its seeds. The hybrid has no rate of its own choice: its bound on the KL divergence takes the place.

It may be stopped at any moment. Started again, it skips what is in benchmarks/paper/data/rates.csv, and resumes what was
cut off. docs/ablations.md shows the table.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from omegaconf import OmegaConf

from benchmarks.paper.ablations import fly_missing
from benchmarks.paper.comparison import LABELS, column
from benchmarks.paper.results import fill
from benchmarks.paper.running import arguments, command_line, composed, page
from benchmarks.paper.shipped import METHODS, TASKS, overrides
from benchmarks.paper.tables import table
from torchrl_quad.files import read_rows

SEEDS = (101, 102, 103)
FACTORS = {"0.5": "half", "1": "as it ships", "2": "twice"}


@cache
def scaled(task: str, method: str, factor: str) -> list[str]:
    """Multiply the learning rates of the policy, from first to last, or what takes their place."""
    names = ["actor.max_kl"] if method == "hybrid" else ["actor.lr", "actor.final_lr"]
    cfg = composed(method, overrides(task, method))
    return [f"{name}={float(factor) * OmegaConf.select(cfg, name):g}" for name in names]


def summary(data: Path) -> str:
    """Show the worst seed of each rate, and how many have flown where some are missing."""
    groups: dict[tuple[str, str], dict[str, list[dict[str, str]]]] = {}
    for row in read_rows(data / "rates.csv"):
        groups.setdefault((row["task"], row["algorithm"]), {}).setdefault(row["factor"], []).append(row)
    lines = []
    for task, method in sorted(groups, key=lambda x: (list(TASKS).index(x[0]), list(METHODS).index(x[1]))):
        cells = []
        for factor in FACTORS:
            runs = groups[task, method].get(factor, [])
            cell = "{:.4g}, {:.1%}".format(*(min(column(runs, x)) for x in ("return", "solved"))) if runs else ""
            cells.append(cell + (f", {len(runs)} of {len(SEEDS)} seeds" if 0 < len(runs) < len(SEEDS) else ""))
        lines.append([LABELS.get(task, task), METHODS[method], *cells])
    return table(["task", "", *FACTORS.values()], lines)


def main() -> None:
    args = arguments(command_line(__doc__, SEEDS, tasks=TASKS, methods=METHODS, factors=FACTORS))
    jobs = [(t, m, f, s) for t in args.tasks for m in args.methods for s in args.seeds for f in args.factors]
    flown = [(t, m, f, s, f"x{f}", scaled(t, m, f)) for t, m, f, s in jobs]
    fly_missing(args, args.data / "rates.csv", "factor", flown)
    fill(page(args.data, "ablations.md"), {"rates": summary(args.data)})


if __name__ == "__main__":
    main()
