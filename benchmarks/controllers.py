"""Classical controllers beside learned policies: success, error, gates, and milliseconds per control step.

python -m benchmarks.controllers --checkpoints outputs/.../checkpoint.pt ...   # and fills in docs/controllers.md

All fly the same fresh starts, as the recipes configure each task. In "other drones" mass and motors are drawn at random
in each episode, which neither the controllers nor the policies know. A time is the median of single calls. MPC is
compiled.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from benchmarks.laps import racing
from benchmarks.report import command_line, publish, save
from torchrl_quad import MPC, GeometricController
from torchrl_quad.engine import has_compiler
from torchrl_quad.files import read_rows
from torchrl_quad.training.building import build_env
from torchrl_quad.training.configuration import compose
from torchrl_quad.training.evaluation import evaluate, load_policy

PAGE = Path(__file__).parents[1] / "docs/controllers.md"
SEED = 2_000_000  # of the starts, as in recipes/evaluate.py
OTHER_DRONES = {
    "mass": {"scale": [0.8, 1.2]},
    "thrust_map": {"scale": [0.9, 1.1]},
    "motor_time_constant": {"scale": [0.7, 1.3]},
}
TASKS = ["hovering", "tracking", "landing", "racing"]
CONTROLLERS = {"geometric": GeometricController, "mpc": MPC}
ERRORS = {"hovering": "position_error", "tracking": "tracking_rmse", "landing": "position_error"}


def configuration(task: str, steps: int, **changes: Any) -> Any:
    cfg = compose("abpt", [f"task={task}"])
    for name, value in {**changes, **({"max_episode_steps": steps} if steps else {})}.items():
        cfg.env[name] = value
    cfg.normalize = False
    return cfg


def milliseconds(env: EnvBase, policy: TensorDictModuleBase, calls: int) -> float:
    """The median processor time of a call for one drone [ms]; the environment's step is not in it."""
    carry, durations = env.reset(), []
    with torch.no_grad():
        for _ in range(calls + 1):
            begin = time.process_time()
            carry = policy(carry)
            durations.append(time.process_time() - begin)
            _, carry = env.step_and_maybe_reset(carry)
    return 1e3 * float(np.median(durations[1:]))


def measure(task: str, name: str, checkpoint: str | None, args: argparse.Namespace) -> dict[str, Any]:
    learned = load_policy(Path(checkpoint)) if checkpoint else None

    def policy(env: EnvBase) -> TensorDictModuleBase:
        if learned:
            return learned[1]
        controller = CONTROLLERS[name](env, reference=racing(env) if task == "racing" else None)
        if name == "mpc" and has_compiler():
            controller.compile()
        return controller

    if learned and learned[2] is not None:
        raise SystemExit(f"{checkpoint} has a normaliser: give checkpoints without one.")
    row: dict[str, Any] = {"task": task, "policy": name, "starts": args.starts}
    for suffix, changes in (("", {}), (", other drones", {"randomize": OTHER_DRONES})):
        env = build_env(configuration(task, args.steps, **changes), args.starts, SEED)
        metrics, _ = evaluate(env, policy(env))
        row[f"solved{suffix}"] = round(metrics["eval/solved"], 4)
        row[f"crash{suffix}"] = round(metrics["eval/crash"], 4)
        measured = {"error [cm]": (ERRORS.get(task), 100), "gates": ("gates_passed", 1), "lap [s]": ("lap_time", 1)}
        for column, (metric, factor) in measured.items():
            if f"eval/{metric}" in metrics:
                row[f"{column}{suffix}"] = round(factor * metrics[f"eval/{metric}"], 3)
    env = build_env(configuration(task, args.steps), 1, SEED)
    row["ms per step"] = round(milliseconds(env, policy(env), args.calls), 2)
    return row


def table(rows: list[dict[str, Any]]) -> str:
    head = "task | policy | starts | solved | error or gates | ms per step | other drones: solved | error or gates"
    lines = [head.split(" | "), ["---"] * 8]
    for row in rows:
        solved, reached = [], []
        for suffix in ("", ", other drones"):
            gates, lap, error = (row.get(f"{name}{suffix}") for name in ("gates", "lap [s]", "error [cm]"))
            solved.append(f"{float(row[f'solved{suffix}']):.1%}" if row.get(f"solved{suffix}") else "")
            racing = f"{float(gates):.1f} gates, lap {float(lap):.2f} s" if gates else ""
            reached.append(racing or (f"{float(error):.1f} cm" if error else ""))
        name = {"geometric": "geometric", "mpc": "MPC"}.get(row["policy"], f"{row['policy'].upper()}, learned")
        cells = [row["task"], name, str(row["starts"]), solved[0], reached[0], f"{float(row['ms per step']):.1f}"]
        lines.append([*cells, solved[1], reached[1]])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    options = {"tasks": TASKS, "controllers": list(CONTROLLERS), "checkpoints": [], "starts": 256, "calls": 100}
    options |= {"steps": 0}  # 0 is an episode as the recipes have it
    args = command_line(__doc__, "controllers.csv", **options)
    trained = [(cfg.task, cfg.algorithm, path) for path in args.checkpoints for cfg in [load_policy(Path(path))[0]]]
    jobs = [(task, name, path) for task, name, path in trained if task in args.tasks]
    jobs += [(task, name, None) for name in args.controllers for task in args.tasks]
    rows = read_rows(args.output)
    for job in jobs:
        if not any((row["task"], row["policy"]) == job[:2] for row in rows):
            rows.append(measure(*job, args))
            save(args.output, sorted(rows, key=lambda row: (TASKS.index(row["task"]), row["policy"])))
    publish(args.output, PAGE, table(read_rows(args.output)))


if __name__ == "__main__":
    main()
