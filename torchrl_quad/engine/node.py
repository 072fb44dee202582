"""A horizon as one node of the graph: compiled steps forwards, compiled adjoints backwards."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_quad.engine.packing import Layout, Rows
from torchrl_quad.engine.policy import GivenActions, PlainPolicy
from torchrl_quad.engine.program import PolicyProgram, Record, StepProgram, name_in_state, policy_inputs
from torchrl_quad.errors import Unsupported

LEARNING_BATCH = 1024  # so many steps of one drone make a batch for the gradient of the weights


class Horizon(NamedTuple):
    """What a horizon flies with, beside the tensors that have gradients."""

    step: StepProgram
    policy: PlainPolicy | GivenActions
    policy_program: PolicyProgram | None  # None for given actions
    start: Record
    valid: Tensor  # where the start is meaningful, bool (n)
    steps: int
    noise: Callable[[], dict[str, Tensor]]  # of the next step
    restarted: Callable[[Record], tuple[Record, Tensor] | None]  # where to go on, and who goes on afresh, bool (n)


class Flight(NamedTuple):
    """All steps of a horizon, their tensors one above the other."""

    ends: Record  # rows (steps, rows, n), observations (n, steps, k)
    written: dict[Any, Tensor]  # by the policy, (n, steps, ...)
    restarts: list[tuple[int, Record, Tensor]]  # where some went on afresh: the step before, from where, and who


def fly_horizon(horizon: Horizon, drawn: Tensor) -> Flight:
    """Fly a horizon; gradients reach its start, what was drawn (steps, n, k), the policy's weights, the parameters.

    They reach the actions as well: the node of all that is flown has ``actions``, a tensor (steps, n, k) that stands
    for them, and ``learns``, to be switched off for a backward pass that wants no gradient of the policy's weights.
    """
    start, policy, parameters = horizon.start, horizon.policy, horizon.step.simulation.parameters
    tensors = start.state.floats, start.observation, drawn, *policy.weights, *parameters
    keeps = torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
    actions = drawn.new_zeros(()).expand(drawn[..., : policy.size].shape).requires_grad_(keeps)
    restarts: list[tuple[int, Record, Tensor]] = []
    leaves = _Horizon.apply(horizon, keeps, restarts, actions, *tensors)
    if keeps:
        leaves[0].grad_fn.actions, leaves[0].grad_fn.learns = actions, True
    ends = Record(Rows(*leaves[:3]), Rows(*leaves[3:6]), leaves[6])
    return Flight(ends, dict(zip(policy.out_keys, leaves[7:], strict=True)), restarts)


class _Horizon(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, horizon: Horizon, keeps: bool, restarts: list, _, floats, observation, drawn, *tensors):
        step, policy = horizon.step, _Policy(horizon)
        floats, observation, drawn, *tensors = (x.detach().contiguous() for x in (floats, observation, drawn, *tensors))
        policy.weights, parameters = tensors[: len(policy.weights)], tensors[len(policy.weights) :]
        rows, valid = Rows(floats, *horizon.start.state[1:]), horizon.valid
        saved, ends, entries = [], [], []
        for t in range(horizon.steps):
            inputs = policy.inputs(rows, observation)
            kept, written = policy.forward(inputs, drawn[t], is_first=t == 0)
            noise = horizon.noise()
            step.noise_names = tuple(noise)
            # The stride of a single row can be anything, and a compiler takes another one for another kind of input.
            others = (x.reshape(-1).view(x.shape) for x in rows[1:])
            start = (rows.floats, *others, valid, written[policy.action], *parameters, *noise.values())
            states_end = (step.forward if t == 0 else step.forward.again)(*start)
            states, leaves = states_end[: step.substeps], states_end[step.substeps :]
            end = Record(Rows(*leaves[:3]), Rows(*leaves[3:6]), leaves[6])
            if keeps:
                saved.append((start, states, inputs, kept, drawn[t]))
            ends.append(leaves)
            entries.append(written)
            if t == 0:
                valid = torch.ones_like(valid)  # a step leads to meaningful states
            if t < horizon.steps - 1 and (again := horizon.restarted(end)) is not None:
                restarts.append((t, *again))
                end = again[0]
            rows, observation = end.state, end.observation
        ctx.horizon, ctx.restarts, ctx.parameter_count = horizon, restarts, len(parameters)
        ctx.like = [(x.shape, x.dtype, x.device) for x in (leaves[0], leaves[3], leaves[6], *written)]
        ctx.shapes = [tuple(map(len, parts[:4])) for parts in saved]
        ctx.save_for_backward(
            *policy.weights, *(x for parts in saved for part in (*parts[:4], parts[4:]) for x in part)
        )
        ctx.set_materialize_grads(False)
        stacked = [_stack(x, 0) for x in zip(*(leaves[:6] for leaves in ends), strict=True)]
        ctx.mark_non_differentiable(*stacked[1:3], *stacked[4:6])
        observations = _stack([leaves[6] for leaves in ends], 1)
        return *stacked, observations, *(_stack(x, 1) for x in zip(*entries, strict=True))

    @staticmethod
    def backward(ctx: Any, *grads):
        if torch.is_grad_enabled():  # so it is under create_graph=True alone
            raise Unsupported(
                "A compiled flight has first derivatives only. For second ones (create_graph=True) call env.eager() "
                "and fly again."
            )
        horizon, policy, step = ctx.horizon, _Policy(ctx.horizon, ctx.learns), ctx.horizon.step
        saved = iter(ctx.saved_tensors)
        policy.weights = _take(saved, len(policy.weights))
        steps = [(*(_take(saved, count) for count in counts), next(saved)) for counts in ctx.shapes]
        # A tensor for each: a compiler would count on two being one.
        zeros = [torch.zeros(shape, dtype=dtype, device=device) for shape, dtype, device in ctx.like]
        fresh = {t: who for t, _, who in ctx.restarts}
        of_end, of_written = (grads[0], grads[3], grads[6]), grads[7:]
        grad_floats = grad_observation = None
        grads_action, grads_drawn, grads_parameter = [], [], []
        for t in reversed(range(horizon.steps)):
            start, states, inputs, kept, drawn = steps[t]
            if t in fresh:
                grad_floats = torch.where(fresh[t], 0.0, grad_floats)
                if grad_observation is not None:
                    grad_observation = torch.where(fresh[t].unsqueeze(1), 0.0, grad_observation)
            end = [None if g is None else g[:, t] if i == 2 else g[t] for i, g in enumerate(of_end)]
            end[0], end[2] = _add(end[0], grad_floats), _add(end[2], grad_observation)
            end = [zero if g is None else g.contiguous() for g, zero in zip(end, zeros, strict=False)]
            is_first = t == horizon.steps - 1
            grad_floats, grad_action, *grad_parameters = (step.adjoint if is_first else step.adjoint.again)(
                *start, *states, *end
            )
            written = [None if g is None else g[:, t] for g in of_written]
            written[policy.action] = _add(written[policy.action], grad_action)
            grads_action.append(written[policy.action])
            written = [zero if g is None else g.contiguous() for g, zero in zip(written, zeros[3:], strict=True)]
            grad_inputs, grad_drawn = policy.adjoint(inputs, kept, drawn, written, is_first=is_first)
            grad_floats, grad_observation = policy.add(grad_floats, grad_inputs)
            grads_drawn.append(grad_drawn)
            grads_parameter.append(grad_parameters)
        actions = torch.stack(grads_action[::-1]) if ctx.needs_input_grad[3] else None
        drawn = torch.stack(grads_drawn[::-1]) if ctx.needs_input_grad[6] else None
        parameters = (torch.stack(x).sum(0) for x in zip(*grads_parameter, strict=True))
        return None, None, None, actions, grad_floats, grad_observation, drawn, *policy.weight_gradients(), *parameters


class _Policy:
    """The policy of one pass over a horizon, on lists of tensors; backwards it gathers the gradient of its weights."""

    def __init__(self, horizon: Horizon, learns: bool = True) -> None:
        self.learns = learns
        self.policy, self.program, self.weights = horizon.policy, horizon.policy_program, horizon.policy.weights
        self.layout: Layout = horizon.step.layout
        self.action = list(self.policy.out_keys).index("action")
        self.steps: list[tuple[Any, ...]] = []  # whose gradient in the weights is still to be taken
        self.total: list[Tensor] | None = None

    def inputs(self, rows: Rows, observation: Tensor) -> list[Tensor]:
        """What it reads."""
        if tuple(self.policy.in_keys) == ("observation",):
            return [observation]
        return policy_inputs(self.policy, self.layout.unpack(rows) if self.policy.in_keys else {}, observation)

    def forward(self, inputs: list[Tensor], drawn: Tensor, *, is_first: bool) -> tuple[list[Tensor], list[Tensor]]:
        """What it keeps, and what it writes."""
        if self.program is None:
            return [], [drawn]
        function = self.program.forward if is_first else self.program.forward.again
        values = function(*self.weights, *inputs, drawn)
        count = len(values) - len(self.policy.out_keys)
        return values[:count], values[count:]

    def adjoint(
        self, inputs: list[Tensor], kept: list[Tensor], drawn: Tensor, grads: list[Tensor], *, is_first: bool
    ) -> tuple[list[Tensor], Tensor]:
        """The gradients of its inputs, and of what was drawn, from those of what it wrote."""
        if self.program is None:
            return [], grads[self.action]
        function = self.program.adjoint if is_first else self.program.adjoint.again
        values = function(*self.weights, *inputs, drawn, *kept, *grads)
        end = len(values) - 1 - len(inputs)
        if self.weights and self.learns:
            self.steps.append(values[:end])
            if len(self.steps) * len(drawn) >= LEARNING_BATCH:
                self._learn()
        return values[end:-1], values[-1]

    def add(self, grad_floats: Tensor, grad_inputs: list[Tensor]) -> tuple[Tensor, Tensor | None]:
        """The gradients of the state's floats, the policy's share included, and of the observation."""
        of_state = dict(zip(self.policy.in_keys, grad_inputs, strict=True))
        of_observation = of_state.pop("observation", None)
        return self.layout.add(grad_floats, {name_in_state(key): g for key, g in of_state.items()}), of_observation

    def weight_gradients(self) -> list[Tensor | None]:
        """The gradient of each weight, over all steps."""
        if self.steps:
            self._learn()
        return self.total or [None] * len(self.weights)

    def _learn(self) -> None:
        traces = self.steps[0] if len(self.steps) == 1 else [torch.cat(x) for x in zip(*self.steps, strict=True)]
        grads = self.policy.weight_gradient(traces)
        self.total = grads if self.total is None else [a + b for a, b in zip(self.total, grads, strict=True)]
        self.steps = []


def _take(values: Iterable[Tensor], count: int) -> list[Tensor]:
    return [next(values) for _ in range(count)]


def _stack(steps: Any, dim: int) -> Tensor:
    return torch.stack(steps, dim) if len(steps) > 1 else steps[0].unsqueeze(dim)


def _add(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    return b if a is None else a if b is None else a + b
