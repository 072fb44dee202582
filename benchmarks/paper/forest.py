"""Train policies that see in the middle forest, and fly them through fresh ones, at all speeds and densities.

python -m benchmarks.paper.forest --cores 2
python -m benchmarks.paper.forest --policies bptt blind --seeds 0 --speeds 4 6 --difficulties middle

It may be stopped at any moment. Started again, it skips what is in benchmarks/paper/data/forest.csv, and resumes what was
cut off. docs/camera.md shows the table and the picture.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from benchmarks.paper.results import fill
from benchmarks.paper.running import QUICK, RECIPES, arguments, command_line, page, run, ships, side_by_side
from benchmarks.paper.tables import table
from torchrl_quad import differentiable_rollout
from torchrl_quad.files import add_rows, machine, read_rows, replacing
from torchrl_quad.training.building import build_env
from torchrl_quad.training.evaluation import load_policy

HALF = "total_steps=2_048_000"  # of what BPTT ships with
POLICIES = {  # recipe, and what differs from what it ships with
    "bptt": ("bptt", []),
    "bptt, half as long": ("bptt", [HALF]),
    "no memory": ("bptt", [HALF, "actor.recurrent=false"]),
    "no velocity": ("bptt", [HALF, "env.observe_velocity=false"]),
    "blind": ("bptt", [HALF, "actor.vision=false", "env.camera=null"]),
    "shac": ("shac", []),
    "hybrid": ("hybrid", []),
    "ppo": ("ppo", ["total_steps=2_880_000"]),  # about the seconds of BPTT
    "ppo, four times as long": ("ppo", ["total_steps=11_520_000"]),
}
SPEEDS, DIFFICULTIES, SEEDS = (2.0, 4.0, 6.0, 8.0), ("easy", "middle", "hard"), tuple(range(5))
FORESTS, FIRST_FOREST = 256, 3_000_000  # seed of their random numbers: nobody trains or chooses in them
CHUNK = 50  # control steps between looks at who still flies
PATIENCE = 2.0  # times the way at the commanded speed, in which a flight must be over


def success_rates(env: EnvBase, actor: TensorDictModuleBase, steps: int) -> dict[str, float]:
    """Fly one episode in every environment: the shares that reach the other side, and that crash, of all episodes."""
    flies, solved, crashed = (torch.full((env.num_envs,), x) for x in (True, False, False))
    carry = None
    for _ in range(0, steps, CHUNK):
        with torch.no_grad():
            flight, carry = differentiable_rollout(
                env, actor, carry, CHUNK, exploration_type=ExplorationType.DETERMINISTIC
            )
        done, success, crash = (flight["next", name].squeeze(-1) for name in ("done", "success", "crash"))
        ends = flies & done.any(1)
        last = done.int().argmax(1, keepdim=True)
        solved |= ends & success.gather(1, last).squeeze(1)
        crashed |= ends & crash.gather(1, last).squeeze(1)
        flies &= ~ends
        if not flies.any():
            break
    return {"solved": solved.double().mean().item(), "crash": crashed.double().mean().item()}


def fly(policy: str, seed: int, todo: list[tuple[str, float]], args: argparse.Namespace) -> None:
    """Train once, then fly through the forests that are wanted, and add each result as it comes."""
    recipe, overrides = POLICIES[policy]
    folder = args.output / policy.replace(",", "").replace(" ", "_") / f"seed{seed}"
    own = [f"seed={seed}", *overrides, *(QUICK if args.quick else ())]
    own += ["resume=auto", f"hydra.run.dir={folder}"]
    if not (folder / "summary.json").exists():
        run([sys.executable, str(RECIPES / f"{recipe}.py"), "task=forest", *own], folder)
    trained = read_rows(folder / "metrics.csv")[-1]
    cfg, actor, normalizer = load_policy(folder / "checkpoint.pt")
    for difficulty, speed in todo:
        cfg.env.difficulty, cfg.env.speed = difficulty, speed
        env = build_env(cfg, args.forests, FIRST_FOREST, compile=not args.quick)
        if normalizer is not None:
            env.transform.load_state_dict(normalizer)
        steps = round(PATIENCE * (env.length + max(env.run_up)) / speed / env.control_dt)
        rates = success_rates(env, actor, min(steps, cfg.env.max_episode_steps))
        row = {"policy": policy, "seed": seed, "difficulty": difficulty, "speed": speed, "forests": args.forests}
        row |= {name: f"{x:.6g}" for name, x in rates.items()}
        row |= {"steps": trained["steps"], "seconds": trained["time/processor_seconds"], "machine": machine()}
        add_rows(args.data / "forest.csv", [row])
        print(row, flush=True)


def cell(rows: list[dict[str, str]]) -> str:
    """Write the successes of all seeds: their mean, and the least."""
    if not rows:
        return ""
    solved = [float(row["solved"]) for row in rows]
    return f"{np.mean(solved):.0%} ({min(solved):.0%}, {len(solved)} seed{'s' * (len(solved) > 1)})"


def summary(rows: list[dict[str, str]]) -> str:
    """Show what each policy reaches in the middle forest, and what its training has cost."""
    speeds = sorted({float(row["speed"]) for row in rows})
    lines = []
    for policy in (name for name in POLICIES if any(row["policy"] == name for row in rows)):
        own = [row for row in rows if (row["policy"], row["difficulty"]) == (policy, "middle")]
        cost = np.median([float(row["seconds"]) for row in own]) if own else np.nan
        million = np.median([float(row["steps"]) for row in own]) / 1e6 if own else np.nan
        cells = (cell([row for row in own if float(row["speed"]) == speed]) for speed in speeds)
        lines.append([policy, f"{million:.1f}", f"{cost:.0f}", *cells])
    return table(["", "million steps", "processor seconds", *(f"{speed:g} m/s" for speed in speeds)], lines)


def draw(rows: list[dict[str, str]], path: Path) -> None:
    """Draw success over speed, a panel for each density."""
    from matplotlib.figure import Figure

    present = [name for name in DIFFICULTIES if any(row["difficulty"] == name for row in rows)]
    figure = Figure((3.2 * max(len(present), 1) + 2.0, 3.0), layout="constrained")
    flown = [name for name in POLICIES if any(row["policy"] == name for row in rows)]
    panels = figure.subplots(1, max(len(present), 1), sharey=True, squeeze=False)[0]
    lines = {}
    for name, panel in zip(present, panels, strict=False):
        for i, policy in enumerate(flown):
            of_speed: dict[float, list[float]] = {}
            for row in rows:
                if (row["policy"], row["difficulty"]) == (policy, name):
                    of_speed.setdefault(float(row["speed"]), []).append(100 * float(row["solved"]))
            if speeds := sorted(of_speed):
                means = [np.mean(of_speed[speed]) for speed in speeds]
                (lines[policy],) = panel.plot(speeds, means, marker="o", markersize=4, color=f"C{i}")
        panel.set(title=name, xlabel="commanded speed [m/s]", ylim=(0, 100))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("success [%]")
    flown = [policy for policy in flown if policy in lines]
    figure.legend([lines[policy] for policy in flown], flown, loc="outside right center", fontsize=8, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)


def main() -> None:
    parser = command_line(__doc__, SEEDS, policies=POLICIES, difficulties=DIFFICULTIES)
    parser.add_argument("--speeds", nargs="+", type=float, default=list(SPEEDS), help="commanded [m/s]")
    parser.add_argument("--forests", type=int, default=FORESTS, help="for each speed and density")
    args = arguments(parser)
    if ships(args.data) and args.forests != FORESTS:
        parser.error("--forests gives no results to keep: name another folder with --data.")
    torch.set_num_threads(1)
    names = ("policy", "seed", "difficulty", "speed")
    kept = {tuple(row[name] for name in names) for row in read_rows(args.data / "forest.csv")}
    jobs = []
    for seed in args.seeds:
        for policy in args.policies:
            wanted = [(d, s) for d in args.difficulties for s in args.speeds]
            if todo := [(d, s) for d, s in wanted if (policy, str(seed), d, str(s)) not in kept]:
                jobs.append((fly, policy, seed, todo, args))
    side_by_side(args.cores, jobs)
    rows = read_rows(args.data / "forest.csv")
    draw(rows, page(args.data, "images/forest_success.png"))
    fill(page(args.data, "camera.md"), {"forest": summary(rows)})


if __name__ == "__main__":
    main()
