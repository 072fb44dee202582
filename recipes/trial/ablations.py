"""Change one option of the recipes at a time: what is each of them worth on landing, and on racing?

python recipes/trial/ablations.py --cores 2
python recipes/trial/ablations.py --tasks landing --methods shac --changes "KL bound" --seeds 0

It may be stopped at any moment. Started again, it skips what is in docs/results/data/ablations.csv, and resumes what
was cut off. What the recipes reach as they ship is in shipped.csv beside it. docs/ablations.md shows the table.
"""

from __future__ import annotations

import argparse
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from comparison import LABELS, column
from reproduce import DATA, stop, write
from results import fill
from shipped import ADDING, METHODS, train
from tables import table

from torchrl_quad.files import read_rows as read

OPTIONS = {  # with it, and without it
    "event times": ("env.event_discount", "${gamma}", "null"),
    "clip": ("loss.clip_action_gradient", "2", "null"),
    "KL bound": ("actor.max_kl", "0.05", "null"),
    "correlated noise": ("actor.noise_correlation", "0.9", "0"),
    "fixed noise": ("actor.learn_scale", "false", "true"),  # noise that stays as large as it starts
    "average": ("actor.average", "0.1", "null"),
}
CHANGES = {
    f"{no}{x}": f"{key}={value}" for x, (key, *v) in OPTIONS.items() for no, value in zip(("", "no "), v, strict=True)
}
TASKS, OF_METHODS, SEEDS = ("landing", "racing", "racing_position"), ("bptt", "shac", "abpt"), tuple(range(5))
IN_RACING = {"event times", "clip", "correlated noise", "fixed noise", "average"}
SHIPS_WITH = {  # task and method: which of the options they have; the others have none
    **{("landing", method): {"event times", "average"} for method in ("bptt", "shac")},
    **{(task, method): IN_RACING for task in ("racing", "racing_position") for method in OF_METHODS},
    ("racing", "shac"): IN_RACING - {"average"},
}


def is_change(task: str, method: str, change: str) -> bool:
    """Whether it differs from what ships."""
    has = change.removeprefix("no ") in SHIPS_WITH.get((task, method), ())
    return change.startswith("no ") == has


def fly(task: str, method: str, change: str, seed: int, output: Path, data: Path, quick: bool) -> None:
    """Train once with a change, and add the final evaluation to the results."""
    folder = output / task / method / change.replace(" ", "_") / f"seed{seed}"
    row = train(task, method, seed, folder, quick, [CHANGES[change]])
    with ADDING:
        write(data / "ablations.csv", [*read(data / "ablations.csv"), {"change": change} | row])


def summary(data: Path) -> str:
    """Show what each method reaches as it ships and with each change, over the seeds that have flown with a change."""
    shipped, changed = read(data / "shipped.csv"), read(data / "ablations.csv")
    lines = []
    for task, method in dict.fromkeys((row["task"], row["algorithm"]) for row in changed):
        of_change: dict[str, list[dict[str, str]]] = {}
        for row in changed:
            if (row["task"], row["algorithm"]) == (task, method):
                of_change.setdefault(row["change"], []).append(row)
        seeds = {row["seed"] for rows in of_change.values() for row in rows}
        of_change[""] = [
            row for row in shipped if (row["task"], row["algorithm"]) == (task, method) and row["seed"] in seeds
        ]
        for change in ("", *CHANGES):
            if rows := of_change.get(change):
                returns, solved = (column(rows, name) for name in ("return", "solved"))
                reached = f"{np.mean(returns):.4g} ({min(returns):.4g})"
                names = (LABELS.get(task, task), METHODS[method], change or "as it ships", str(len(rows)))
                lines.append([*names, reached, f"{np.mean(solved):.1%} ({min(solved):.1%})"])
    return table(["task", "", "", "seeds", "return (worst)", "solved (worst)"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cores", type=int, default=os.cpu_count(), help="runs at the same time")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--methods", nargs="+", default=list(OF_METHODS), choices=OF_METHODS)
    parser.add_argument("--changes", nargs="+", default=list(CHANGES), choices=list(CHANGES))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the results")
    parser.add_argument("--output", type=Path, default=Path("outputs/ablations"), help="folder of the runs")
    parser.add_argument("--quick", action="store_true", help="runs of a few steps, to see that everything works")
    args = parser.parse_args()
    ships = args.data.resolve() == DATA.resolve()
    if args.quick and ships:
        parser.error("--quick gives no results to keep: name another folder with --data.")
    names = ("task", "algorithm", "change", "seed")
    kept = {tuple(row[name] for name in names) for row in read(args.data / "ablations.csv")}
    jobs = [(t, m, c, s) for s in args.seeds for t in args.tasks for m in args.methods for c in args.changes]
    todo = [job for job in jobs if is_change(*job[:3]) and (*job[:3], str(job[3])) not in kept]
    with ThreadPoolExecutor(args.cores) as pool:
        for future in [pool.submit(fly, *job, args.output, args.data, args.quick) for job in todo]:
            future.result()
    fill((DATA.parents[1] if ships else args.data) / "ablations.md", {"ablations": summary(args.data)})


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, stop)
    main()
