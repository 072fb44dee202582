"""Change one option of the recipes at a time: what is each of them worth on landing, and on racing?

python -m benchmarks.paper.ablations --cores 2
python -m benchmarks.paper.ablations --tasks landing --methods shac --changes "KL bound" --seeds 0

It may be stopped at any moment. Started again, it skips what is in benchmarks/paper/data/ablations.csv, and resumes what
was cut off. What the recipes reach as they ship is in shipped.csv beside it. docs/ablations.md shows the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.paper.comparison import LABELS, column
from benchmarks.paper.results import fill
from benchmarks.paper.running import arguments, command_line, page, side_by_side
from benchmarks.paper.shipped import METHODS, train
from benchmarks.paper.tables import table
from torchrl_quad.files import add_rows, read_rows

Job = tuple[str, str, str, int, str, Sequence[str]]

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


def fly_missing(args: argparse.Namespace, path: Path, column: str, jobs: Iterable[Job]) -> None:
    """Train what has no row yet, several runs at the same time.

    Args:
        args: the command line.
        path: of the results.
        column: which holds the name of the change.
        jobs: task, method, name of the change, seed, name of the folder of the change, and its overrides.
    """
    kept = {tuple(row[name] for name in ("task", "algorithm", column, "seed")) for row in read_rows(path)}

    def fly(task: str, method: str, change: str, seed: int, folder: str, overrides: Sequence[str]) -> None:
        row = train(task, method, seed, args.output / task / method / folder / f"seed{seed}", args.quick, overrides)
        add_rows(path, [{column: change} | row])

    side_by_side(args.cores, [(fly, *job) for job in jobs if (*job[:3], str(job[3])) not in kept])


def summary(data: Path) -> str:
    """Show what each method reaches as it ships and with each change, over the seeds that have flown with a change."""
    shipped, changed = read_rows(data / "shipped.csv"), read_rows(data / "ablations.csv")
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
    args = arguments(command_line(__doc__, SEEDS, tasks=TASKS, methods=OF_METHODS, changes=CHANGES))
    jobs = [(t, m, c, s) for s in args.seeds for t in args.tasks for m in args.methods for c in args.changes]
    flown = [(*job, job[2].replace(" ", "_"), [CHANGES[job[2]]]) for job in jobs if is_change(*job[:3])]
    fly_missing(args, args.data / "ablations.csv", "change", flown)
    fill(page(args.data, "ablations.md"), {"ablations": summary(args.data)})


if __name__ == "__main__":
    main()
