"""Fly what the results of the paper's trial and of the recipes lack, several runs at a time.

python -m benchmarks.paper.reproduce trial --cores 2     # the paper's methods and their variants, of matrix.py
python -m benchmarks.paper.reproduce shipped --tasks mypackage.WindowEnv --data FOLDER   # on a task of your own

It may be stopped at any moment. Started again, it skips what is in the results, and resumes what was cut off.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import os
from argparse import Namespace
from collections.abc import Callable, Iterable
from pathlib import Path

from omegaconf import DictConfig

from benchmarks.paper import elsewhere, flights, gradients, matrix
from benchmarks.paper.evidence import best_learning_rate
from benchmarks.paper.matrix import EXPERIMENTS, LEARNING_RATES, SEEDS, TASKS, VARIANTS, Job
from benchmarks.paper.running import DATA, QUICK, composed, kept, run, ships, side_by_side
from torchrl_quad.dynamics import available_drones
from torchrl_quad.envs import task_class
from torchrl_quad.files import add_rows, machine, read_rows, write_rows

OWN = "of the paper, or of your own: a registered name or the path of a class, such as mypackage.WindowEnv"
KEY = ("variant", "lr", "seed")  # what tells one run on a task from another


def trial(args: Namespace) -> None:
    """The paper's methods and their variants, after a search for their learning rates; and an audit of the rewards."""
    rates = LEARNING_RATES[1:2] if args.quick else LEARNING_RATES
    reported = matrix.jobs(tuple(args.experiments), tuple(args.tasks), tuple(args.seeds))
    search = matrix.search_jobs(tuple(args.tasks), {job.rate_of for job in reported}, rates)
    done = kept(args.data / "final.csv", "task", *KEY)
    search, reported = ([job for job in some if (job.task, *job.key) not in done] for some in (search, reported))

    def fly(job: Job) -> None:
        lr = job.lr or best_learning_rate(job.task, job.rate_of, args.data, rates)
        if lr is None:
            raise RuntimeError(f"{job.name}: the search for its learning rate is not complete")
        folder = args.output / job.name
        run(VARIANTS[job.variant].algorithm, overrides(job, lr, args.quick), folder)
        keep(job, folder, args.data)

    own_tasks = [task for task in args.tasks if task not in TASKS]
    write_rows(args.data / "audit.csv", gradients.audit_tasks(own_tasks))
    side_by_side(args.cores, *([(fly, job) for job in some] for some in (search, reported)))


def configuration(job: Job, lr: float) -> DictConfig:
    return composed(VARIANTS[job.variant].algorithm, job.overrides(lr))


def overrides(job: Job, lr: float, quick: bool) -> list[str]:
    """Give the overrides of a job's recipe, with as many evaluations as its curve has points."""
    if quick:
        return [*(x for x in job.overrides(lr) if not x.startswith(("total_steps", "horizon"))), *QUICK]
    cfg = configuration(job, lr)
    interval = math.ceil(cfg.total_steps // (cfg.num_envs * cfg.horizon) / matrix.EVALUATIONS)
    return [*job.overrides(lr), f"eval.interval={interval}"]


def keep(job: Job, folder: Path, data: Path) -> None:
    """Add a finished run to the results: its curve, and then its final evaluation, which marks it as done."""
    curve = [
        {name: f"{float(row[key]):.5g}" for name, key in flights.CURVE.items() if row.get(key)}
        for row in read_rows(folder / "metrics.csv")
    ]
    if (folder / "failure.pt").exists():
        summary, end = {"diverged": "yes"}, folder / "failure.pt"
        curve = curve or [{"steps": "0", "seconds": "0", "return": "nan"}]
        curve.append({name: x if name in ("steps", "seconds") else "nan" for name, x in curve[-1].items()})
    else:
        end = folder / "summary.json"
        summary = json.loads(end.read_text()) | {"seconds": curve[-1]["seconds"]}
    own = dict(zip(KEY, job.key, strict=True))
    path = data / ("search" if job.lr is not None else "curves") / f"{job.task}.csv"
    add_rows(path, [{**own, **row} for row in curve], same=KEY)
    summary = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in summary.items()}
    flown = datetime.date.fromtimestamp(end.stat().st_mtime).isoformat()
    about = {"task": job.task, **own, "machine": machine(), "flown": flown, "dynamics": matrix.DYNAMICS}
    add_rows(data / "final.csv", [about | {k: v for k, v in summary.items() if k not in about}])


