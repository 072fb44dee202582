"""Seconds from the start of the process until hovering is solved, per algorithm, eager and compiled, cold and warm.

python -m benchmarks.time_to_solve --algorithms abpt --seeds 0 1 2

It is solved in the first evaluation in which at least 99 % of the episodes succeed. Imports, compilation and
evaluations count. "Cold" is an empty compile cache. What is there already is left out.
"""

import itertools
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tqdm import tqdm

from benchmarks.report import command_line, save
from torchrl_quad.files import read_rows

RECIPES = Path(__file__).parents[1] / "recipes"


def solve(algorithm: str, seed: int, overrides: list[str], cache: Path, limit: float = math.inf) -> float | None:
    """Seconds to the first row of the metrics that has solved >= 0.99; None if it ends without, or after the limit."""
    with tempfile.TemporaryDirectory() as folder:
        metrics = Path(folder) / "run" / "metrics.csv"
        command = [sys.executable, str(RECIPES / f"{algorithm}.py"), f"seed={seed}", f"hydra.run.dir={metrics.parent}"]
        start = time.perf_counter()
        with (
            tempfile.TemporaryFile("w+") as said,
            subprocess.Popen(
                [*command, *overrides],
                env={**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(cache)},
                stdout=subprocess.DEVNULL,
                stderr=said,
            ) as run,
        ):
            while True:
                ended = run.poll() is not None
                if any(float(row["eval/solved"] or "nan") >= 0.99 for row in read_rows(metrics)):
                    seconds = time.perf_counter() - start
                    run.kill()
                    return seconds
                if run.returncode:
                    said.seek(0)
                    last = " ".join(said.read().strip().splitlines()[-1:])
                    raise RuntimeError(f"{algorithm} ended with {run.returncode}: {last}")
                if ended or time.perf_counter() - start > limit:
                    run.kill()
                    return None
                time.sleep(0.05)


def main() -> None:
    options = {"algorithms": ["bptt", "shac", "abpt"], "seeds": [0], "modes": ["eager", "cold", "warm"]}
    args = command_line(__doc__, "time_to_solve.csv", overrides=["eval.interval=5"], **options)
    rows = read_rows(args.output)
    with tempfile.TemporaryDirectory() as cache:
        # "warm" follows "cold", and finds its cache.
        for algorithm, seed, mode in tqdm(list(itertools.product(args.algorithms, args.seeds, args.modes))):
            key = {"algorithm": algorithm, "seed": str(seed), "mode": mode}
            if any(all(row[name] == value for name, value in key.items()) for row in rows):
                continue
            folder = Path(cache) / f"{algorithm}{seed}"
            compile = f"compile={'false' if mode == 'eager' else 'true'}"
            if mode == "warm" and not folder.exists():
                solve(algorithm, seed, [*args.overrides, compile], folder)
            seconds = solve(algorithm, seed, [*args.overrides, compile], folder)
            rows.append({**key, "seconds": "never" if seconds is None else round(seconds, 1)})
            save(args.output, rows, overrides=" ".join(args.overrides))


if __name__ == "__main__":
    main()
