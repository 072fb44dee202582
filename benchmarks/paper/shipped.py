"""Fly every recipe on every task as it ships, over ten seeds, and fill in the table of the README.

python -m benchmarks.paper.shipped --cores 2
python -m benchmarks.paper.shipped --tasks mypackage.WindowEnv --data FOLDER   # a task of your own; the table in FOLDER
python -m benchmarks.paper.shipped --tasks six_gates six_gates_back --data FOLDER   # a track it was not tuned on

It may be stopped at any moment. Started again, it skips what is in benchmarks/paper/data/shipped.csv, and resumes what was
cut off. The README shows each method on each task: the episodes solved over all seeds, and by the worst of them.
docs/choosing.md compares the methods.
"""

from __future__ import annotations

import datetime
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.paper.comparison import (
    LABELS,
    WANTED,
    choice_table,
    draw,
    improvement_table,
    reached_table,
    speed_table,
)
from benchmarks.paper.evidence import Starts
from benchmarks.paper.matrix import EVALUATIONS
from benchmarks.paper.reproduce import CURVE, OWN, known_task
from benchmarks.paper.results import fill
from benchmarks.paper.running import DATA, QUICK, RECIPES, arguments, command_line, run, ships, side_by_side
from benchmarks.paper.tables import table
from torchrl_quad.envs import task_class
from torchrl_quad.envs.metrics import EPISODE_METRICS
from torchrl_quad.envs.racing import load_track
from torchrl_quad.files import add_rows, machine, read_rows

SEEDS = tuple(range(WANTED))
METHODS = {name: name.upper() for name in ("bptt", "shac", "abpt", "sapo", "ahac")} | {"hybrid": "Hybrid", "ppo": "PPO"}
TASKS = {  # what is shown of each beside the solved episodes: column, factor, digits, unit
    "hovering": ("position_error", 100, 1, "cm"),
    "tracking": ("tracking_rmse", 100, 1, "cm"),
    "landing": ("landing_speed", 1, 2, "m/s"),
    "racing": ("gates_passed", 1, 1, "gates"),
    "racing_position": ("gates_passed", 1, 1, "gates"),
}
VARIANTS = {  # of a task: its overrides
    "racing_position": ["task=racing", "env.reward=position"],
    "six_gates": ["task=racing", "env.track=six_gates"],
    "six_gates_back": ["task=racing", f"env.track={{gates: {load_track('six_gates')['gates'][::-1]}}}"],
}


def train(task: str, method: str, seed: int, folder: Path, quick: bool, changes: Sequence[str] = ()) -> dict[str, str]:
    """Train once, or resume it, with changes of what ships; return the final evaluation, and what it is of."""
    own = [f"seed={seed}", *changes, *(QUICK if quick else ()), "resume=auto", f"hydra.run.dir={folder}"]
    run([sys.executable, str(RECIPES / f"{method}.py"), *overrides(task, method), *own], folder)
    end = folder / "summary.json"
    diverged = {"return": -math.inf, "solved": 0.0, "crash": 1.0}
    summary = json.loads(end.read_text()) if end.exists() else diverged
    seconds = next((row["time/processor_seconds"] for row in read_rows(folder / "metrics.csv")[::-1]), "")
    flown = datetime.date.today().isoformat()
    about = {"task": task, "algorithm": method, "seed": seed, "machine": machine(), "flown": flown, "seconds": seconds}
    summary = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in summary.items()}
    return about | {k: v for k, v in summary.items() if k not in about}


def overrides(task: str, method: str) -> list[str]:
    """Name the task to a recipe; a variant of a task may have tuned values of its own."""
    tuned = f"{method}_{task}"
    own = [f"tuned={tuned}"] if task in VARIANTS and (RECIPES / f"config/tuned/{tuned}.yaml").exists() else []
    return [*VARIANTS.get(task, [f"task={task}"]), *own]


def fly(task: str, method: str, seed: int, output: Path, data: Path, quick: bool) -> None:
    """Train once, and add the final evaluation to the results."""
    folder = output / task / method / f"seed{seed}"
    row = train(task, method, seed, folder, quick)
    key = {"task": task, "algorithm": method, "seed": str(seed)}
    add_rows(data / "shipped_curves.csv", [key | point for point in curve(folder)], same=list(key))
    add_rows(data / "shipped.csv", [row])


