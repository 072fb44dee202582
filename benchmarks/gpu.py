"""All that a GPU has to show, in at most eight minutes: equality, synchronisation, learning, checkpoints, speed.

python -m benchmarks.gpu

The checks compile side by side, each in a process of its own; speeds are measured one by one when all else is over.
Every row is written as soon as it is known, and "result" says "ok", what failed, or that no time was left.
``--device cpu`` with small numbers goes the same way.
"""

from __future__ import annotations

import itertools
import multiprocessing
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch._inductor.runtime.cache_dir_utils import cache_dir
from torchrl.envs import EnvBase

from benchmarks.report import command_line, in_own_process, save
from benchmarks.throughput import forward_only, with_gradient
from benchmarks.time_to_solve import RECIPES, solve
from torchrl_quad import ActionSequence, differentiable_rollout, make_actor, make_env

MODES = ["eager", "compiled"]
Row = dict[str, Any]


def build(task: str, mode: str, **options: Any) -> EnvBase:
    return make_env(task, seed=0, compile=mode == "compiled", **options)


def synchronize(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def difference(device: str, mode: str, n: int, task: str = "racing", horizon: int = 16) -> Row:
    """How far rewards and gradients of a flight on the device are from those on the CPU, relative to the largest."""
    options = {"num_envs": n, "dtype": torch.float64}
    host, env = make_env(task, seed=0, **options), build(task, mode, device=device, **options)
    start = host.reset()
    actions = host.hover_action + 0.1 * torch.randn(horizon, n, 4, dtype=torch.float64)

    def fly(env: EnvBase) -> list[Tensor]:
        given = actions.to(env.device, copy=True).requires_grad_()
        carry = env.reset(start.exclude("_reset").to(env.device), set_state=True)
        reward = differentiable_rollout(env, ActionSequence(given), carry, horizon)[0]["next", "reward"]
        reward.sum().backward()
        return [reward.detach().cpu(), given.grad.cpu()]

    expected = fly(host)
    pairs = zip(fly(env), expected, strict=True)
    values, gradients = (float((a - b).abs().max() / b.abs().max()) for a, b in pairs)
    verdict = "ok" if max(values, gradients) <= 1e-9 else "differs"
    return {"values": f"{values:.1e}", "gradients": f"{gradients:.1e}", "result": verdict}


def debug_waits(device: str, mode: str) -> None:
    if device != "cpu":
        torch.cuda.set_sync_debug_mode(mode)


def waits(device: str, n: int, horizon: int = 16) -> Row:
    """How often the host waits for the device in a horizon and its gradient: as often in one that is twice as long."""
    env = build("racing", "compiled", num_envs=n, device=device, max_episode_steps=5)
    actor, carry = make_actor(env), env.reset()

    def count(steps: int) -> list[str]:
        nonlocal carry
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            debug_waits(device, "warn")
            rollout, carry = differentiable_rollout(env, actor, carry, steps)
            rollout["next", "reward"].mean().backward()
            debug_waits(device, "default")
        return [f"{Path(w.filename).name}:{w.lineno}" for w in seen if "synchroniz" in str(w.message)]

    count(horizon)  # compiles
    once, twice = count(horizon), count(2 * horizon)
    verdict = "ok" if len(once) == len(twice) else f"{len(twice)} in twice the horizon"
    return {"waits": len(once), "where": " ".join(sorted(set(twice))), "result": verdict}


def checkpoint(device: str) -> Row:
    """A policy that was trained on the device flies on the CPU."""
    with tempfile.TemporaryDirectory() as folder:
        small = [f"device={device}", "compile=false", "total_steps=1024", "num_envs=16", "horizon=8"]
        run = [sys.executable, RECIPES / "bptt.py", *small, "env.max_episode_steps=20", f"hydra.run.dir={folder}/run"]
        judge = [sys.executable, RECIPES / "evaluate.py", f"checkpoint={folder}/run/checkpoint.pt", "device=cpu"]
        for command in (run, judge):
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                return {"result": (done.stderr.strip() or f"ended with {done.returncode}").splitlines()[-1]}
    return {"result": "ok"}


def learned(device: str, algorithm: str, task: str, limit: float, overrides: list[str]) -> Row:
    """Seconds from the start of a recipe to 99 % of the episodes solved, with what is in the compile cache."""
    options = [f"task={task}", f"device={device}", "eval.interval=5", *overrides]
    seconds = solve(algorithm, 0, options, Path(cache_dir()), limit)
    return {"seconds": "" if seconds is None else round(seconds, 1), "result": "ok" if seconds else "not solved"}


def bandwidth(device: str, size: int = 2**28) -> float:
    """Bytes per second that a copy reads and writes."""
    x = torch.empty(size if device != "cpu" else size // 16, dtype=torch.uint8, device=device)
    y, best = torch.empty_like(x), float("inf")
    for _ in range(5):
        synchronize(device)
        start = time.perf_counter()
        y.copy_(x)
        synchronize(device)
        best = min(best, time.perf_counter() - start)
    return 2 * x.numel() / best


def written(rollout: TensorDictBase) -> int:
    """The bytes that a rollout holds, each tensor once."""
    storages = {x.untyped_storage().data_ptr(): x.untyped_storage() for x in rollout.values(True, True)}
    return sum(storage.nbytes() for storage in storages.values())


def speed(device: str, mode: str, n: int, horizon: int, policy: bool, turn: Path, deadline: float) -> Row:
    """Thousand control steps per second, and the share of what memory allows: to write the rollout, then to read it.

    It compiles at once, and measures as soon as the file ``turn`` exists.
    """
    env = build("hovering", mode, num_envs=n, device=device)
    actor, sizes = make_actor(env), []
    actions = env.hover_action + 0.1 * torch.randn(horizon, n, 4, device=device)

    def fly(actions: Tensor) -> Tensor:
        steps = ActionSequence(actions)
        rollout, _ = differentiable_rollout(env, actor if policy else steps, env.reset(), len(actions))
        sizes[:] = [written(rollout)]
        return rollout["next", "reward"].sum()

    for run in (forward_only, with_gradient):
        run(fly, actions[:2])
    if device != "cpu":
        torch.cuda.empty_cache()  # for the others
    while not turn.exists():
        if time.time() > deadline:
            return {"result": "no time left"}
        time.sleep(0.1)
    row: Row = {"result": "ok"}
    for name, run, passes in (("forward", forward_only, 1), ("with gradient", with_gradient, 2)):
        best = float("inf")
        for _ in range(6):
            synchronize(device)
            start = time.perf_counter()
            run(fly, actions)
            synchronize(device)
            best = min(best, time.perf_counter() - start)
        row |= {f"{name} [1000/s]": f"{n * horizon / best / 1e3:.3g}"}
        row |= {f"{name}, of bound": f"{passes * sizes[0] / bandwidth(device) / best:.2g}"}
    return row


def main() -> None:
    sizes, options = [1024, 32768], {"device": "cuda", "horizon": 32, "seconds": 480.0}
    args = command_line(__doc__, "gpu.csv", num_envs=sizes, modes=MODES, overrides=[""], check_envs=256, **options)
    start, device, overrides = time.time(), args.device, [x for x in args.overrides if x]
    early, late = start + 0.7 * args.seconds, start + args.seconds
    checks: list[tuple[Row, float, Callable[..., Any], tuple[Any, ...]]] = []  # what, until when, and how
    for mode in args.modes:
        own: Row = {"mode": mode, "num_envs": args.check_envs}
        checks.append(({"check": "equals the CPU", **own}, early, difference, (device, mode, args.check_envs)))
    if "compiled" in args.modes:  # eager, TorchRL's TanhNormal waits four times a step
        own = {"mode": "compiled", "num_envs": args.check_envs}
        checks.append(({"check": "waits for the device", **own}, early, waits, (device, args.check_envs)))
    checks.append(({"check": "checkpoint to CPU"}, early, checkpoint, (device,)))
    limit = early - start - 10  # its process has to start, and to end
    checks.append(({"check": "hovering solved"}, early, learned, (device, "train", "hovering", limit, overrides)))
    rows: list[Row] = []
    where = torch.cuda.get_device_name() if device != "cpu" else "cpu"
    with tempfile.TemporaryDirectory() as folder:
        for n, mode, policy in itertools.product(sorted(args.num_envs), args.modes, (False, True)):
            row = {"check": "speed, policy inside" if policy else "speed, actions given", "mode": mode, "num_envs": n}
            turn = Path(folder) / str(len(checks))
            checks.append((row, late, speed, (device, mode, n, args.horizon, policy, turn, late)))
        with ThreadPoolExecutor(len(checks)) as pool:
            running = [pool.submit(in_own_process, partial(check, *given)) for _, _, check, given in checks]
            for number, ((row, until, *_), result) in enumerate(zip(checks, running, strict=True)):
                Path(folder, str(number)).touch()
                try:
                    found = result.result(max(0.0, until - time.time()))
                except TimeoutError:
                    found = {"result": "no time left"}
                except Exception as error:  # such as a memory that is full: the others may pass
                    found = {"result": str(error).splitlines()[0][:140]}
                rows.append({**row, **found})
                save(args.output, rows, device=where)
            for process in multiprocessing.active_children():
                process.kill()
    if failed := [row["check"] for row in rows if row["result"] not in ("ok", "no time left")]:
        raise SystemExit(f"Not ok: {', '.join(failed)}.")


if __name__ == "__main__":
    main()
