"""What the programs of the trial share: the command line, runs side by side, and where their results go."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

RECIPES = Path(__file__).parents[2] / "recipes"
DATA = RECIPES.parent / "benchmarks/paper/data"
QUICK = [
    *("num_envs=4", "horizon=4", "total_steps=64", "env.max_episode_steps=20", "compile=false"),
    *("eval.interval=1", "eval.episodes=null"),
]
RUNNING: set[subprocess.Popen] = set()
STOPPED = threading.Event()


def command_line(doc: str | None, seeds: Iterable[int], **choices: Iterable[str]) -> argparse.ArgumentParser:
    """Make the command line of a program that trains; :func:`arguments` reads it.

    Args:
        doc: the program's description.
        seeds: those that fly if none are named.
        **choices: what the program knows, by the name of the option, such as ``methods``.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, known in choices.items():
        parser.add_argument(f"--{name}", nargs="+", default=list(known), choices=list(known))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(seeds))
    parser.add_argument("--cores", type=int, default=os.cpu_count(), help="runs at the same time")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the results")
    output = Path("outputs") / Path(sys.argv[0]).stem
    parser.add_argument("--output", type=Path, default=output, help="folder of the runs")
    parser.add_argument("--quick", action="store_true", help="runs of a few steps, to see that everything works")
    return parser


def arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Read the command line; refuse to put quick runs into the results that ship."""
    args = parser.parse_args()
    if args.quick and ships(args.data):
        parser.error("--quick gives no results to keep: name another folder with --data.")
    return args


def ships(data: Path) -> bool:
    """Whether a folder of results is that of the repository."""
    return data.resolve() == DATA.resolve()


def page(data: Path, name: str) -> Path:
    """The page that shows the results of a folder: in docs, or in that folder."""
    return (DATA.parents[1] if ships(data) else data) / name


def composed(algorithm: str, overrides: list[str]) -> DictConfig:
    """Compose the configuration of a recipe. Not for several threads: hydra holds one folder at a time."""
    with initialize_config_dir(str(RECIPES / "config"), version_base=None):
        return compose(algorithm, overrides)


def end_runs_with_this() -> None:
    """Let a signal end the runs, too: otherwise they write into folders that the next program takes over."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _stop)


def _stop(number: int, _: object) -> None:
    STOPPED.set()
    for process in list(RUNNING):
        process.terminate()
    sys.exit(128 + number)


def run(command: list[str], folder: Path) -> None:
    """Run a command in a process of its own. A run that diverged left failure.pt, and counts as a result.

    Raises:
        RuntimeError: the command failed otherwise; with the last error in its log.
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
        errors = [line for line in (folder / "log.txt").read_text().splitlines() if "Error" in line]
        raise RuntimeError(f"{folder} ended with {code}: {' '.join(errors[-1:])} See log.txt there.")


def side_by_side(cores: int, jobs: Iterable[tuple[Callable[..., None], ...]]) -> None:
    """Call functions with their arguments, several at once. A failure is printed, and stops no other.

    Raises:
        SystemExit: at the end, if one has failed, or at once, by a signal.
    """
    end_runs_with_this()
    failed = 0
    with ThreadPoolExecutor(cores) as pool:
        futures = [pool.submit(*job) for job in jobs]
        try:
            for future in as_completed(futures):
                if error := future.exception():
                    failed += 1
                    traceback.print_exception(error)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    if failed:
        sys.exit(f"{failed} of {len(futures)} runs failed, see above. Start the program again to try these again.")
