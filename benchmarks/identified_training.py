"""Train on an identified drone and on another one, and fly both policies on a third that neither has seen.

    python -m benchmarks.identified_training --drones before=old.yaml fitted=outputs/real_flights/fitted/drone.yaml \\
        --randomize fitted=outputs/real_flights/fitted/randomization.yaml --judge outputs/judge/drone.yaml

Each policy flies with the controller of the drone that it was trained on, as it would on board.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torchrl.envs.utils import ExplorationType
from tqdm import tqdm

from benchmarks.report import RESULTS, save
from torchrl_quad import BPTTLoss, VisitedStateBuffer, differentiable_rollout, load_drone, make_actor, make_env


def train(task: str, drone: str, randomize: str | None, seed: int, iterations: int, compile: bool) -> torch.nn.Module:
    """A policy, by backpropagation through time from visited states."""
    torch.manual_seed(seed)
    env = make_env(task, num_envs=64, seed=seed, drone=drone, randomize=randomize, compile=compile)
    actor = make_actor(env, input_scale=0.5)
    loss = BPTTLoss(actor)
    optimizer = torch.optim.Adam(actor.parameters(), 2e-2, betas=(0.7, 0.95))
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, iterations)
    buffer, carry = VisitedStateBuffer(capacity=8192), env.reset()
    for _ in tqdm(range(iterations), desc=f"{task}, {Path(drone).parent.name or drone}"):
        rollout, _ = differentiable_rollout(env, actor, carry, 64)
        optimizer.zero_grad()
        loss(rollout)["loss_actor"].backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
        optimizer.step()
        schedule.step()
        buffer.extend(rollout)
        carry = buffer.initial_state(env, fraction=0.5)
    return actor


@torch.no_grad()
def fly(task: str, actor: torch.nn.Module, drone: str, judge: str) -> dict[str, float]:
    """Success and the errors of a policy on the drone ``judge``, whose controller believes in ``drone``."""
    env = make_env(task, num_envs=256, seed=1_000_000, drone=drone)
    env.set_params(load_drone(judge))
    flight, _ = differentiable_rollout(env, actor, None, 256, exploration_type=ExplorationType.DETERMINISTIC)
    found = {}
    for name, values in env.episode_metrics(flight).items():
        values = values.float()
        found[name] = float(values.nanmedian() if values.unique().numel() > 2 else values.nanmean())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drones", nargs="+", required=True, help="NAME=DRONE: a preset, or the path of a YAML file")
    parser.add_argument("--randomize", nargs="*", default=[], help="NAME=FILE: what the training of NAME randomises")
    parser.add_argument("--judge", required=True, help="the drone that all policies fly in the end")
    parser.add_argument("--tasks", nargs="+", default=["hovering", "tracking"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--output", type=Path, default=RESULTS / "identified_training.csv")
    options = parser.parse_args()
    torch.set_num_threads(1)
    randomize = dict(entry.split("=", 1) for entry in options.randomize)
    rows = []
    for name, drone in (entry.split("=", 1) for entry in options.drones):
        for task in options.tasks:
            for seed in options.seeds:
                actor = train(task, drone, randomize.get(name), seed, options.iterations, not options.no_compile)
                for flown, plant in (("own", drone), ("judge", options.judge)):
                    found = {k: float(f"{v:.4g}") for k, v in fly(task, actor, drone, plant).items()}
                    rows.append({"trained_on": name, "task": task, "seed": seed, "flown_on": flown, **found})
                save(options.output, rows)


if __name__ == "__main__":
    main()
