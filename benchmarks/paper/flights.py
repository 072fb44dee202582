"""Flights of the recipes as they ship, with one setting changed, and with a camera: what a file of results lacks."""

from __future__ import annotations

import datetime
import json
import math
from argparse import Namespace
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import product
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from benchmarks.paper.matrix import EVALUATIONS
from benchmarks.paper.running import QUICK, composed, kept, run, side_by_side
from torchrl_quad import differentiable_rollout
from torchrl_quad.envs.racing import load_track
from torchrl_quad.files import add_rows, machine, read_rows
from torchrl_quad.training.building import build_env
from torchrl_quad.training.configuration import tuned
from torchrl_quad.training.evaluation import drawing_from, evaluate, load_policy

METHODS = {name: name.upper() for name in ("bptt", "shac", "abpt", "sapo", "ahac")}
METHODS |= {"pods": "PODS", "hybrid": "Hybrid", "ppo": "PPO", "train": "One setting"}
TASKS = {  # what is shown of each with the solved episodes: column, factor, digits, unit
    "hovering": ("position_error", 100, 1, "cm"),
    "tracking": ("tracking_rmse", 100, 1, "cm"),
    "landing": ("landing_speed", 1, 2, "m/s"),
    "racing": ("gates_passed", 1, 1, "gates"),
    "racing_position": ("gates_passed", 1, 1, "gates"),
}
VARIANTS = {  # of a task: its overrides
    "racing_position": ["task=racing", "env.reward=position"],
    "six_gates": ["task=racing", "env.track=six_gates"],
    "six_gates_back": ["task=racing", f"env.track={{gates: {load_track('six_gates')['gates'][::-1]}}}"],
    "point_mass": ["task=hovering", "env.dynamics=point_mass"],
    "memory": ["task=tracking", "actor.recurrent=true"],
    **{mode: ["task=hovering", f"env.control={mode}"] for mode in ("attitude", "rotor_thrusts", "velocity")},
}
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
RUN = ("task", "algorithm", "seed")  # what tells one run from another


def overrides(task: str, method: str) -> list[str]:
    """Name the task to a recipe; a variant of a task may have tuned values of its own."""
    own = [f"tuned={name}"] if task in VARIANTS and (name := f"{method}_{task}") in tuned() else []
    return [*VARIANTS.get(task, [f"task={task}"]), *own]


def about() -> dict[str, str]:
    return {"machine": machine(), "flown": datetime.date.today().isoformat()}


def train(task: str, method: str, seed: int, folder: Path, quick: bool, changes: Sequence[str] = ()) -> dict[str, str]:
    """Train once, or resume it, with changes of what ships; return the final evaluation, and what it is of."""
    run(method, [*overrides(task, method), f"seed={seed}", *changes, *(QUICK if quick else ())], folder)
    end = folder / "summary.json"
    diverged = {"return": -math.inf, "solved": 0.0, "crash": 1.0}
    summary = json.loads(end.read_text()) if end.exists() else diverged
    seconds = next((row["time/processor_seconds"] for row in read_rows(folder / "metrics.csv")[::-1]), "")
    own = {"task": task, "algorithm": method, "seed": str(seed), **about(), "seconds": seconds}
    summary = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in summary.items()}
    return own | {k: v for k, v in summary.items() if k not in own}


def missing(args: Namespace, path: Path) -> list[tuple[str, str, int]]:
    """The tasks, methods and seeds that were asked for and that a file of results lacks."""
    done = kept(path, *RUN)
    jobs = product(args.seeds, args.tasks, args.methods)
    return [(task, method, seed) for seed, task, method in jobs if (task, method, str(seed)) not in done]


def shipped(args: Namespace) -> None:
    """Every recipe on every task, over ten seeds; also on a task of your own, or on a track it was not tuned on."""

    def fly(task: str, method: str, seed: int) -> None:
        folder = args.output / task / method / f"seed{seed}"
        row = train(task, method, seed, folder, args.quick)
        curve = [{name: row[name] for name in RUN} | point for point in thinned(folder)]
        add_rows(args.data / "shipped_curves.csv", curve, same=RUN)
        add_rows(args.data / "shipped.csv", [row])

    side_by_side(args.cores, [(fly, *job) for job in missing(args, args.data / "shipped.csv")])


