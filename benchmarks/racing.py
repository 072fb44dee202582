"""The racing ladder: a recipe on public tracks and on unseen random ones, beside the least time of a point mass.

python -m benchmarks.racing --seeds 0 1 2 3 4 5 6 7 8 9 --cores 2   # and fills in docs/racing.md

Each run trains on one track, and then flies it from fresh starts. Success is a lap without a crash within four times
the bound of lap_bound.py; a track with an end is flown from its start. Laps are the last that an episode completes, in
whole control steps. Runs that are in the results are left out, and those that were cut off are resumed.
"""

import functools
import math
import os
from pathlib import Path

import torch
from torchrl.envs.utils import ExplorationType

from benchmarks.lap_bound import bound_of
from benchmarks.paper.running import kept, run, side_by_side
from benchmarks.report import command_line, publish
from torchrl_quad import RacingEnv, differentiable_rollout, load_track
from torchrl_quad.envs.racing import GATES, ROTATIONS
from torchrl_quad.files import add_rows, machine, read_rows
from torchrl_quad.training.building import build_env, task_of
from torchrl_quad.training.checkpoints import revision
from torchrl_quad.training.evaluation import load_policy

PAGE = Path(__file__).parents[1] / "docs/racing.md"
TRACKS = ["visfly", "time_optimal", "split_s", "alpha_pilot", "airsim", "lsy_level0", "random"]
DRONES = {"lsy_level0": "crazyflie_brushless"}  # where others are as wide as the gates
KEY = ("track", "drone", "recipe", "steps", "seed")
STARTS = 2_000_000  # the seed of the starts, as in recipes/evaluate.py
DRAWN = 8  # random tracks whose bounds are found, each of which takes seconds


@functools.cache
def bound(track: str, drone: str) -> float:
    env = RacingEnv(1, track=track, drone=drone)
    return bound_of(env, env.gates, env.rotations)


def train(folder: Path, track: str, drone: str, recipe: str, steps: int, seed: int, overrides: list[str]) -> None:
    directed = str("gate_radius" not in load_track(track)).lower()
    settings = [f"env.track={track}", f"env.drone={drone}", f"env.observe_directions={directed}"]
    run(recipe, ["task=racing", *settings, f"total_steps={steps}", f"seed={seed}", *overrides], folder)


def judge(folder: Path, track: str, drone: str, episodes: int) -> dict[str, float]:
    """Fly the best policy of a run: its success, its laps [s], and their ratios to the bound."""
    cfg, actor, normalizer = load_policy(folder / "checkpoint.pt")
    cfg.env.first_gate = None if load_track(track).get("closed", True) else 0
    cfg.env.max_episode_steps = math.ceil(4.0 * bound(track, drone) / cfg.env.control_dt)
    env = build_env(cfg, episodes, STARTS, normalizer=normalizer)
    task, deterministic = task_of(env), ExplorationType.DETERMINISTIC
    with torch.no_grad():
        flight, _ = differentiable_rollout(env, actor, None, task.max_episode_steps, exploration_type=deterministic)
    ends = task.episode_metrics(flight)
    lap, bounds = ends["lap_time"].double(), torch.full((episodes,), bound(track, drone)).double()
    if track == "random":
        drawn = [flight["state", *key][:DRAWN, 0] for key in (GATES, ROTATIONS)]
        bounds[:] = math.nan
        bounds[:DRAWN] = torch.tensor([bound_of(task, *each) for each in zip(*drawn, strict=True)])
    ratio, found = lap / bounds, {"success": ((ends["crash"] == 0.0) & ~lap.isnan()).double().mean()}
    found |= {"lap_time": lap.nanmedian(), "bound": bounds.nanmean(), "ratio": ratio.nanmedian()}
    found |= {"least_ratio": ratio.nan_to_num(math.inf).min(), "gates": ends["gates_passed"].double().mean()}
    return {name: round(x.item(), 4) for name, x in found.items()}


def table(rows: list[dict[str, str]]) -> str:
    """The table of the page: for each track the steps that solved the most, seeds from the least to the greatest."""
    columns = {"success": "success", "lap_time": "lap [s]", "bound": "bound [s]", "ratio": "lap / bound"}
    lines = [[*KEY[:-1], "seeds", *columns.values()], ["---"] * (len(KEY) + len(columns))]
    runs: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        runs.setdefault(tuple(row[name] for name in KEY[:-1]), []).append(row)
    solved = {run_of: sum(float(row["success"]) for row in some) / len(some) for run_of, some in runs.items()}
    for run_of, some in runs.items():
        if solved[run_of] < max(share for other, share in solved.items() if other[:-1] == run_of[:-1]):
            continue
        lines.append([*run_of, str(len(some))])
        for name in columns:
            values = sorted(value for row in some if not math.isnan(value := float(row[name])))
            lines[-1].append(
                " to ".join(sorted({f"{x:.2f}" for x in (*values[:1], *values[-1:])}, key=float)) or "none"
            )
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    options = {"tracks": TRACKS, "seeds": [0], "drone": "kingfisher", "recipe": "train", "steps": 6_000_000}
    more = {"episodes": 256, "cores": os.cpu_count() or 1, "runs": "outputs/ladder", "overrides": [""]}
    args = command_line(__doc__, "racing.csv", **options, **more)

    def fly(track: str, seed: int) -> None:
        own = dict(zip(KEY, (track, *own_of(track), seed), strict=True))
        folder = Path(args.runs, *map(str, own.values()))
        train(folder, **own, overrides=[x for x in args.overrides if x])
        seconds = read_rows(folder / "metrics.csv")[-1]["time/processor_seconds"]
        about = {"seconds": f"{float(seconds):.0f}", "machine": machine(), "torch": torch.__version__, "threads": 1}
        about["revision"] = revision()
        add_rows(args.output, [own | judge(folder, track, own["drone"], args.episodes) | about])

    def own_of(track: str) -> tuple[str, str, int]:
        return DRONES.get(track, args.drone), args.recipe, args.steps

    done = kept(args.output, *KEY)
    jobs = [(fly, track, seed) for seed in args.seeds for track in args.tracks]
    side_by_side(args.cores, [job for job in jobs if tuple(map(str, (job[1], *own_of(job[1]), job[2]))) not in done])
    text = table(read_rows(args.output))
    print(text)
    publish(args.output, PAGE, text)


if __name__ == "__main__":
    main()
