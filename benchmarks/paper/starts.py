"""Fly policies from many sets of starts, to see how much of a mean over 256 starts is due to the starts.

python -m benchmarks.paper.starts --cores 2
python -m benchmarks.paper.starts --tasks landing --methods abpt --seeds 0 1

A policy is judged on one set of 256 starts, the same for all. Other starts would give another mean, which no interval
over seeds can tell. This trains as shipped.py does, and flies each policy from SETS sets, of which the first is the one
that policies are judged on. comparison.py widens its intervals by what benchmarks/paper/data/starts.csv holds. It may be
stopped at any moment. Started again, it skips what is there.
"""

from __future__ import annotations

import datetime
from pathlib import Path

import torch

from benchmarks.paper.running import arguments, command_line, side_by_side
from benchmarks.paper.shipped import METHODS, TASKS, train
from torchrl_quad.files import add_rows, machine, read_rows
from torchrl_quad.training.building import build_env
from torchrl_quad.training.evaluation import drawing_from, evaluate, load_policy

SETS, STARTS, FIRST = 16, 256, 2_000_000  # sets, starts in each, and the seed of the first, that of evaluate.py
MEASURED = ("return", "solved", "gates_passed")


def fly(task: str, method: str, seed: int, output: Path, data: Path, quick: bool) -> None:
    """Train once, fly the best policy from every set of starts, and add a row for each."""
    folder = output / task / method / f"seed{seed}"
    if not (folder / "summary.json").exists():
        train(task, method, seed, folder, quick)
    cfg, actor, normalizer = load_policy(folder / "checkpoint.pt")
    env = build_env(cfg, STARTS, FIRST)
    if normalizer is not None:
        env.transform.load_state_dict(normalizer)
    about = {"task": task, "algorithm": method, "seed": seed, "starts": STARTS}
    about |= {"machine": machine(), "flown": datetime.date.today().isoformat()}
    rows = []
    for first in range(FIRST, FIRST + SETS):
        with drawing_from(env, first):
            metrics, _ = evaluate(env, actor)
        reached = {name: f"{metrics[f'eval/{name}']:.6g}" for name in MEASURED if f"eval/{name}" in metrics}
        rows.append(about | {"starts_seed": first} | reached)
    add_rows(data / "starts.csv", rows)
    print(task, method, seed, *(row["return"] for row in rows), flush=True)


def main() -> None:
    parser = command_line(__doc__, [0], tasks=TASKS, methods=METHODS)
    args = arguments(parser)
    torch.set_num_threads(1)
    kept = {(x["task"], x["algorithm"], x["seed"]) for x in read_rows(args.data / "starts.csv")}
    todo = [(task, method, seed) for seed in args.seeds for task in args.tasks for method in args.methods]
    own = args.output, args.data, args.quick
    jobs = [(fly, *job, *own) for job in todo if (*job[:2], str(job[2])) not in kept]
    side_by_side(args.cores, jobs)


if __name__ == "__main__":
    main()