def curve(folder: Path) -> list[dict[str, str]]:
    """Give the curve of a run, thinned to some forty points."""
    points = [row for row in read_rows(folder / "metrics.csv") if row.get("eval/return")]
    kept = points[:: max(-(-len(points) // EVALUATIONS), 1)]
    kept += [] if kept[-1:] == points[-1:] else points[-1:]
    names = ("steps", "seconds", "return", "solved")
    return [{name: f"{float(point[CURVE[name]]):.6g}" for name in names} for point in kept]


def cell(runs: list[dict[str, str]], metric: str, factor: float, digits: int, unit: str) -> str:
    """Write what the seeds of a method reach: solved episodes, their least, and the medians of the rest."""
    if not runs:
        return ""
    solved = [float(run["solved"]) for run in runs]
    shown, seconds = (np.nanmedian([float(run.get(key) or "nan") for run in runs]) for key in (metric, "seconds"))
    some = "" if len(runs) == len(SEEDS) else f", {len(runs)} seed{'s' * (len(runs) > 1)}"
    return f"{np.mean(solved):.1%} ({min(solved):.1%}), {factor * shown:.{digits}f} {unit}, {seconds:.0f} s{some}"


def known(name: str) -> str:
    """Refuse what is neither a task nor a variant of one."""
    return name if name in VARIANTS else known_task(name)


def first_metric(task: str) -> tuple[str, float, int, str]:
    """Show of any other task the metric that its class names first; where it has none, the return."""
    name = VARIANTS.get(task, [f"task={task}"])[0].removeprefix("task=")
    own = [x for x in task_class(name).metric_info.items() if x[0] not in EPISODE_METRICS]
    name, metric = own[0] if own else ("return", EPISODE_METRICS["return"])
    return name, metric.scale, 2, metric.unit or metric.label


def blocks(data: Path) -> dict[str, str]:
    """Make the tables of what the recipes reach as they ship: that of the README, and those of docs/choosing.md."""
    runs, lines = read_rows(data / "shipped.csv"), []
    flown = dict.fromkeys(x["task"] for x in runs)
    shown = {task: TASKS.get(task) or first_metric(task) for task in sorted(flown, key=[*TASKS, *flown].index)}
    for method, label in METHODS.items():
        own = [[x for x in runs if (x["task"], x["algorithm"]) == (task, method)] for task in shown]
        if any(own):
            lines.append([label, *(cell(group, *how) for group, how in zip(own, shown.values(), strict=True))])
    made = {"improvement": improvement_table(runs, METHODS, shown)}
    compared = {"choice": choice_table, "reached": reached_table}
    made |= {name: make(runs, METHODS, shown, Starts(data)) for name, make in compared.items()}
    made["speed"] = speed_table([*runs, *read_rows(data / "rates.csv")], METHODS, shown)
    return {"summary": table(["", *(LABELS.get(task, task) for task in shown)], lines)} | made


def main() -> None:
    parser = command_line(__doc__, SEEDS, methods=METHODS)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), type=known, help=OWN)
    args = arguments(parser)
    if set(args.tasks) - set(TASKS) and ships(args.data):
        parser.error("The results here are of the tasks that ship: name another folder with --data.")
    kept = {(x["task"], x["algorithm"], int(x["seed"])) for x in read_rows(args.data / "shipped.csv")}
    todo = [(task, method, seed) for seed in args.seeds for task in args.tasks for method in args.methods]
    own = args.output, args.data, args.quick
    side_by_side(args.cores, [(fly, *job, *own) for job in todo if job not in kept])
    shipped = ships(args.data)
    pages = (DATA.parents[2] / "README.md", DATA.parents[1] / "choosing.md") if shipped else (args.data / "summary.md",)
    curves = read_rows(args.data / "shipped_curves.csv")
    draw(curves, METHODS, list(TASKS if shipped else args.tasks), pages[-1].parent / "results/shipped.png")
    made = blocks(args.data)
    for page in pages:
        fill(page, made)


if __name__ == "__main__":
    main()
