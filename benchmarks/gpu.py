"""All that a GPU has to show, in at most eight minutes: equality, synchronisation, learning, checkpoints, speed.

python -m benchmarks.gpu

Every row is written as soon as it is known, and "result" says "ok", what failed, or that no time was left. The largest
numbers of environments come last. ``--device cpu`` with small numbers goes the same way.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from benchmarks.report import command_line, in_own_process, save
from benchmarks.throughput import forward_only, with_gradient
from benchmarks.time_to_solve import RECIPES, solve
from torchrl_quad import ActionSequence, differentiable_rollout, make_actor, make_env

MODES = ["eager", "compiled", "graphs"]  # the last one compiled, and launched by CUDA graphs
Row = dict[str, Any]


def build(task: str, mode: str, **options: Any) -> EnvBase:
    env = make_env(task, seed=0, **options)
    if mode == "eager":
        return env
    return env.compile(**({"mode": "reduce-overhead"} if mode == "graphs" else {}))


def synchronize(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def difference(device: str, mode: str, n: int, task: str = "racing", horizon: int = 16) -> Row:
    """How far rewards and gradients of a flight on the device are from those on the CPU, relative to the largest."""
    options = {"num_envs": n, "dtype": torch.float64}
    host, env = build(task, "eager", **options), build(task, mode, device=device, **options)
    start = host.reset()
    actions = host.hover_action + 0.1 * torch.randn(horizon, n, 4, dtype=torch.float64)

    def fly(env: EnvBase) -> list[Tensor]:
        given = actions.to(env.device, copy=True).requires_grad_()
        carry = env.reset(start.exclude("_reset").to(env.device), set_state=True)
        reward = differentiable_rollout(env, ActionSequence(given), carry, horizon)[0]["next", "reward"]
        reward.sum().backward()
        return [reward.detach().cpu(), given.grad.cpu()]

    expected = fly(host)
    for _ in range(2):  # a graph is recorded by the first flight, and replayed by the second
        found = fly(env)
    values, gradients = (float((a - b).abs().max() / b.abs().max()) for a, b in zip(found, expected, strict=True))
    verdict = "ok" if max(values, gradients) <= 1e-9 else "differs"
    return {"values": f"{values:.1e}", "gradients": f"{gradients:.1e}", "result": verdict}


@contextlib.contextmanager
def no_waiting(device: str) -> Iterator[None]:
    """Raise where the host waits for the device."""
    if device != "cpu":
        torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        if device != "cpu":
            torch.cuda.set_sync_debug_mode("default")


def waits(device: str, mode: str, n: int, horizon: int = 16) -> Row:
    """Fly and differentiate a horizon in which episodes end, and never wait for the device."""
    env = build("racing", mode, num_envs=n, device=device, max_episode_steps=5)
    actor, carry = make_actor(env), env.reset()
    for guard in (contextlib.nullcontext(), contextlib.nullcontext(), no_waiting(device)):  # the first ones compile
        with guard:
            rollout, carry = differentiable_rollout(env, actor, carry, horizon)
            rollout["next", "reward"].mean().backward()
    return {"result": "ok"}


def checkpoint(device: str) -> Row:
    """A policy that was trained on the device flies on the CPU."""
    with tempfile.TemporaryDirectory() as folder:
        small = [f"device={device}", "compile=false", "total_steps=1024", "num_envs=16", "horizon=8"]
        run = [sys.executable, RECIPES / "bptt.py", *small, "env.max_episode_steps=20", f"hydra.run.dir={folder}/run"]
        judge = [sys.executable, RECIPES / "evaluate.py", f"checkpoint={folder}/run/checkpoint.pt", "device=cpu"]
        for command in (run, judge):
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                return {"result": done.stderr.strip().splitlines()[-1]}
    return {"result": "ok"}


def learned(device: str, algorithm: str, task: str, limit: float, overrides: list[str]) -> Row:
    """Seconds from the start of a recipe to 99 % of the episodes solved."""
    with tempfile.TemporaryDirectory() as cache:
        options = [f"task={task}", f"device={device}", "eval.interval=5", *overrides]
        seconds = solve(algorithm, 0, options, Path(cache), limit)
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


def speed(device: str, mode: str, n: int, horizon: int, policy: bool) -> Row:
    """Thousand control steps per second, and the share of what memory allows: to write the rollout, then to read it."""
    env = build("hovering", mode, num_envs=n, device=device)
    actor, sizes = make_actor(env), []
    actions = env.hover_action + 0.1 * torch.randn(horizon, n, 4, device=device)

    def fly(actions: Tensor) -> Tensor:
        rollout, _ = differentiable_rollout(env, actor if policy else ActionSequence(actions), env.reset(), horizon)
        sizes[:] = [written(rollout)]
        return rollout["next", "reward"].sum()

    row: Row = {"result": "ok"}
    for name, run, passes in (("forward", forward_only, 1), ("with gradient", with_gradient, 2)):
        best = float("inf")
        for _ in range(5):
            synchronize(device)
            start = time.perf_counter()
            run(fly, actions)
            synchronize(device)
            best = min(best, time.perf_counter() - start)
        row |= {f"{name} [1000/s]": f"{n * horizon / best / 1e3:.3g}"}
        row |= {f"{name}, of bound": f"{passes * sizes[0] / bandwidth(device) / best:.2g}"}
    return row


def speeds(device: str, modes: list[str], n: int, horizon: int) -> list[tuple[Row, float, Callable[..., Any], Any]]:
    """The checks of speed with n environments, compiled, as far as modes has them."""
    named = [(mode, policy) for mode in modes if mode != "eager" or len(modes) == 1 for policy in (False, True)]
    check = "speed, actions given", "speed, policy inside"
    return [
        ({"check": check[policy], "mode": mode, "num_envs": n}, 20, speed, (device, mode, n, horizon, policy))
        for mode, policy in named
    ]


def main() -> None:
    sizes, options = [1024, 32768, 1048576], {"device": "cuda", "horizon": 32, "seconds": 480.0}
    args = command_line(__doc__, "gpu.csv", num_envs=sizes, modes=MODES, overrides=[""], check_envs=256, **options)
    deadline, device, overrides = time.monotonic() + args.seconds, args.device, [x for x in args.overrides if x]
    checks: list[tuple[Row, float, Callable[..., Any], tuple[Any, ...]]] = []  # what, seconds that it may need, and how
    for mode in args.modes:
        own = {"mode": mode, "num_envs": args.check_envs}
        checks.append(({"check": "equals the CPU", **own}, 30, difference, (device, mode, args.check_envs)))
        checks.append(({"check": "waits for nothing", **own}, 30, waits, (device, mode, args.check_envs)))
    smallest, *others = [speeds(device, args.modes, n, args.horizon) for n in sorted(args.num_envs)]
    checks += [*smallest, ({"check": "checkpoint to CPU"}, 30, checkpoint, (device,))]
    for task, limit in (("hovering", 45.0), ("racing", 90.0)):
        checks.append(({"check": f"{task} solved"}, limit, learned, (device, "shac", task, limit, overrides)))
    checks += [check for same_size in others for check in same_size]
    rows: list[Row] = []
    where = torch.cuda.get_device_name() if device != "cpu" else "cpu"
    for row, needed, check, arguments in checks:
        found: Row = {"result": "no time left"}
        if time.monotonic() + needed <= deadline:
            try:
                found = in_own_process(partial(check, *arguments))
            except Exception as error:  # such as a memory that is full: the next check may pass
                found = {"result": f"{type(error).__name__}: {str(error).splitlines()[0][:120]}"}
        rows.append({**row, **found})
        save(args.output, rows, device=where)
    if failed := [row["check"] for row in rows if row["result"] not in ("ok", "no time left")]:
        raise SystemExit(f"Not ok: {', '.join(failed)}.")


if __name__ == "__main__":
    main()
