"""Run what is missing of the matrix that puts the paper on trial, side by side, and keep the results as CSV files.

python -m benchmarks.paper.reproduce --cores 2
python -m benchmarks.paper.reproduce --collect --output FOLDER   # add runs that were flown elsewhere; fly nothing

It may be stopped at any moment. Started again, it skips what is in the results, and resumes what was cut off. matrix.py
lists the runs; results.py makes figures, tables and verdicts of them.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import sys
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from benchmarks.paper.audits import audit_tasks
from benchmarks.paper.matrix import (
    DYNAMICS,
    EVALUATIONS,
    EXPERIMENTS,
    LEARNING_RATES,
    SEEDS,
    TASKS,
    VARIANTS,
    Job,
    jobs,
    search_jobs,
)
from benchmarks.paper.running import QUICK, RECIPES, arguments, command_line, composed, end_runs_with_this, run
from torchrl_quad.envs import task_class
from torchrl_quad.files import add_rows, machine, read_rows, write_rows

CURVE = {  # columns of a curve, and their names in metrics.csv
    "steps": "steps",
    "seconds": "time/processor_seconds",  # of one thread: other processes do not count
    "return": "eval/return",
    "solved": "eval/solved",
    "crash": "eval/crash",
    "position_error": "eval/position_error",
    "tracking_rmse": "eval/tracking_rmse",
    "gates_passed": "eval/gates_passed",
    "start_cells": "train/start_cells",
}
OWN = "of the paper, or of your own: a registered name or the path of a class, such as mypackage.WindowEnv"


def known_task(name: str) -> str:
    """Refuse a task that no recipe would find."""
    try:
        task_class(name)
    except (ValueError, TypeError) as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return name


def configuration(job: Job, lr: float) -> DictConfig:
    """Compose the configuration of a job's recipe, with its overrides."""
    from torchrl_quad.training.own import offer_tasks  # from the folder above

    offer_tasks([f"task={job.task}"])
    return composed(VARIANTS[job.variant].algorithm, job.overrides(lr))


def command(job: Job, lr: float, folder: Path, quick: bool) -> list[str]:
    """Give the command that runs a job in a folder, and resumes it where it was stopped."""
    overrides = job.overrides(lr)
    if quick:
        overrides = [*(x for x in overrides if not x.startswith(("total_steps", "horizon"))), *QUICK]
    else:
        cfg = configuration(job, lr)
        interval = math.ceil(cfg.total_steps // (cfg.num_envs * cfg.horizon) / EVALUATIONS)
        overrides = [*overrides, f"eval.interval={interval}"]
    recipe = RECIPES / f"{VARIANTS[job.variant].algorithm}.py"
    return [sys.executable, str(recipe), *overrides, "resume=auto", f"hydra.run.dir={folder}"]


def keep(job: Job, folder: Path, data: Path) -> None:
    """Add a finished run to the results: its curve, and then its final evaluation, which marks it as done."""
    curve = [
        {name: f"{float(row[key]):.5g}" for name, key in CURVE.items() if row.get(key)}
        for row in read_rows(folder / "metrics.csv")
    ]
    if (folder / "failure.pt").exists():
        summary, end = {"diverged": "yes"}, folder / "failure.pt"
        curve = curve or [{"steps": "0", "seconds": "0", "return": "nan"}]
        curve.append({name: x if name in ("steps", "seconds") else "nan" for name, x in curve[-1].items()})
    else:
        end = folder / "summary.json"
        summary = json.loads(end.read_text()) | {"seconds": curve[-1]["seconds"]}
    own = {"variant": job.variant, "lr": "" if job.lr is None else f"{job.lr:g}", "seed": str(job.seed)}
    path = data / ("search" if job.lr is not None else "curves") / f"{job.task}.csv"
    add_rows(path, [{**own, **row} for row in curve], same=list(own))
    summary = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in summary.items()}
    flown = datetime.date.fromtimestamp(end.stat().st_mtime).isoformat()
    about = {"task": job.task, **own, "machine": machine(), "flown": flown, "dynamics": DYNAMICS}
    final = about | {k: v for k, v in summary.items() if k not in about}
    add_rows(data / "final.csv", [final])


def is_kept(job: Job, data: Path) -> bool:
    """Tell whether a run is in the results."""
    key = (job.task, job.variant, str(job.seed), "" if job.lr is None else f"{job.lr:g}")
    return any((row["task"], row["variant"], row["seed"], row["lr"]) == key for row in read_rows(data / "final.csv"))


def best_learning_rate(task: str, variant: str, data: Path, rates: tuple[float, ...]) -> float | None:
    """Find the rate whose run in the search ended highest, by the mean of its last tenth of evaluations.

    Returns:
        the rate, or None while the search is not complete. A run that diverged counts as the lowest.
    """
    ends = {}
    for lr in rates:
        rows = [x for x in read_rows(data / f"search/{task}.csv") if x["variant"] == variant and x["lr"] == f"{lr:g}"]
        if not rows:
            return None
        last = [float(row["return"]) for row in rows[-max(len(rows) // 10, 1) :]]
        ends[lr] = sum(last) / len(last)
    return max(ends, key=lambda lr: -math.inf if math.isnan(ends[lr]) else ends[lr])


def collect(waiting: list[Job], output: Path, data: Path) -> None:
    """Add those of the missing runs to the results that are finished in a folder of runs."""
    for job in waiting:
        folder = output / job.name
        if any((folder / name).exists() for name in ("summary.json", "failure.pt")):
            keep(job, folder, data)
            print(folder)


def main() -> None:
    parser = command_line(__doc__, SEEDS, experiments=EXPERIMENTS)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), type=known_task, help=OWN)
    parser.add_argument("--collect", action="store_true", help="add finished runs in --output to the results, and stop")
    args = arguments(parser)
    end_runs_with_this()

    rates = LEARNING_RATES[1:2] if args.quick else LEARNING_RATES
    reported = jobs(tuple(args.experiments), tuple(args.tasks), tuple(args.seeds))
    todo = [*search_jobs(tuple(args.tasks), {job.rate_of for job in reported}, rates), *reported]
    waiting = [job for job in todo if not is_kept(job, args.data)]
    if args.collect:
        return collect(waiting, args.output, args.data)
    write_rows(args.data / "audit.csv", audit_tasks([task for task in args.tasks if task not in TASKS]))
    running: dict[Future, Job] = {}
    failed: list[str] = []

    bar = tqdm(total=len(todo), initial=len(todo) - len(waiting), unit="run", smoothing=0)
    with bar, ThreadPoolExecutor(args.cores) as pool:
        while waiting or running:
            for job in list(waiting):
                if len(running) == args.cores:
                    break
                lr = job.lr or best_learning_rate(job.task, job.rate_of, args.data, rates)
                if lr is not None:
                    waiting.remove(job)
                    folder = args.output / job.name
                    running[pool.submit(run, command(job, lr, folder, args.quick), folder)] = job
            if not running:  # all that is left waits for a search that failed
                failed += [f"{job.name}: the search for its learning rate is not complete" for job in waiting]
                break
            bar.set_postfix_str(", ".join(job.name for job in running.values()))
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                job = running.pop(future)
                bar.update()
                if error := future.exception():
                    failed.append(str(error))
                else:
                    keep(job, args.output / job.name, args.data)
    if failed:
        sys.exit("\n".join(["These runs failed; started again, they are tried again:", *failed]))


if __name__ == "__main__":
    main()
