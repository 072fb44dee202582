"""The control step of any task and any drone, the states that start it, and the specs of what it writes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from torchrl_quad.dynamics import QuadrotorParams, quaternion
from torchrl_quad.dynamics.parameters import RawParams
from torchrl_quad.dynamics.vector import is_traced
from torchrl_quad.engine import Transition, nested
from torchrl_quad.engine.packing import like
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs import guard
from torchrl_quad.envs.scenes import MountedCamera
from torchrl_quad.envs.task import Task
from torchrl_quad.envs.terms import time_terms
from torchrl_quad.errors import UserValueError

Outputs = dict[str, Any]  # of a step by name; mappings of names hold further ones
LOOK_AHEAD = (0.25, 0.5, 1.0)  # [s]: critics also read how near obstacles will be then, at the present velocity


class ControlStep:
    """Queue the action, fly, disturb, guard, advance the task, judge: a pure function from entries to entries.

    An eager flight calls it. The engine compiles ``begin``, the physics and ``finish``, which share every line with it.
    ``safe_state`` takes over where a state is meaningless.
    """

    def __init__(self, env: Task, safe_state: State) -> None:
        self.env, self.dynamics, self.substeps = env, env.dynamics, env.dynamics.substeps
        self.safe_state, self.guard = safe_state, guard.Guard(safe_state, env.dynamics, env.task_entries)
        self.task_advances = type(env).advance is not Task.advance
        self.event_names = list(env.events(safe_state, safe_state)) if env.event_discount is not None else []
        has_gradient = env.camera is None or env.camera.differentiable
        self.constants = frozenset(("metrics",) if has_gradient else ("metrics", "depth"))
        self.drawn = [key[1] for key in safe_state if isinstance(key, tuple) and key[0] == "drone"]

    def __call__(self, state: State, valid: Tensor, action: Tensor, noise: dict[str, Tensor]) -> Transition:
        """The whole step, eager; ``valid`` (n) is False where the state was meaningless and the episode ends."""
        params, contain = self.env.params, None
        if torch.is_grad_enabled() and not is_traced():
            contain = guard.Containment()
            state, action, params = contain.enter(state, action, params)
        state, applied, valid = self.queue(state, valid, action)
        if drawn := {name: state["drone", name] for name in self.drawn}:
            fields = params._asdict() if isinstance(params, RawParams) else params.fields()
            params = RawParams(**{**fields, **drawn})
        drone = self.dynamics.control_step(state, applied, params, state.get("wind"))
        end = self.judge(state, drone, valid, noise)
        if contain is not None:
            contain.valid = end.valid
        return end

    def queue(self, state: State, valid: Tensor, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """The state with the action queued, the action (n, k) that takes effect now, and where both make sense (n)."""
        valid = valid & (action.detach().abs().amax(1) < guard.MAX_VALUE)
        action = torch.where(valid.unsqueeze(1), action, self.dynamics.hover_action)
        if "action_queue" not in state:
            return state, action, valid
        queue, applied = state["action_queue"], state["action_queue"][:, 0]
        if "delay" in state:  # of each drone, at most the length of the queue
            places = torch.arange(self.env.action_delay, -1, -1, device=action.device)
            drawn = (places == state["delay"]).to(action.dtype).unsqueeze(-1)
            applied = (torch.cat((queue, action.unsqueeze(1)), 1) * drawn).sum(1)
        return {**state, "action_queue": torch.cat((queue[:, 1:], action.unsqueeze(1)), 1)}, applied, valid

    def judge(self, before: State, drone: State, valid: Tensor, noise: dict[str, Tensor]) -> Transition:
        """Where the step leads, from the state at its start and where the drone has flown."""
        env = self.env
        state = {**before, **drone, "step": before["step"] + 1}
        if env.scene is not None:
            state["collided"] = env.scene.collided(before, state)
        for name, disturbance in env.disturbances.items():
            state = {**state, **disturbance.advance(state, noise.get(name), env.control_dt)}
        state, meaningful = self.guard(state)
        valid = valid & meaningful
        keep, everywhere = valid.unsqueeze(1), guard.is_true(valid)
        if self.task_advances:
            advanced = env.advance(before, state)
            for key in env.task_entries:
                new = advanced[key]
                state[key] = new if everywhere else torch.where(like(keep, new), new, state[key])
        terms = env.reward_terms(state)
        ends = self.ends(state, keep)
        if self.event_names:
            terms = {**terms, **self.event_terms(before, state, terms, ends["terminated"])}
        if not everywhere:
            terms = {name: torch.where(keep, term, 0.0) for name, term in terms.items()}
        outputs = {**self.measure(state), "reward": sum(terms.values()), "reward_terms": terms, **ends}
        return Transition(state, outputs, valid)

    def ends(self, state: State, keep: Tensor) -> State:
        """Whether a state ends its episode, and how, each bool (n, 1); ``keep`` (n, 1): where it is meaningful."""
        env = self.env
        crash, success = env.is_crash(state) | ~keep, env.is_success(state) & keep
        crash = crash if env.scene is None else crash | state["collided"]
        terminated = crash | success if env.ends_on_success else crash
        truncated = state["step"] >= env.max_episode_steps
        done = terminated | truncated
        return {"success": success, "crash": crash, "terminated": terminated, "truncated": truncated, "done": done}

    def event_terms(self, before: State, state: State, terms: State, terminated: Tensor) -> State:
        """The reward terms that carry the gradients in the times of events; their values are zero."""
        env = self.env
        old = {key: (before[key] if key in env.task_entries else x).detach() for key, x in state.items()}
        old_terms, discount = env.reward_terms(old), env.event_discount or 1.0
        return time_terms(env.events(before, state), discount, terms, old_terms, terminated)

    def measure(self, state: State) -> Outputs:
        """The outputs that any state has, also the first of an episode."""
        env = self.env
        with torch.no_grad():
            metrics = env.metrics(state)
        more = {}  # before the observation: gradients add up in the order of what is computed
        if isinstance(camera := env.disturbances.get("camera"), MountedCamera):
            more["depth"] = camera.image(state)
        if env.scene is not None:  # for critics, which may know more than policies
            distance, away = env.scene.nearest(state)  # a compiler shares it with the reward
            away = quaternion.rotate_inverse(state["quaternion"], away)
            coming = torch.stack([state["position"] + time * state["velocity"] for time in LOOK_AHEAD], 1)
            later, _ = env.scene.nearest({**state, "position": coming})
            more["obstacle"] = torch.cat((distance, away, later.squeeze(-1)), -1)
        return {"observation": self.observe(state), **more, "metrics": metrics}

    def observe(self, state: State) -> Tensor:
        """The observation (n, k) that the policy gets: through sensors, with the commands on their way if wanted."""
        measured = state
        for disturbance in self.env.disturbances.values():
            measured = disturbance.observe(measured)
        observation = self.env.observe(measured)
        if not self.env.observe_last_action:
            return observation
        return torch.cat((observation, state["action_queue"].flatten(1)), -1)

    def reset(self, state: State) -> Outputs:
        """All entries that a reset to a state writes, nested; there is no reward yet."""
        no = torch.zeros_like(state["step"], dtype=torch.bool)
        flags = {name: no.clone() for name in ("crash", "terminated", "truncated", "done")}
        terms = {name: torch.zeros_like(term) for name, term in self.env.reward_terms(state).items()}
        terms |= {f"{name}_time": torch.zeros_like(state["position"][:, :1]) for name in self.event_names}
        outputs = {"reward_terms": terms, "success": self.env.is_success(state), **flags}
        return {**self.measure(state), **outputs, "state": nested(state)}

    def draw_start(self) -> Outputs:
        """All entries that a reset of all environments writes, nested."""
        env, source = self.env, self.env.initial_state_source
        if source is None:
            return self.reset(sample_state(env, env.num_envs))
        return self.reset(self.restore(source(env.num_envs), "initial_state_source"))

    def restore(self, state: object, source: str, mask: Tensor | None = None) -> State:
        """A copy of a state to fly from, in the precision and on the device of the environment, if it can fly.

        The mask, bool (n) or (n, 1), says which environments it is for: the others may hold anything.
        """
        entries = guard.read_state(state, self.safe_state, source, convert=True)
        if is_traced():
            return entries
        wrong = self.guard.problems(entries)
        for disturbance in self.env.disturbances.values():
            wrong |= disturbance.problems(entries)
        for key, (low, high) in {"step": (0, guard.MAX_STEPS), **self.env.state_bounds()}.items():
            inside = (entries[key] >= low) & (entries[key] <= high)
            wrong[f"{key!r} must lie between {low} and {high}"] = ~inside.flatten(1).all(1)
        for problem, where in wrong.items():
            where = where if mask is None else where & mask.flatten()
            if where.any():
                who = guard.first_ten(where)
                raise UserValueError(f"{source}: no drone can fly from the state of environments {who}: {problem}.")
        return entries

    # -- for the engine ------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """The parameters of the drone that flies; none where it is the nominal one."""
        params = self.env.params
        return tuple(self._plant(params).values()) if params is not self.env.nominal else ()

    def _plant(self, params: QuadrotorParams) -> State:
        fields = params.fields()
        return {name: fields[name] for name in self.dynamics.plant_fields if name in fields}

    def example(self) -> tuple[State, Outputs]:
        """The safe state and outputs of it."""
        outputs = self.reset(self.safe_state)
        del outputs["state"]
        return self.safe_state, {**outputs, "reward": outputs["observation"][:, :1]}

    def check_action(self, action: Tensor | None) -> None:
        guard.check_action(action, self.safe_state["position"], self.env.hover_action.shape[-1])

    def begin(
        self, state: State, valid: Tensor, action: Tensor, parameters: tuple[Tensor, ...]
    ) -> tuple[State, Tensor, Tensor, tuple[Any, ...]]:
        """Queue the action, and lay out as rows what the physics reads; see the engine's ``Simulation``."""
        state, applied, valid = self.queue(state, valid, action)
        n, fields = len(action), self._plant(self.env.params)
        fields |= dict(zip(fields, parameters, strict=False))  # with their gradients
        fields |= {name: state["drone", name] for name in self.drawn}
        plant = ()
        if parameters or self.drawn:
            # A parameter of its own for each environment, where there is a gradient to be kept apart.
            many, none = n if parameters else 1, action.new_empty((0, 1))
            names = self.dynamics.plant_fields
            plant = tuple(_rows(fields[name], name, many) if name in fields else none.clone() for name in names)
        # Compiled regions must not share memory between their inputs, so views of the state are copied.
        wind = (state["wind"].t().clone(),) if "wind" in state else ()
        x = torch.cat([state[name].t() for name in self.dynamics.sizes])
        return state, valid, x, (self.dynamics.setpoint_rows(applied), plant, wind)

    def rows_step(self) -> Any:
        return self.dynamics.rows_step()

    def finish(self, before: State, x: Tensor, valid: Tensor, noise: dict[str, Tensor]) -> Transition:
        """Judge where the rows ``x`` have flown."""
        sizes = self.dynamics.sizes
        drone = {name: part.t() for name, part in zip(sizes, x.split(list(sizes.values())), strict=True)}
        return self.judge(before, drone, valid, noise)

    def specs(self) -> dict[str, TensorSpec]:
        """The specs of the environment by name, read off what the step writes of the safe state."""
        example = self.safe_state["position"]
        n, device = example.shape[:1], example.device

        def spec(x: Any) -> TensorSpec:
            if isinstance(x, Mapping):
                return Composite({key: spec(value) for key, value in x.items()}, shape=n, device=device)
            if x.dtype == torch.bool and x.shape[1:] == (1,):
                return Binary(1, x.shape, device=device, dtype=torch.bool)
            return Unbounded(x.shape, device=device, dtype=x.dtype)

        outputs = self.reset(self.safe_state)
        done = {name: outputs.pop(name) for name in ("done", "terminated", "truncated")}
        outputs = {name: x for name, x in outputs.items() if not isinstance(x, Mapping) or x}
        return {
            # TorchRL carries no key to the next step that is only in the state spec: it has to be in both.
            "observation_spec": spec(outputs),
            "state_spec": spec({"state": outputs["state"]}),
            "action_spec": Bounded(
                -1.0, 1.0, torch.Size((*n, self.env.hover_action.shape[-1])), device=device, dtype=example.dtype
            ),
            "reward_spec": Unbounded(torch.Size((*n, 1)), device=device, dtype=example.dtype),
            "done_spec": spec(done),
        }


def sample_state(env: Task, n: int) -> State:
    """Draw n states at the start of an episode: the task's start, disturbed, with commands to hover on their way."""
    state = env.initial_state(n)
    for disturbance in env.disturbances.values():
        state |= disturbance.start(env.randomness, state)
    if env.action_delay:
        hover = env.hover_action.expand(n, -1).unsqueeze(1)
        state["action_queue"] = hover.expand(-1, env.action_delay, -1).clone()
    state["step"] = torch.zeros(n, 1, dtype=torch.int64, device=state["position"].device)
    return state


def _rows(parameter: Tensor, name: str, n: int) -> Tensor:
    """A parameter as rows (k, n), or (k, number of environments) where each has its own."""
    if parameter.dim() > QuadrotorParams.dim(name):
        return parameter.flatten(1).t().clone()
    return parameter.reshape(-1, 1).expand(-1, n).clone()
