"""Control steps per second, forward alone and with the gradient of a horizon to all its actions.

python -m benchmarks.throughput --num-envs 64 256 1024 --threads 1

Cases of one size are timed in turns, round after round, and the best round counts. What is there already is left out.
"""

from __future__ import annotations

import importlib.util
import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import Compose, EnvBase, ObservationNorm, RewardScaling, RewardSum, StepCounter, TransformedEnv
from tqdm import tqdm

from benchmarks.report import command_line, save
from torchrl_quad import ActionSequence, differentiable_rollout, make_actor, make_env
from torchrl_quad.engine import Stepper, Transition
from torchrl_quad.engine.policy import GivenActions
from torchrl_quad.engine.simulation import State
from torchrl_quad.files import read_rows


class Physics:
    """The control step of an environment without the environment: a simulation that does nothing else."""

    parameters = ()

    def __init__(self, env: EnvBase) -> None:
        self.dynamics, self.substeps = env.dynamics, env.dynamics.substeps
        self.start = env.reset()["state"].select(*self.dynamics.sizes).to_dict()
        self.valid = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
        self.stepper = Stepper(self, {} if env.is_compiled else None)

    def fly(self, actions: Tensor) -> Tensor:
        """A number that depends on all actions (horizon, n, 4)."""
        if not self.stepper.is_compiled:
            state = self.start
            for action in actions.unbind():
                state, _ = self.stepper.step(state, self.valid, action, {})
            return torch.cat(list(state.values()), -1).sum()
        start = self.stepper.example._replace(state=self.stepper.layout.pack(self.start))
        flight = self.stepper.fly(GivenActions(lambda _: actions), start, self.valid, len(actions), dict)
        return flight.ends.state.floats[-1].sum()

    def example(self) -> tuple[State, State]:
        return self.start, self.outputs(self.start)

    def check_action(self, action: Tensor | None) -> None:
        pass

    def outputs(self, state: State) -> State:
        return {"observation": state["position"], "reward": state["position"][:, :1]}

    def __call__(self, state: State, valid: Tensor, action: Tensor, noise: dict[str, Tensor]) -> Transition:
        state = self.dynamics.control_step(state, action, self.dynamics.nominal, None)
        return Transition(state, self.outputs(state), valid)

    def begin(self, state: State, valid: Tensor, action: Tensor, parameters: tuple[Tensor, ...]) -> tuple[Any, ...]:
        x = torch.cat([state[name].t() for name in self.dynamics.sizes])
        return state, valid, x, (self.dynamics.setpoint_rows(action), (), ())

    def rows_step(self) -> Callable[..., Tensor]:
        return self.dynamics.rows_step()

    def finish(self, before: State, x: Tensor, valid: Tensor, noise: dict[str, Tensor]) -> Transition:
        sizes = self.dynamics.sizes
        state = dict(zip(sizes, x.t().split(list(sizes.values()), 1), strict=True))
        return Transition(state, self.outputs(state), valid)


def flights(task: str, options: dict[str, Any]) -> dict[str, Callable[[Tensor], Tensor]]:
    """From a horizon of actions (horizon, n, 4) to a number, by name; those with a policy ignore the actions."""
    env = make_env(task, **options)
    actor, start = make_actor(env), env.reset()
    points = make_env(task, dynamics="point_mass", **options)
    remembers, size = make_actor(env, (64,), recurrent=True), start["observation"].shape[-1]
    norm = ObservationNorm(torch.zeros(size), torch.ones(size), in_keys=["observation"], standard_normal=True)
    under = TransformedEnv(env, Compose(RewardScaling(0.0, 2.0), RewardSum(), StepCounter(), norm).to(env.device))
    as_is = {"tensordict": start, "auto_reset": False, "break_when_any_done": False}

    def return_of(rollout: TensorDictBase) -> Tensor:
        return rollout["next", "reward"].sum()

    def fly(env: EnvBase, policy: TensorDictModuleBase, actions: Tensor) -> Tensor:
        start = env.reset()
        return return_of(differentiable_rollout(env, policy, start, len(actions))[0])

    cases = {
        "physics": Physics(env).fly,
        "env": lambda actions: fly(env, ActionSequence(actions), actions),
        "point mass": lambda actions: fly(points, ActionSequence(actions), actions),
        "actor": lambda actions: fly(env, actor, actions),
        "transforms": lambda actions: fly(under, actor, actions),
        "memory": lambda actions: fly(env, remembers, actions),
        "called": lambda actions: fly(env, TensorDictSequential(actor), actions),
        "torchrl": lambda actions: return_of(EnvBase.rollout(env, len(actions), actor, **as_is)),
    }
    if env.is_compiled:
        return cases
    racing = make_env("racing", wind={"gust": 0.5}, observation_noise={"position": 0.01}, **options)

    def steps(actions: Tensor) -> Tensor:
        td, total = racing.reset(), 0.0
        for action in actions.unbind():
            td = racing.step(td.set("action", action))["next"]
            total = total + td["reward"].sum()
        return total

    return {**cases, "step": steps}


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
    options = {"num_envs": n, "device": device, "compile": mode == "compiled"}
    actions = make_env(task).hover_action.to(device) + 0.1 * torch.randn(horizon, n, 4, device=device)
    cases = {}
    for name, flight in flights(task, options).items():
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
        flown = {"task": "racing" if name == "step" else task}
        rows.append({"num_envs": n, "mode": mode, "case": name, **both, "of physics": round(ratio, 2), **flown})
    return rows


def main() -> None:
    sizes, options = [64, 256, 1024, 4096, 16384], {"task": "hovering", "horizon": 32, "device": "cpu"}
    modes = ["compiled", "eager"]
    args = command_line(__doc__, "throughput.csv", num_envs=sizes, modes=modes, rounds=5, threads=1, **options)
    torch.set_num_threads(args.threads)
    rows = read_rows(args.output)
    for mode, n in tqdm(list(itertools.product(args.modes, args.num_envs))):
        if not any(row["num_envs"] == str(n) and row["mode"] == mode for row in rows):
            rows += measure(n, mode, args.task, args.horizon, args.rounds, args.device)
            save(args.output, rows, task=args.task, horizon=args.horizon, unit="1000 control steps per second")


if __name__ == "__main__":
    main()
