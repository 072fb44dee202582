"""The control step, for any task and any drone, defined in one place."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import QuadrotorParams, quaternion
from torchrl_quad.dynamics.parameters import RawParams
from torchrl_quad.dynamics.vector import is_traced
from torchrl_quad.engine import Transition, nested
from torchrl_quad.engine.packing import like
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.checks import check_action, restore_state
from torchrl_quad.envs.guard import MAX_VALUE, Containment, Guard, is_true
from torchrl_quad.envs.task import Task
from torchrl_quad.envs.terms import time_terms


class ControlStep:
    """Queue the action, fly, disturb, guard, advance the task, judge: a pure function from entries to entries.

    An eager flight calls it. The engine compiles ``begin``, the physics and ``finish``, which share every line with it.

    Args:
        env: its ``dynamics`` fly, its ``disturbances`` disturb, its task advances and judges.
        safe_state: takes over where a state is meaningless.
    """

    def __init__(self, env: Any, safe_state: State) -> None:
        self.env, self.dynamics, self.substeps = env, env.dynamics, env.dynamics.substeps
        self.safe_state, self.guard = safe_state, Guard(safe_state, env.dynamics, env.task_entries)
        self.task_advances = type(env).advance is not Task.advance
        self.event_names = list(env.events(safe_state, safe_state)) if env.event_discount is not None else []
        eye = env.disturbances.get("camera")
        self.constants = frozenset(("metrics",) if eye is None or eye.camera.differentiable else ("metrics", "depth"))
        self.drawn = [key[1] for key in safe_state if isinstance(key, tuple) and key[0] == "drone"]

    def __call__(self, state: State, valid: Tensor, action: Tensor, noise: dict[str, Tensor]) -> Transition:
        """The whole step, eager; ``valid`` (n) is False where the state was meaningless and the episode ends."""
        params, contain = self.env.params, None
        if torch.is_grad_enabled() and not is_traced():
            contain = Containment()
            state, action, params = contain.enter(state, action, params)
        state, applied, valid = self.queue(state, valid, action)
        drone = self.dynamics.control_step(state, applied, self.plant_params(params, state), state.get("wind"))
        end = self.judge(state, drone, valid, noise)
        if contain is not None:
            contain.valid = end.valid
        return end

    # -- what happens, in order ----------------------------------------------------------------------------------------

    def queue(self, state: State, valid: Tensor, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """The state with the action queued, the action (n, 4) that takes effect now, and where both make sense (n)."""
        valid = valid & (action.detach().abs().amax(1) < MAX_VALUE)
        action = torch.where(valid.unsqueeze(1), action, self.dynamics.hover_action)
        if "action_queue" not in state:
            return state, action, valid
        queue = state["action_queue"]
        return {**state, "action_queue": torch.cat((queue[:, 1:], action.unsqueeze(1)), 1)}, queue[:, 0], valid

    def plant_params(self, params: QuadrotorParams | RawParams, state: State) -> Any:
        """The parameters of the drones that fly: those given, with what each episode has drawn."""
        drawn = {name: state["drone", name] for name in self.drawn}
        if not drawn:
            return params
        return RawParams(**{**(params._asdict() if isinstance(params, RawParams) else params.fields()), **drawn})

    def apply_disturbances(self, state: State, noise: dict[str, Tensor]) -> State:
        """The state with what wind, sensors and so on have made of it in this step."""
        for name, disturbance in self.env.disturbances.items():
            state = {**state, **disturbance.advance(state, noise.get(name), self.env.control_dt)}
        return state

    def judge(self, before: State, drone: State, valid: Tensor, noise: dict[str, Tensor]) -> Transition:
        """Where the step leads, from the state at its start and where the drone has flown."""
        env = self.env
        state = {**before, **drone, "step": before["step"] + 1}
        if self.env.scene is not None:
            state["collided"] = self.env.scene.collided(before, state)
        state = self.apply_disturbances(state, noise)
        state, meaningful = self.guard(state)
        valid = valid & meaningful
        keep, everywhere = valid.unsqueeze(1), is_true(valid)
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
        old = {key: before[key] if key in env.task_entries else x for key, x in state.items()}
        old_terms = env.reward_terms({key: x.detach() for key, x in old.items()})
        return time_terms(env.events(before, state), env.event_discount, terms, old_terms, terminated)

    def measure(self, state: State) -> dict[str, Any]:
        """The outputs that any state has, also the first of an episode."""
        with torch.no_grad():
            metrics = self.env.metrics(state)
        eye = self.env.disturbances.get("camera")
        seen = {} if eye is None else {"depth": eye.image(state)}
        if self.env.scene is not None:  # for critics, which may know more than policies
            distance, away = self.env.scene.nearest(state)
            seen["obstacle"] = torch.cat((distance, quaternion.rotate_inverse(state["quaternion"], away)), -1)
        return {"observation": self.observe(state), **seen, "metrics": metrics}

    def observe(self, state: State) -> Tensor:
        """The observation (n, k) as the policy sees it: through sensors, with the commands on their way if wanted."""
        seen = state
        for disturbance in self.env.disturbances.values():
            seen = disturbance.observe(seen)
        observation = self.env.observe(seen)
        if not self.env.observe_last_action:
            return observation
        return torch.cat((observation, state["action_queue"].flatten(1)), -1)

    def at_start(self, state: State) -> dict[str, Any]:
        """All outputs of the first state of an episode, nested; there is no reward yet."""
        no = torch.zeros_like(state["step"], dtype=torch.bool)
        flags = {name: no.clone() for name in ("crash", "terminated", "truncated", "done")}
        terms = {name: torch.zeros_like(term) for name, term in self.env.reward_terms(state).items()}
        terms |= {f"{name}_time": torch.zeros_like(state["position"][:, :1]) for name in self.event_names}
        return {**self.measure(state), "reward_terms": terms, "success": self.env.is_success(state), **flags}

    def reset(self, state: State) -> dict[str, Any]:
        """All entries that a reset to a state writes, nested."""
        return {"state": nested(state), **self.at_start(state)}

    def complaints(self, state: State) -> dict[str, Tensor]:
        """What is wrong with a state to start from, in words, and where it is wrong, bool (n)."""
        wrong = self.guard.complaints(state)
        for disturbance in self.env.disturbances.values():
            wrong |= disturbance.complaints(state)
        return wrong

    # -- for the engine ------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """The parameters of the drone that flies; none where it is the nominal one."""
        params = self.env.params
        own = params is not self.env.nominal
        return tuple(getattr(params, name) for name in self.dynamics.plant_fields) if own else ()

    def example(self) -> tuple[State, State]:
        """The safe state and outputs of it."""
        outputs = self.at_start(self.safe_state)
        return self.safe_state, {**outputs, "reward": outputs["observation"][:, :1]}

    def check_action(self, action: Tensor | None) -> None:
        """Refuse an action of the wrong shape, precision or device."""
        check_action(action, self.safe_state["position"])

    def begin(
        self, state: State, valid: Tensor, action: Tensor, parameters: tuple[Tensor, ...]
    ) -> tuple[State, Tensor, Tensor, tuple[Any, ...]]:
        """Queue the action, and lay out as rows what the physics reads; see the engine's ``Simulation``."""
        state, applied, valid = self.queue(state, valid, action)
        names, fields, n = self.dynamics.plant_fields, self.env.nominal.fields(), len(action)
        fields |= dict(zip(names, parameters, strict=False))
        fields |= {name: state["drone", name] for name in self.drawn}
        plant = ()
        if parameters or self.drawn:
            # A parameter of its own for each environment, where there is a gradient to be kept apart.
            plant = tuple(_rows(fields[name], name, n if parameters else 1) for name in names)
        # Compiled regions must not share memory between their inputs, so views of the state are copied.
        wind = (state["wind"].t().clone(),) if "wind" in state else ()
        x = torch.cat([state[name].t() for name in self.dynamics.sizes])
        return state, valid, x, (self.dynamics.setpoint_rows(applied), plant, wind)

    def rows_step(self) -> Any:
        """The physics on rows."""
        return self.dynamics.rows_step()

    def finish(self, before: State, x: Tensor, valid: Tensor, noise: dict[str, Tensor]) -> Transition:
        """Judge where the rows ``x`` have flown."""
        sizes = self.dynamics.sizes
        drone = {name: part.t() for name, part in zip(sizes, x.split(list(sizes.values())), strict=True)}
        return self.judge(before, drone, valid, noise)


def sample_state(env: Any, n: int) -> State:
    """Draw n states at the start of an episode: the task's start, disturbed, with commands to hover on their way."""
    state = env.initial_state(n)
    for disturbance in env.disturbances.values():
        state |= disturbance.start(env.randomness, state)
    if env.action_delay:
        hover = env.hover_action.expand(n, 4).unsqueeze(1)
        state["action_queue"] = hover.expand(n, env.action_delay, 4).clone()
    state["step"] = torch.zeros(n, 1, dtype=torch.int64, device=env.device)
    return state


def draw_start(env: Any) -> dict[str, Any]:
    """All entries that a reset of all environments writes, nested."""
    if env.initial_state_source is None:
        return env.control_step.reset(sample_state(env, env.num_envs))
    source = env.initial_state_source(env.num_envs)
    return env.control_step.reset(restore_state(env, source, "initial_state_source"))


def _rows(parameter: Tensor, name: str, n: int) -> Tensor:
    """A parameter as rows (k, n), or (k, number of environments) where each has its own."""
    if parameter.dim() > QuadrotorParams.dim(name):
        return parameter.flatten(1).t().clone()
    return parameter.reshape(-1, 1).expand(-1, n).clone()
