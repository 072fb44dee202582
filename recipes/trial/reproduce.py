"""Run what is missing of the matrix that puts the paper on trial, side by side, and keep the results as CSV files.

python recipes/reproduce.py --cores 2

May be stopped at any moment: started again, it skips what stands in the results, and goes on with what was cut off.
What it runs stands in matrix.py; results.py makes figures, tables and verdicts of it.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import platform
import signal
import subprocess
import sys
import threading
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path

from audits import audit_tasks
from checkpoints import replacing
from hydra import compose, initialize_config_dir
from matrix import EVALUATIONS, EXPERIMENTS, LEARNING_RATES, SEEDS, TASKS, VARIANTS, Job, jobs, search_jobs
from tqdm import tqdm

RECIPES = Path(__file__).parent
DATA = RECIPES.parent / "docs/results/data"
QUICK = ["num_envs=4", "horizon=4", "total_steps=64", "env.max_episode_steps=20", "compile=false", "eval.interval=1"]
CURVE = {  # columns of a curve, and where they stand in metrics.csv
    "steps": "steps",
    "seconds": "time/processor_seconds",  # in one thread: whatever else the machine does
    "return": "eval/return",
    "success": "eval/success",
    "crash": "eval/crash",
    "position_error": "eval/position_error",
    "tracking_rmse": "eval/tracking_rmse",
    "gates_passed": "eval/gates_passed",
    "start_cells": "train/start_cells",
}
RUNNING: set[subprocess.Popen] = set()
STOPPED = threading.Event()


def stop(number: int, _: object) -> None:
    """End the runs with this process: they would write into folders that the next one takes over."""
    STOPPED.set()
    for process in list(RUNNING):
        process.terminate()
    sys.exit(128 + number)


def read(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file; none where there is no file."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: list[dict]) -> None:
    """A CSV file of rows, all or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with replacing(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def command(job: Job, lr: float, folder: Path, quick: bool) -> list[str]:
    """What runs a job so that it leaves its results in the folder, and goes on where it was stopped."""
    algorithm = VARIANTS[job.variant].algorithm
    overrides = job.overrides(lr)
    if quick:
        overrides = [*(x for x in overrides if not x.startswith(("total_steps", "horizon"))), *QUICK]
    else:
        with initialize_config_dir(str(RECIPES / "config"), version_base=None):
            cfg = compose(algorithm, overrides)
        iterations = cfg.total_steps // (cfg.num_envs * cfg.horizon)
        interval = math.ceil(iterations / EVALUATIONS)
        overrides = [*overrides, f"eval.interval={interval}"]
    return [sys.executable, str(RECIPES / f"{algorithm}.py"), *overrides, "resume=auto", f"hydra.run.dir={folder}"]


def run(command: list[str], folder: Path) -> None:
    """Run a command in a process of its own. A run that has diverged, and left failure.pt, has a result, too.

    Raises:
        RuntimeError: it failed otherwise; with the last line of what it said.
    """
    folder.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "RL_LOGGING_LEVEL": "WARNING"}
    with (
        open(folder / "log.txt", "w") as log,
        subprocess.Popen(command, stdout=log, stderr=log, env=environment) as process,
    ):
        RUNNING.add(process)
        if STOPPED.is_set():
            process.terminate()
        code = process.wait()
        RUNNING.remove(process)
    if code and not (folder / "failure.pt").exists():
        said = [line for line in (folder / "log.txt").read_text().splitlines() if "Error" in line]
        raise RuntimeError(f"{folder} ended with {code}: {' '.join(said[-1:])} See log.txt there.")


def keep(job: Job, folder: Path, data: Path) -> None:
    """Add a finished run to the results: its curve, and then its final evaluation, which says that it is there."""
    curve = [
        {name: f"{float(row[key]):.5g}" for name, key in CURVE.items() if row.get(key)}
        for row in read(folder / "metrics.csv")
    ]
    if (folder / "failure.pt").exists():
        summary = {"diverged": "yes"}
        curve = curve or [{"steps": "0", "seconds": "0", "return": "nan"}]
        curve.append({name: x if name in ("steps", "seconds") else "nan" for name, x in curve[-1].items()})
    else:
        summary = json.loads((folder / "summary.json").read_text()) | {"seconds": curve[-1]["seconds"]}
    own = {"variant": job.variant, "lr": "" if job.lr is None else f"{job.lr:g}", "seed": str(job.seed)}
    path = data / ("search" if job.lr is not None else "curves") / f"{job.task}.csv"
    others = [row for row in read(path) if any(row[name] != own[name] for name in own)]
    write(path, [*others, *({**own, **row} for row in curve)])
    summary = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in summary.items()}
    final = {"task": job.task, **own, "machine": machine(), **{k: v for k, v in summary.items() if k not in own}}
    write(data / "final.csv", [*read(data / "final.csv"), final])


def machine() -> str:
    """The processor, as Linux names it."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def is_kept(job: Job, data: Path) -> bool:
    """Whether a run stands in the results."""
    key = (job.task, job.variant, str(job.seed), "" if job.lr is None else f"{job.lr:g}")
    return any((row["task"], row["variant"], row["seed"], row["lr"]) == key for row in read(data / "final.csv"))


def best_learning_rate(task: str, variant: str, data: Path, rates: tuple[float, ...]) -> float | None:
    """The rate whose run of the search ended highest, by the mean of its last tenth of evaluations.

    None as long as the search is not complete. A run that diverged counts as the lowest.
    """
    ends = {}
    for lr in rates:
        rows = [x for x in read(data / f"search/{task}.csv") if x["variant"] == variant and x["lr"] == f"{lr:g}"]
        if not rows:
            return None
        last = [float(row["return"]) for row in rows[-max(len(rows) // 10, 1) :]]
        ends[lr] = sum(last) / len(last)
    return max(ends, key=lambda lr: -math.inf if math.isnan(ends[lr]) else ends[lr])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cores", type=int, default=os.cpu_count(), help="runs at the same time")
    parser.add_argument("--experiments", nargs="+", default=list(EXPERIMENTS), choices=list(EXPERIMENTS))
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--data", type=Path, default=DATA, help="where the results are kept")
    parser.add_argument("--output", type=Path, default=Path("outputs/reproduce"), help="where the runs are")
    parser.add_argument("--quick", action="store_true", help="runs of a few steps, to see that everything works")
    args = parser.parse_args()
    if args.quick and args.data == DATA:
        parser.error("--quick gives no results to keep: name another folder with --data.")

    write(args.data / "audit.csv", audit_tasks())
    rates = LEARNING_RATES[1:2] if args.quick else LEARNING_RATES
    reported = jobs(tuple(args.experiments), tuple(args.tasks), tuple(args.seeds))
    todo = [*search_jobs(tuple(args.tasks), {job.rate_of for job in reported}, rates), *reported]
    waiting = [job for job in todo if not is_kept(job, args.data)]
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
            if not running:  # what is left waits for a search that has failed
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
    signal.signal(signal.SIGTERM, stop)
    main()
