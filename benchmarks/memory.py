"""Memory that the graph of a horizon holds, per environment and control step, and what keeping less of it costs.

python -m benchmarks.memory --num-envs 1024

In the mode "recompute" the eager step keeps only its input, and is done again backward (torch.utils.checkpoint). The
memory is what the process (on Linux) has gained between the start of a horizon and its end.
"""

import functools
import gc
import os
import time
from pathlib import Path

import torch
from torch.utils.checkpoint import checkpoint
from tqdm import tqdm

from benchmarks.report import command_line, in_own_process, save
from torchrl_quad import ActionSequence, differentiable_rollout, make_env

MODES = ["eager", "recompute", "compiled"]


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def measure(mode: str, n: int, horizon: int, rounds: int) -> dict[str, float | str]:
    """Bytes and time per environment and step; wants a process of its own, since memory is not given back at once."""
    torch.set_num_threads(1)
    env = make_env("hovering", num_envs=n, compile=mode == "compiled")
    if mode == "recompute":
        env._stepper.step = functools.partial(checkpoint, env._stepper.step, use_reentrant=False)
    start = env.reset()

    def fly(steps: int) -> dict[str, float]:
        actions = (env.hover_action + 0.1 * torch.randn(steps, n, 4)).requires_grad_()
        gc.collect()
        before, begin = resident(), time.perf_counter()
        rollout, _ = differentiable_rollout(env, ActionSequence(actions), start, steps)
        middle, held = time.perf_counter(), resident() - before
        rollout["next", "reward"].sum().backward()
        return {"held": held, "data": rollout.bytes(), "fwd": middle - begin, "bwd": time.perf_counter() - middle}

    fly(2)  # compiles
    flights = [fly(horizon) for _ in range(rounds)]
    steps = n * horizon
    return {
        "step": mode,
        "held [byte]": round(flights[0]["held"] / steps),
        "of it data [byte]": round(flights[0]["data"] / steps),
        "forward [us]": round(1e6 * min(flight["fwd"] for flight in flights) / steps, 2),
        "backward [us]": round(1e6 * min(flight["bwd"] for flight in flights) / steps, 2),
    }


def main() -> None:
    args = command_line(__doc__, "memory.csv", num_envs=1024, modes=MODES, horizon=32, rounds=4)
    rows = [in_own_process(measure, mode, args.num_envs, args.horizon, args.rounds) for mode in tqdm(args.modes)]
    save(args.output, rows, num_envs=args.num_envs, horizon=args.horizon)


if __name__ == "__main__":
    main()
