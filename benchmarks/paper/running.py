"""Runs of recipes in processes of their own, several at a time, and which of them the results already have."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from torchrl_quad.files import read_rows
from torchrl_quad.training.configuration import compose

RECIPES = Path(__file__).parents[2] / "recipes"
DATA = Path(__file__).parent / "data"
QUICK = [
    *("num_envs=4", "horizon=4", "total_steps=64", "env.max_episode_steps=20", "compile=false"),
    *("eval.interval=1", "eval.episodes=null"),
]
RUNNING: set[subprocess.Popen] = set()
STOPPED = threading.Event()
COMPOSING = threading.Lock()  # hydra holds one folder at a time


def ships(data: Path) -> bool:
    return data.resolve() == DATA.resolve()


def kept(path: Path, *names: str) -> set[tuple[str, ...]]:
    """The runs that a file of results has, each by these columns."""
    return {tuple(row[name] for name in names) for row in read_rows(path)}


def composed(algorithm: str, overrides: list[str]) -> DictConfig:
    with COMPOSING:
        return compose(algorithm, overrides)


def _stop(number: int, _: object) -> None:
    STOPPED.set()
    for process in list(RUNNING):
        process.terminate()
    sys.exit(128 + number)


def run(recipe: str, overrides: Iterable[str], folder: Path) -> None:
    """Run a recipe in a folder, or resume it there. A run that diverged left failure.pt, and counts as a result."""
    script = str(RECIPES / f"{recipe}.py")
    command([sys.executable, script, *overrides, "resume=auto", f"hydra.run.dir={folder}"], folder)


def command(words: list[str], folder: Path) -> None:
    """Run a command in a process of its own, with its log in a folder; see :func:`run`."""
    if STOPPED.is_set():
        return
    folder.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "RL_LOGGING_LEVEL": "WARNING"}
    with (
        open(folder / "log.txt", "w") as log,
        subprocess.Popen(words, stdout=log, stderr=log, env=environment) as process,
    ):
        RUNNING.add(process)
        if STOPPED.is_set():  # the signal came before this process was in the set
            process.terminate()
        code = process.wait()
        RUNNING.remove(process)
    if code and not (folder / "failure.pt").exists():
        errors = [line for line in (folder / "log.txt").read_text().splitlines() if "Error" in line]
        raise RuntimeError(f"{folder} ended with {code}: {' '.join(errors[-1:])} See log.txt there.")


def side_by_side(cores: int, *stages: Iterable[tuple[Callable[..., None], ...]]) -> None:
    """Call functions with their arguments, several at once; a stage begins when the previous one has ended.

    A failure is printed, stops no other, and ends the program when all are over; a signal does so at once.
    """
    for number in (signal.SIGTERM, signal.SIGINT):  # ends the runs, too, which write into folders to be resumed
        signal.signal(number, _stop)
    calls = failed = 0
    with ThreadPoolExecutor(cores) as pool:
        for jobs in stages:
            futures = [pool.submit(*job) for job in jobs]
            calls += len(futures)
            try:
                for future in tqdm(as_completed(futures), total=len(futures), unit="run", smoothing=0):
                    if error := future.exception():
                        failed += 1
                        traceback.print_exception(error)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    if failed:
        sys.exit(f"{failed} of {calls} runs failed, see above. Start the program again to try these again.")
