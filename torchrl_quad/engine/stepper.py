"""Run a control step on rows: eager, or a compiled horizon with its derivative as one node of the graph."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple, cast

import torch
from tensordict.utils import unravel_key
from torch import Tensor

from torchrl_quad.engine.packing import Layout, Record, Rows, flat, like, nested, record
from torchrl_quad.engine.policy import ENDS, GivenActions, PlainPolicy
from torchrl_quad.engine.program import PolicyProgram, StepProgram, name_in_state, policy_inputs
from torchrl_quad.engine.simulation import Simulation, State, Transition
from torchrl_quad.errors import Unsupported

_GRAPHS = ("reduce-overhead", "max-autotune")  # the modes of torch.compile that launch CUDA graphs
LEARNING_BATCH = 1024  # so many steps of one drone make a batch for the gradient of the weights


class Flight(NamedTuple):
    """All steps of a compiled horizon, their tensors one above the other."""

    ends: Record  # rows (steps, rows, n), observations (n, steps, k)
    written: dict[Any, Tensor]  # by the policy, (n, steps, ...)
    restarts: list[tuple[int, Record, Tensor]]  # where some restarted: the step before, from where, and who


class Stepper:
    """Steps a simulation, on entries or on rows; ``options`` are those of ``torch.compile``, None for eager."""

    def __init__(self, simulation: Simulation, options: dict[str, Any] | None = None) -> None:
        if options and (options.get("mode") in _GRAPHS or (options.get("options") or {}).get("triton.cudagraphs")):
            raise Unsupported(
                "compile: CUDA graphs overwrite what a step returned when the next one begins, and a horizon keeps all "
                'of its steps. Leave mode out, or write mode="max-autotune-no-cudagraphs".'
            )
        self.simulation, self.options = simulation, options
        state, outputs = simulation.example()
        self.layout = Layout(state)
        self.output_layout = Layout({key: x for key, x in flat(outputs).items() if key != "observation"})
        meaningful = torch.ones(0, dtype=torch.bool)  # an example needs none
        self.example = record(Transition(state, outputs, meaningful), self.layout, self.output_layout)
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
        after = self.step_rows(self.layout.pack(state), valid, action, noise)
        outputs = {**nested(self.unpack_outputs(after.outputs)), "observation": after.observation}
        return self.layout.unpack(after.state), outputs

    def unpack_outputs(self, rows: Rows) -> dict[Any, Tensor]:
        """The outputs of a step, or of a horizon, by name; the constants among them without gradient."""
        constants, outputs = self.simulation.constants, self.output_layout.unpack(rows).items()
        return {key: x.detach() if (key if isinstance(key, str) else key[0]) in constants else x for key, x in outputs}

    def step_rows(self, rows: Rows, valid: Tensor, action: Tensor, noise: dict[str, Tensor]) -> Record:
        """One compiled step on rows, from a state under an action (n, k); the rest is that of :meth:`fly`."""
        start = self.example._replace(state=rows)
        ends = self.fly(GivenActions(lambda _: action.unsqueeze(0)), start, valid, 1, lambda: noise).ends
        return Record.of([*(x[0] for x in ends.leaves[:6]), ends.observation[:, 0]])

    def fly(
        self,
        policy: PlainPolicy | GivenActions,
        start: Record,
        valid: Tensor,
        steps: int,
        noise: Callable[[], dict[str, Tensor]],
        restarted: Callable[[Record, Tensor | None], tuple[Record, Tensor] | None] = lambda end, ends: None,
        before: Mapping[Any, Tensor] | None = None,
    ) -> Flight:
        """A compiled horizon with its graph, as one node.

        Gradients reach its start, what the policy draws (steps, n, k), its weights, and the parameters. They reach the
        actions as well: the node of all that is flown has ``actions``, a tensor (steps, n, k) that stands for them, and
        ``learns``, to be switched off for a backward pass that wants no gradient of the policy's weights.

        Args:
            valid: where the start is meaningful, bool (n); elsewhere the episode ends with the first step.
            noise: gives what each disturbance has drawn for the next step, by name.
            restarted: from the end of a step, and where the policy ends an episode with it, (n, 1) or None:
                where to continue, and who restarts, bool (n); None if nobody does.
            before: what the policy has written in the step before.
        """
        assert self.options is not None  # only a compiled stepper flies horizons
        drawn, parameters = policy.drawn(steps, len(valid), before or {}), self.simulation.parameters
        applied = getattr(policy, "applied", lambda action: action)  # by transforms between policy and simulation
        self.simulation.check_action(applied(drawn[0, :, : policy.size]))
        if len(parameters) not in self.steps:
            program = StepProgram(self.simulation, self.layout, self.output_layout, self.options)
            self.steps[len(parameters)] = program
        acts = None
        if not isinstance(policy, GivenActions):
            if policy.signature not in self.policies:
                self.policies[policy.signature] = PolicyProgram(policy, self.options)
            acts = self.policies[policy.signature]
        horizon = Horizon(self.steps[len(parameters)], policy, acts, start, valid, steps, noise, restarted, [])
        known, n = before or {}, len(valid)
        memory = [known[key] if key in known else drawn.new_zeros((n, *size)) for key, size in policy.memory.items()]
        leaves = start.state.floats, start.outputs.floats, start.observation
        tensors = *leaves, drawn, *memory, *policy.weights, *parameters
        keeps = torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
        actions = drawn.new_zeros(()).expand(drawn[..., : policy.size].shape).requires_grad_(keeps)
        leaves = _Horizon.apply(horizon, keeps, actions, *tensors)
        if keeps:
            leaves[0].grad_fn.actions, leaves[0].grad_fn.learns = actions, True
        return Flight(Record.of(leaves), dict(zip(policy.out_keys, leaves[7:], strict=True)), horizon.restarts)


class Horizon(NamedTuple):
    """What a compiled horizon flies with, besides the tensors that have gradients; see :meth:`Stepper.fly`."""

    step: StepProgram
    policy: PlainPolicy | GivenActions
    policy_program: PolicyProgram | None  # None for given actions
    start: Record
    valid: Tensor
    steps: int
    noise: Callable[[], dict[str, Tensor]]
    restarted: Callable[[Record, Tensor | None], tuple[Record, Tensor] | None]
    restarts: list[tuple[int, Record, Tensor]]  # to be filled


class _Horizon(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, horizon: Horizon, keeps: bool, _: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        step, policy = horizon.step, _Policy(horizon)
        floats, outputs, observation, drawn, *others = (x.detach().contiguous() for x in tensors)
        memory, (first, count) = policy.memory, (len(policy.memory), len(policy.weights))
        remembered = dict(zip(memory, others, strict=False))
        policy.weights, parameters = others[first : first + count], others[first + count :]
        states_start, outputs_start = horizon.start.state, horizon.start.outputs
        at = Record(Rows(floats, *states_start[1:]), Rows(outputs, *outputs_start[1:]), observation)
        valid, saved, all_ends, entries = horizon.valid, [], [], []
        leaves = written = ()
        for t in range(horizon.steps):
            inputs = policy_inputs(horizon.policy, step.layout, step.output_layout, at, remembered)
            kept, written = policy.forward(inputs, drawn[t], is_first=t == 0)
            noise = horizon.noise()
            step.noise_names = tuple(noise)
            # The stride of a single row can be anything, and a compiler takes another one for another kind of input.
            fixed = (x.reshape(-1).view(x.shape) for x in at.state[1:])
            start = (at.state.floats, *fixed, valid, written[policy.action], *parameters, *noise.values())
            states_end = (step.forward if t == 0 else step.forward.again)(*start)
            states, leaves = states_end[: step.substeps], states_end[step.substeps :]
            at = Record.of(leaves)
            remembered = {key: written[place].contiguous() for key, place in memory.items()}
            if keeps:
                saved.append((start, states, inputs, kept, drawn[t]))
            all_ends.append(leaves)
            entries.append(written)
            if t == 0:
                valid = torch.ones_like(valid)  # a step leads to meaningful states
            ends = None if policy.ends is None else written[policy.ends]
            if t < horizon.steps - 1 and (again := horizon.restarted(at, ends)) is not None:
                horizon.restarts.append((t, *again))
                at = again[0]
                remembered = {key: torch.where(like(again[1], x), 0.0, x) for key, x in remembered.items()}
        ctx.horizon = horizon
        ctx.like = [(x.shape, x.dtype, x.device) for x in (leaves[0], leaves[3], leaves[6], *written)]
        ctx.shapes = [tuple(map(len, parts[:4])) for parts in saved]
        ctx.save_for_backward(
            *policy.weights, *(x for parts in saved for part in (*parts[:4], parts[4:]) for x in part)
        )
        ctx.set_materialize_grads(False)
        stacked = [_stack(x, 0) for x in zip(*(leaves[:6] for leaves in all_ends), strict=True)]
        ctx.mark_non_differentiable(*stacked[1:3], *stacked[4:6])
        observations = _stack([leaves[6] for leaves in all_ends], 1)
        remembered = memory.values()  # of which a loss reads little: stacked as fast as they can be
        written = (
            _stack(x, 0).transpose(0, 1) if i in remembered else _stack(x, 1)
            for i, x in enumerate(zip(*entries, strict=True))
        )
        return *stacked, observations, *written

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # so it is only under create_graph=True
            raise Unsupported(
                "A compiled flight has first derivatives only. For second ones (create_graph=True) call env.eager() "
                "and fly again."
            )
        horizon, policy, step = ctx.horizon, _Policy(ctx.horizon, ctx.learns), ctx.horizon.step
        saved = iter(ctx.saved_tensors)
        policy.weights = [*islice(saved, len(policy.weights))]
        steps = [(*([*islice(saved, count)] for count in counts), next(saved)) for counts in ctx.shapes]
        # A tensor for each: a compiler would count on two being one.
        zeros = [torch.zeros(shape, dtype=dtype, device=device) for shape, dtype, device in ctx.like]
        restarted = {t: who for t, _, who in horizon.restarts}
        of_end, of_written = (grads[0], grads[3], grads[6]), grads[7:]
        # Gradients after a step: in the state, the outputs, the observation, and what the policy remembers.
        after: list[Tensor | None] = [None] * (3 + len(policy.memory))
        grads_action, grads_drawn, grads_parameter = [], [], []
        for t in reversed(range(horizon.steps)):
            start, states, inputs, kept, drawn = steps[t]
            if t in restarted:
                who = restarted[t]  # states and outputs are rows
                zeroed = (
                    x if x is None else torch.where(who if i < 2 else like(who, x), 0.0, x) for i, x in enumerate(after)
                )
                after = list(zeroed)
            end = [None if g is None else g[:, t] if i == 2 else g[t] for i, g in enumerate(of_end)]
            end = [_add(g, more) for g, more in zip(end, after, strict=False)]
            end = [zero if g is None else g.contiguous() for g, zero in zip(end, zeros, strict=False)]
            is_first = t == horizon.steps - 1
            adjoint = step.adjoint if is_first else step.adjoint.again
            grad_floats, grad_action, *grad_parameters = adjoint(*start, *states, *end)
            written = [None if g is None else g[:, t] for g in of_written]
            for place, grad in zip((policy.action, *policy.memory.values()), (grad_action, *after[3:]), strict=True):
                written[place] = _add(written[place], grad)
            grads_action.append(policy.of_command(written, kept))
            written = [zero if g is None else g.contiguous() for g, zero in zip(written, zeros[3:], strict=True)]
            grad_inputs, grad_drawn = policy.adjoint(inputs, kept, drawn, written, is_first=is_first)
            after = policy.before(grad_floats, zeros[1], grad_inputs)
            grads_drawn.append(grad_drawn)
            grads_parameter.append(grad_parameters)
        actions = torch.stack(grads_action[::-1]) if ctx.needs_input_grad[2] else None
        drawn = torch.stack(grads_drawn[::-1]) if ctx.needs_input_grad[6] else None
        parameters = (torch.stack(x).sum(0) for x in zip(*grads_parameter, strict=True))
        return None, None, actions, *after[:3], drawn, *after[3:], *policy.weight_gradients(), *parameters


class _Policy:
    """The policy of one pass over a horizon; backwards it gathers the gradient of its weights."""

    def __init__(self, horizon: Horizon, learns: bool = True) -> None:
        self.learns = learns
        self.policy, self.program, self.step = horizon.policy, horizon.policy_program, horizon.step
        self.weights: Sequence[Tensor] = self.policy.weights
        place = {unravel_key(key): i for i, key in enumerate(self.policy.out_keys)}
        self.action, self.command = place["action"], place[getattr(self.policy, "command", "action")]
        self.memory = {key: place[unravel_key(("next", key))] for key in self.policy.memory}
        self.ends = place.get(ENDS)
        self.steps: list[Sequence[Tensor]] = []  # whose gradient in the weights is still to be taken
        self.total: list[Tensor] | None = None

    def of_command(self, grads: Sequence[Any], kept: Sequence[Tensor]) -> Tensor:
        """The gradient of its action, before transforms between policy and simulation."""
        if self.command == self.action:
            return grads[self.action]
        of_applied = cast(Any, self.policy).pull(kept, grads[self.action])
        return of_applied if grads[self.command] is None else of_applied + grads[self.command]

    def forward(
        self, inputs: list[Tensor], drawn: Tensor, *, is_first: bool
    ) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """What it keeps, and what it writes."""
        if self.program is None:
            return [], [drawn]
        function = self.program.forward if is_first else self.program.forward.again
        values = function(*self.weights, *inputs, drawn)
        count = len(values) - len(self.policy.out_keys)
        return values[:count], values[count:]

    def adjoint(
        self, inputs: list[Tensor], kept: list[Tensor], drawn: Tensor, grads: list[Tensor], *, is_first: bool
    ) -> tuple[Sequence[Tensor], Tensor]:
        """The gradients of its inputs, and of what was drawn, from those of what it wrote."""
        if self.program is None:
            return [], grads[self.action]
        function = self.program.adjoint if is_first else self.program.adjoint.again
        values = function(*self.weights, *inputs, drawn, *kept, *grads)
        end = len(values) - 1 - len(inputs)
        if self.weights and self.learns:
            self.steps.append(values[:end])
            if len(self.steps) * len(drawn) >= LEARNING_BATCH:
                self._learn(self.program)
        return values[end:-1], values[-1]

    def before(self, floats: Tensor, zeros: Tensor, grad_inputs: Sequence[Tensor]) -> list[Tensor | None]:
        """The gradients before a step, the policy's share included: in state, outputs, observation and memory."""
        of = dict(zip(self.policy.in_keys, grad_inputs, strict=True))
        outputs = {key: of.pop(key) for key in self.step.output_layout.place if key in of}
        memory, observation = [of.pop(key) for key in self.memory], of.pop("observation", None)
        floats = self.step.layout.add(floats, {name_in_state(key): g for key, g in of.items()})
        return [floats, self.step.output_layout.add(zeros, outputs) if outputs else None, observation, *memory]

    def weight_gradients(self) -> Sequence[Tensor | None]:
        """The gradient of each weight, over all steps."""
        if self.steps and self.program is not None:
            self._learn(self.program)
        total = self.total or []
        return [*total, *[None] * (len(self.weights) - len(total))]  # constants have none

    def _learn(self, program: PolicyProgram) -> None:
        traces = self.steps[0] if len(self.steps) == 1 else [torch.cat(x) for x in zip(*self.steps, strict=True)]
        grads = program.policy.weight_gradient(self.weights, traces)
        self.total = grads if self.total is None else [a + b for a, b in zip(self.total, grads, strict=True)]
        self.steps = []


def _stack(steps: Any, dim: int) -> Tensor:
    return torch.stack(steps, dim) if len(steps) > 1 else steps[0].unsqueeze(dim)


def _add(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    return b if a is None else a if b is None else a + b
