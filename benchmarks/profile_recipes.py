"""What a training iteration spends its time on, per algorithm: per cent of its wall-clock time.

python -m benchmarks.profile_recipes --algorithms bptt abpt --overrides num_envs=256 horizon=32
"""

import functools
import runpy
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import torch
from tensordict.nn import ProbabilisticTensorDictSequential
from tqdm import tqdm

from benchmarks.report import command_line, in_own_process, save

RECIPES = Path(__file__).parents[1] / "recipes"

PARTS = ("physics", "actor", "critic", "loss", "optimiser", "bookkeeping", "logging")


class Clocks:
    """Exclusive wall-clock time of nested parts [s]."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.running: list[str] = []
        self.since = 0.0

    def switch(self, part: str | None) -> None:
        now = time.perf_counter()
        if self.running:
            self.seconds[self.running[-1]] += now - self.since
        self.since = now
        if part is None:
            self.running.pop()
        else:
            self.running.append(part)

    def around(self, owner, name: str, part: str) -> None:
        """Put a clock around a function of a class or module."""
        wrapped = owner.__dict__[name]
        is_static = isinstance(wrapped, staticmethod)
        function = wrapped.__func__ if is_static else wrapped

        @functools.wraps(function)
        def timed(*args, **kwargs):
            self.switch(part)
            try:
                return function(*args, **kwargs)
            finally:
                self.switch(None)

        setattr(owner, name, staticmethod(timed) if is_static else timed)


def profile(algorithm: str, overrides: list[str], skip: int, iterations: int) -> dict[str, float | str]:
    """What each part of a recipe takes; changes the modules that it measures, and so wants a process of its own."""
    import torchrl_quad
    from torchrl_quad import objectives
    from torchrl_quad.data import rollout as rollouts
    from torchrl_quad.engine import stepper
    from torchrl_quad.envs import base
    from torchrl_quad.training import building, loop

    clocks = Clocks()
    clocks.around(stepper.Stepper, "step", "physics")
    for name in ("forward", "backward"):
        clocks.around(stepper._Horizon, name, "physics")
    for name in ("forward", "adjoint", "weight_gradients"):
        clocks.around(stepper._Policy, name, "actor")
    clocks.around(ProbabilisticTensorDictSequential, "forward", "actor")
    clocks.around(base, "fly", "bookkeeping")
    clocks.around(rollouts, "differentiable_rollout", "bookkeeping")
    clocks.around(objectives.PathwiseLoss, "loss_actor", "loss")
    for loss, name in ((objectives.ABPTLoss, "loss_qvalue"), (objectives.SHACLoss, "loss_value")):
        clocks.around(loss, name, "critic")
    clocks.around(objectives.PathwiseCriticLoss, "write_value_target", "critic")
    clocks.around(torch.optim.Adam, "step", "optimiser")
    clocks.around(torch.nn.utils, "clip_grad_norm_", "optimiser")
    clocks.around(building, "update_normalizer", "bookkeeping")
    clocks.around(loop.Run, "record", "logging")

    # What is not physics in the backward pass belongs to the network whose optimiser is about to step.
    optimise, iterate = loop.Run.optimise, loop.Run.__iter__
    total, count = 0.0, 0

    def timed_optimise(self, optimizer, loss):
        clocks.switch(optimizer.name)
        try:
            optimise(self, optimizer, loss)
        finally:
            clocks.switch(None)

    def timed_iterations(self):
        nonlocal total, count
        self.cfg.eval.interval = 10**9
        for iteration in iterate(self):
            if iteration == skip:
                clocks.seconds.clear()
            start = time.perf_counter()
            clocks.switch("bookkeeping")
            yield iteration
            clocks.switch(None)
            if iteration >= skip:
                total, count = total + time.perf_counter() - start, count + 1
            if count == iterations:
                return

    loop.Run.optimise, loop.Run.__iter__ = timed_optimise, timed_iterations
    torchrl_quad.differentiable_rollout = rollouts.differentiable_rollout
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = [algorithm, f"hydra.run.dir={folder}/run", "total_steps=1_000_000_000", *overrides]
        runpy.run_path(str(RECIPES / f"{algorithm}.py"), run_name="__main__")
    shares = {f"{part} %": round(100 * clocks.seconds[part] / total, 1) for part in PARTS}
    return {"algorithm": algorithm, "ms per iteration": round(1e3 * total / count, 1), **shares}


def main() -> None:
    overrides = ["num_envs=256", "horizon=32", "compile=true"]
    options = {"algorithms": ["bptt", "shac", "abpt"], "overrides": overrides, "iterations": 20, "skip": 5}
    args = command_line(__doc__, "profile.csv", **options)
    rows = [
        in_own_process(profile, algorithm, args.overrides, args.skip, args.iterations)
        for algorithm in tqdm(args.algorithms)
    ]
    save(args.output, rows, overrides=" ".join(args.overrides))


if __name__ == "__main__":
    main()