def known_task(name: str) -> str:
    try:
        if name not in flights.VARIANTS:
            task_class(name)
    except (ValueError, TypeError) as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return name


def command_line() -> argparse.ArgumentParser:
    """Make the command line: what to fly, with its own options and those of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = parser.add_subparsers(dest="what", required=True, metavar="what")

    def add(
        fly: Callable[[Namespace], None], seeds: Iterable[int], **choices: Iterable[str]
    ) -> argparse.ArgumentParser:
        name, doc = fly.__name__, fly.__doc__ or ""
        own = programs.add_parser(name, description=doc, help=doc.splitlines()[0])
        for option, known in choices.items():
            own.add_argument(f"--{option}", nargs="+", default=list(known), choices=list(known))
        if seeds:
            own.add_argument("--seeds", nargs="+", type=int, default=list(seeds))
        own.add_argument("--cores", type=int, default=os.cpu_count(), help="runs at the same time")
        own.add_argument("--data", type=Path, default=DATA, help="folder of the results")
        own.add_argument("--output", type=Path, default=Path("outputs/paper") / name, help="folder of the runs")
        own.add_argument("--quick", action="store_true", help="runs of a few steps, to see that everything works")
        own.set_defaults(fly=fly)
        return own

    own = add(trial, SEEDS, experiments=EXPERIMENTS)
    own.add_argument("--tasks", nargs="+", default=list(TASKS), type=known_task, help=OWN)
    own = add(flights.shipped, range(10), methods=flights.METHODS)
    own.add_argument("--tasks", nargs="+", default=list(flights.TASKS), type=known_task, help=OWN)
    of = {"tasks": flights.CHANGED_TASKS, "methods": flights.CHANGED_METHODS, "changes": flights.CHANGES}
    add(flights.ablations, range(5), **of)
    add(flights.rates, (101, 102, 103), tasks=flights.TASKS, methods=flights.METHODS, factors=flights.FACTORS)
    add(flights.drones, range(5), drones=available_drones())
    add(flights.starts, (0,), tasks=flights.TASKS, methods=flights.METHODS)
    own = add(flights.forest, range(5), policies=flights.POLICIES, difficulties=flights.DIFFICULTIES)
    own.add_argument("--speeds", nargs="+", type=float, default=list(flights.SPEEDS), help="commanded [m/s]")
    own.add_argument("--forests", type=int, default=flights.FORESTS, help="for each speed and density")
    add(elsewhere.elsewhere, range(5), environments=elsewhere.ENVIRONMENTS, losses=elsewhere.NAMES)
    own = add(gradients.ascent, ())
    own.add_argument("checkpoints", nargs="+", type=Path)
    own.add_argument("--states", type=int, default=128, help="visited states in which gradients are compared")
    own.add_argument("--repeats", type=even, default=4, help="flights from each, each with its own noise")
    own.add_argument("--steps", type=int, default=256, help="control steps whose rewards count")
    own.add_argument("--size", type=float, default=0.1, help="change of an action, in its range of -1 to 1")
    return parser


def even(text: str) -> int:
    if int(text) % 2:
        raise argparse.ArgumentTypeError(f"{text} must be even: two halves of them are compared")
    return int(text)


def main() -> None:
    parser = command_line()
    args = parser.parse_args()
    if ships(args.data):  # which holds the runs of whole length, on the tasks that ship
        if args.quick or getattr(args, "forests", flights.FORESTS) != flights.FORESTS:
            parser.error("--quick and --forests give no results to keep: name another folder with --data.")
        if args.what == "shipped" and set(args.tasks) - set(flights.TASKS):
            parser.error("The results here are of the tasks that ship: name another folder with --data.")
    args.fly(args)


if __name__ == "__main__":
    main()
