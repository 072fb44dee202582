"""Run a control step on rows: eager, or compiled with its derivative as one node of the graph."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any

from torch import Tensor

from torchrl_quad.engine.node import Flight, Horizon, fly_horizon
from torchrl_quad.engine.packing import Layout, Rows, flat, nested
from torchrl_quad.engine.policy import GivenActions, PlainPolicy
from torchrl_quad.engine.program import PolicyProgram, Record, StepProgram, record
from torchrl_quad.engine.simulation import Simulation, State, Transition


class Stepper:
    """Steps a simulation, on entries or on rows.

    Args:
        simulation: what happens in a step.
        options: keywords of ``torch.compile``; None for an eager step.
    """

    def __init__(self, simulation: Simulation, options: dict[str, Any] | None = None) -> None:
        self.simulation, self.options = simulation, options
        state, outputs = simulation.example()
        self.layout = Layout(state)
        self.output_layout = Layout({key: x for key, x in flat(outputs).items() if key != "observation"})
        self.example = record(Transition(state, outputs, None), self.layout, self.output_layout)
        self.steps: dict[int, StepProgram] = {}  # by the number of the simulation's parameters
        self.policies: dict[Hashable, PolicyProgram] = {}  # by signature

    @property
    def is_compiled(self) -> bool:
        """Whether steps run compiled."""
        return self.options is not None

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions stay bound to the environment that they were made of: a copy makes its own.
        return {**self.__dict__, "steps": {}, "policies": {}}

    def step(
        self, state: State, valid: Tensor, action: Tensor, noise: dict[str, Tensor]
    ) -> tuple[State, dict[str, Any]]:
        """One step on entries: the state at its end, and its outputs."""
        if not self.is_compiled:
            end = self.simulation(state, valid, action, noise)
            return end.state, end.outputs
        state, outputs, observation = self.step_rows(self.layout.pack(state), valid, action, noise)
        return self.layout.unpack(state), {**nested(self.unpack_outputs(outputs)), "observation": observation}

    def unpack_outputs(self, rows: Rows) -> dict[Any, Tensor]:
        """The outputs of a step, or of a horizon, by name; the constants among them without gradient."""
        constants, outputs = self.simulation.constants, self.output_layout.unpack(rows).items()
        return {key: x.detach() if (key if isinstance(key, str) else key[0]) in constants else x for key, x in outputs}

    def step_rows(self, rows: Rows, valid: Tensor, action: Tensor, noise: dict[str, Tensor]) -> Record:
        """One compiled step on rows, from a state under an action (n, k); the rest is that of :meth:`fly`."""
        start = Record(rows, self.example.outputs, self.example.observation)
        flight = self.fly(GivenActions(lambda _: action.unsqueeze(0)), start, valid, 1, lambda: noise)
        state, outputs, observation = flight.ends
        return Record(Rows(*(x[0] for x in state)), Rows(*(x[0] for x in outputs)), observation[:, 0])

    def fly(
        self,
        policy: PlainPolicy | GivenActions,
        start: Record,
        valid: Tensor,
        steps: int,
        noise: Callable[[], dict[str, Tensor]],
        restarted: Callable[[Record], tuple[Record, Tensor] | None] = lambda end: None,
        before: Mapping[Any, Tensor] | None = None,
    ) -> Flight:
        """A compiled horizon with its graph, as one node.

        Args:
            policy: acts inside the step.
            start: where it begins.
            valid: where that state is meaningful, bool (n); elsewhere the episode ends with the first step.
            steps: at least one.
            noise: gives what each disturbance has drawn for the next step, by name.
            restarted: from the end of a step where to go on, and who begins anew, bool (n); None if nobody does.
            before: what the policy has written in the step before.
        """
        drawn = policy.drawn(steps, len(valid), before or {})
        self.simulation.check_action(drawn[0, :, : policy.size])
        count = len(self.simulation.parameters)
        if count not in self.steps:
            self.steps[count] = StepProgram(self.simulation, self.layout, self.output_layout, self.options)
        program = None
        if not isinstance(policy, GivenActions):
            if policy.signature not in self.policies:
                self.policies[policy.signature] = PolicyProgram(policy, self.options)
            program = self.policies[policy.signature]
        return fly_horizon(Horizon(self.steps[count], policy, program, start, valid, steps, noise, restarted), drawn)
