"""Control steps per second, forward alone and with the gradient of a horizon to all its actions.

python benchmarks/throughput.py --num-envs 64 256 1024 --threads 1

=========  =============================================================================================
physics    the control step alone: rate controller, rotors and rigid body, four physics steps
env        the whole environment through ``differentiable_rollout``, with fixed actions
actor      the same with a 64-64 policy
rollout    the same through ``env.rollout``
torchrl    the same through TorchRL's own loop, which transforms and other policies fall back to
crazyflow  its body-rate model (JAX), ten substeps, where it is installed: pip install crazyflow
=========  =============================================================================================

All of one size are timed in turns, round after round, and the best round counts. Writes
``benchmarks/results/throughput.csv`` size by size, and leaves out what stands there already.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from report import RESULTS, finished, save
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_quad import differentiable_rollout, make_actor, make_env
from torchrl_quad.dynamics import QuadrotorState, control_step
from torchrl_quad.dynamics.compiled import CompiledControlStep


class FixedActions(TensorDictModuleBase):
    """A policy that does not look."""

    in_keys, out_keys = ["observation"], ["action"]

    def __init__(self, actions: Tensor) -> None:
        super().__init__()
        self.sequence = iter(actions.unbind())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", next(self.sequence))


class Physics:
    """The control step of an environment without the environment."""

    def __init__(self, env: EnvBase, compiled: bool) -> None:
        self.env, self.compiled = env, compiled
        state = env.reset()["state"]
        self.start = QuadrotorState(*(state[name] for name in QuadrotorState._fields))
        step = CompiledControlStep(env.controller, env.dt, env.substeps, env.integrator)

        def setpoint(action: Tensor) -> Tensor:
            return torch.cat([x.t() for x in env.controller.setpoint(action)])

        def adjoint(states: list[Tensor], action: Tensor, grad: Tensor) -> tuple[Tensor, Tensor]:
            asked, pull_back = torch.func.vjp(setpoint, action)
            grad, grad_asked, *_ = step.pull_back(states, asked, (), (), grad)
            return grad, pull_back(grad_asked)[0]

        options = {"fullgraph": True, "dynamic": False}
        forward = torch.compile(lambda state, action: step.fly(state, setpoint(action), (), ()), **options)
        backward = torch.compile(adjoint, **options)

        class Step(torch.autograd.Function):
            @staticmethod
            def forward(ctx, state: Tensor, action: Tensor) -> Tensor:
                states = forward(state.detach(), action.detach())
                ctx.save_for_backward(action.detach(), *states)
                return states[-1]

            @staticmethod
            @torch.autograd.function.once_differentiable
            def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor]:
                action, *states = ctx.saved_tensors
                return backward(states, action, grad)

        self.step = Step

    def __call__(self, actions: Tensor) -> Tensor:
        if self.compiled:
            state = torch.cat(self.start, -1).t().contiguous()
            for action in actions.unbind():
                state = self.step.apply(state, action)
            return state.sum()
        env, state = self.env, self.start
        for action in actions.unbind():
            state = control_step(state, action, env.nominal, env.controller, env.dt, env.substeps, env.integrator)
        return torch.cat(state, -1).sum()


def flights(env: EnvBase, compiled: bool) -> dict[str, Callable[[Tensor], Tensor]]:
    """From a horizon of actions (horizon, n, 4) to a number, by name; those with a policy ignore the actions."""
    actor, start = make_actor(env), env.reset()
    options = {"tensordict": start, "auto_reset": False, "break_when_any_done": False}

    def return_of(rollout: TensorDictBase) -> Tensor:
        return rollout["next", "reward"].sum()

    return {
        "physics": Physics(env, compiled),
        "env": lambda actions: return_of(differentiable_rollout(env, FixedActions(actions), start, len(actions))[0]),
        "actor": lambda actions: return_of(differentiable_rollout(env, actor, start, len(actions))[0]),
        "rollout": lambda actions: return_of(env.rollout(len(actions), actor, **options)),
        "torchrl": lambda actions: return_of(EnvBase.rollout(env, len(actions), actor, **options)),
    }


def crazyflow(n: int) -> tuple[Callable[[Tensor], None], Callable[[Tensor], None]]:
    """A horizon of Crazyflow's body-rate model, forward and with its gradient to the actions."""
    import jax
    import jax.numpy as jnp
    from crazyflow.control import Control
    from crazyflow.sim import Dynamics, Sim
    from crazyflow.sim.functional import body_rate_control

    sim = Sim(n_worlds=n, dynamics=Dynamics.first_principles, control=Control.body_rate, freq=500)
    step = sim.build_step_fn()

    def fly(actions, data):
        data, _ = jax.lax.scan(lambda data, action: (step(body_rate_control(data, action), 10), None), data, actions)
        return data.states.pos.sum() + data.states.vel.sum()

    forward, gradient = jax.jit(fly), jax.jit(jax.grad(fly))

    def run(function, actions: Tensor) -> None:
        jax.block_until_ready(function(jnp.asarray(actions.detach().numpy())[:, :, None], sim.data))

    return partial(run, forward), partial(run, gradient)


def forward_only(flight: Callable[[Tensor], Tensor], actions: Tensor) -> None:
    with torch.no_grad():
        flight(actions)


def with_gradient(flight: Callable[[Tensor], Tensor], actions: Tensor) -> None:
    flight(actions.detach().requires_grad_()).backward()


def measure(n: int, mode: str, task: str, horizon: int, rounds: int, device: str) -> list[dict[str, float | str]]:
    """The best of several rounds for each case."""
    env = make_env(task, num_envs=n, device=device, compile=mode == "compiled")
    actions = env.hover_action + 0.1 * torch.randn(horizon, n, 4, device=device)
    cases = {}
    for name, flight in flights(env, mode == "compiled").items():
        cases[name] = partial(forward_only, flight), partial(with_gradient, flight)
    if importlib.util.find_spec("crazyflow") and mode == "compiled":
        cases["crazyflow"] = crazyflow(n)
    best = {(name, i): float("inf") for name in cases for i in range(2)}
    for _ in range(rounds):
        for name, pair in cases.items():
            for i, run in enumerate(pair):
                for _ in range(4):  # the first one compiles, or finds the caches full of another case
                    start = time.perf_counter()
                    run(actions)
                    if device != "cpu":
                        torch.cuda.synchronize()
                    best[name, i] = min(best[name, i], time.perf_counter() - start)
    rows = []
    for name in cases:
        both = {key: round(n * horizon / best[name, i] / 1e3, 1) for i, key in enumerate(("forward", "with gradient"))}
        ratio = best["physics", 1] / best[name, 1]
        rows.append({"num_envs": n, "mode": mode, "case": name, **both, "of physics": round(ratio, 2)})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=int, nargs="+", default=[64, 256, 1024, 4096, 16384])
    parser.add_argument("--modes", nargs="+", default=["compiled", "eager"], choices=["compiled", "eager"])
    parser.add_argument("--task", default="hovering")
    parser.add_argument("--horizon", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output", type=Path, default=RESULTS / "throughput.csv")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rows = finished(args.output)
    for mode, n in tqdm(list(itertools.product(args.modes, args.num_envs))):
        if not any(row["num_envs"] == str(n) and row["mode"] == mode for row in rows):
            rows += measure(n, mode, args.task, args.horizon, args.rounds, args.device)
            save(args.output, rows, task=args.task, horizon=args.horizon, unit="1000 control steps per second")


if __name__ == "__main__":
    main()