def thinned(folder: Path) -> list[dict[str, str]]:
    """Give the curve of a run, thinned to some forty points."""
    points = [row for row in read_rows(folder / "metrics.csv") if row.get("eval/return")]
    some = points[:: max(-(-len(points) // EVALUATIONS), 1)]
    some += [] if some[-1:] == points[-1:] else points[-1:]
    names = ("steps", "seconds", "return", "solved")
    return [{name: f"{float(point[CURVE[name]]):.6g}" for name in names} for point in some]


OPTIONS = {  # with it, and without it
    "event times": ("env.event_discount", "${gamma}", "null"),
    "clip": ("loss.clip_action_gradient", "2", "null"),
    "KL bound": ("actor.max_kl", "0.05", "null"),
    "correlated noise": ("actor.noise_correlation", "0.9", "0"),
    "fixed noise": ("actor.learn_scale", "false", "true"),  # noise that stays as large as it starts
    "average": ("actor.average", "0.1", "null"),
}
CHANGES = {
    f"{no}{x}": f"{key}={value}" for x, (key, *v) in OPTIONS.items() for no, value in zip(("", "no "), v, strict=True)
}
CHANGED_TASKS, CHANGED_METHODS = ("landing", "racing", "racing_position"), ("bptt", "shac", "abpt")
FACTORS = ("0.5", "1", "2")  # of the learning rate that ships


def is_change(task: str, method: str, change: str) -> bool:
    cfg = shipped_configuration(task, method)
    return OmegaConf.merge(cfg, OmegaConf.from_dotlist([CHANGES[change]])) != cfg


@cache
def shipped_configuration(task: str, method: str) -> DictConfig:
    return composed(method, overrides(task, method))


def ablations(args: Namespace) -> None:
    """One option of the recipes changed at a time: what is each of them worth?"""
    jobs = ((t, m, c, s) for s in args.seeds for t in args.tasks for m in args.methods for c in args.changes)
    _fly_changed(args, "change", [(*job, [CHANGES[job[2]]]) for job in jobs if is_change(*job[:3])])


def rates(args: Namespace) -> None:
    """Half and twice the learning rate of every recipe, over seeds that ``shipped`` does not report."""
    jobs = ((t, m, f, s) for t in args.tasks for m in args.methods for s in args.seeds for f in args.factors)
    _fly_changed(args, "factor", [(*job, scaled(*job[:3])) for job in jobs])


def drones(args: Namespace) -> None:
    """ABPT hovers every drone that ships, with the recipe as it is."""
    jobs = product(args.seeds, args.drones)
    _fly_changed(args, "drone", [("hovering", "abpt", name, seed, [f"env.drone={name}"]) for seed, name in jobs])


def scaled(task: str, method: str, factor: str) -> list[str]:
    """Multiply the learning rates of the policy, from first to last, or the bound on its KL that sets them."""
    names = {"hybrid": ["actor.max_kl"], "train": ["actor.lr"]}.get(method, ["actor.lr", "actor.final_lr"])
    cfg = shipped_configuration(task, method)
    return [f"{name}={float(factor) * OmegaConf.select(cfg, name):g}" for name in names]


def _fly_changed(args: Namespace, column: str, jobs: Iterable[tuple[str, str, str, int, list[str]]]) -> None:
    """Train each task, method, change and seed that has no row yet; the column has the name of the change."""
    path = args.data / f"{args.what}.csv"
    done = kept(path, "task", "algorithm", column, "seed")

    def fly(task: str, method: str, change: str, seed: int, changes: Sequence[str]) -> None:
        folder = args.output / task / method / change.replace(" ", "_") / f"seed{seed}"
        add_rows(path, [{column: change} | train(task, method, seed, folder, args.quick, changes)])

    side_by_side(args.cores, [(fly, *job) for job in jobs if tuple(map(str, job[:4])) not in done])


SETS, STARTS, FIRST = 16, 256, 2_000_000  # sets, starts in each, and the seed of the first, that of evaluate.py
MEASURED = ("return", "solved", "gates_passed")


def starts(args: Namespace) -> None:
    """Policies from many sets of starts, to see how much of a mean over 256 starts is due to the starts."""
    torch.set_num_threads(1)

    def fly(task: str, method: str, seed: int) -> None:
        folder = args.output / task / method / f"seed{seed}"
        if not (folder / "summary.json").exists():
            train(task, method, seed, folder, args.quick)
        cfg, actor, normalizer = load_policy(folder / "checkpoint.pt")
        env = build_env(cfg, STARTS, FIRST, normalizer=normalizer)
        own, rows = {"task": task, "algorithm": method, "seed": seed, "starts": STARTS} | about(), []
        for first in range(FIRST, FIRST + SETS):
            with drawing_from(env, first):
                metrics, _ = evaluate(env, actor)
            reached = {name: f"{metrics[f'eval/{name}']:.6g}" for name in MEASURED if f"eval/{name}" in metrics}
            rows.append(own | {"starts_seed": first} | reached)
        add_rows(args.data / "starts.csv", rows)

    side_by_side(args.cores, [(fly, *job) for job in missing(args, args.data / "starts.csv")])


HALF = "total_steps=2_048_000"  # of what BPTT ships with
POLICIES = {  # recipe, and what differs from what it ships with
    "bptt": ("bptt", []),
    "bptt, half as long": ("bptt", [HALF]),
    "no memory": ("bptt", [HALF, "actor.recurrent=false"]),
    "no velocity": ("bptt", [HALF, "env.observe_velocity=false"]),
    "blind": ("bptt", [HALF, "actor.vision=false", "env.camera=null"]),
    "one setting": ("train", [HALF]),
    "shac": ("shac", []),
    "hybrid": ("hybrid", []),
    "ppo": ("ppo", ["total_steps=2_880_000"]),  # about the seconds of BPTT
    "ppo, four times as long": ("ppo", ["total_steps=11_520_000"]),
}
SPEEDS, DIFFICULTIES = (2.0, 4.0, 6.0, 8.0), ("easy", "middle", "hard")
FORESTS, FIRST_FOREST = 256, 3_000_000  # seed of their random numbers: in no training or choice
CHUNK = 50  # control steps between looks at who still flies
PATIENCE = 2.0  # times the way at the commanded speed, in which a flight must be over


def forest(args: Namespace) -> None:
    """Policies with a camera, trained in the middle forest and flown through others, at all speeds and densities."""
    torch.set_num_threads(1)
    path = args.data / "forest.csv"
    done = kept(path, "policy", "seed", "difficulty", "speed")

    def fly(policy: str, seed: int, todo: list[tuple[str, float]]) -> None:
        recipe, changes = POLICIES[policy]
        folder = args.output / policy.replace(",", "").replace(" ", "_") / f"seed{seed}"
        if not (folder / "summary.json").exists():
            run(recipe, ["task=forest", f"seed={seed}", *changes, *(QUICK if args.quick else ())], folder)
        trained = read_rows(folder / "metrics.csv")[-1]
        cfg, actor, normalizer = load_policy(folder / "checkpoint.pt")
        for difficulty, speed in todo:
            cfg.env.difficulty, cfg.env.speed = difficulty, speed
            env = build_env(cfg, args.forests, FIRST_FOREST, compile=not args.quick, normalizer=normalizer)
            steps = round(PATIENCE * (env.length + max(env.run_up)) / speed / env.control_dt)
            reached = success_rates(env, actor, min(steps, cfg.env.max_episode_steps))
            row = {"policy": policy, "seed": seed, "difficulty": difficulty, "speed": speed, "forests": args.forests}
            row |= {name: f"{x:.6g}" for name, x in reached.items()}
            row |= {"steps": trained["steps"], "seconds": trained["time/processor_seconds"], "machine": machine()}
            add_rows(path, [row])

    jobs = []
    for seed, policy in product(args.seeds, args.policies):
        wanted = product(args.difficulties, args.speeds)
        if todo := [x for x in wanted if (policy, str(seed), *map(str, x)) not in done]:
            jobs.append((fly, policy, seed, todo))
    side_by_side(args.cores, jobs)


def success_rates(env: EnvBase, actor: TensorDictModuleBase, steps: int) -> dict[str, float]:
    """Fly one episode in every environment: the shares that reach the other side, and that crash, of all episodes."""
    flies, solved, crashed = (torch.full((env.num_envs,), x) for x in (True, False, False))
    carry, mode = None, ExplorationType.DETERMINISTIC
    for _ in range(0, steps, CHUNK):
        with torch.no_grad():
            flight, carry = differentiable_rollout(env, actor, carry, CHUNK, exploration_type=mode)
        done, success, crash = (flight["next", name].squeeze(-1) for name in ("done", "success", "crash"))
        ends = flies & done.any(1)
        last = done.int().argmax(1, keepdim=True)
        solved |= ends & success.gather(1, last).squeeze(1)
        crashed |= ends & crash.gather(1, last).squeeze(1)
        flies &= ~ends
        if not flies.any():
            break
    return {"solved": solved.double().mean().item(), "crash": crashed.double().mean().item()}
