"""Fly a horizon: policy, step, reset where an episode ends, and one tensordict of it all."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.engine.packing import Key, Rows, flat, flat_key, nested
from torchrl_quad.engine.policy import PlainPolicy, plain
from torchrl_quad.engine.program import Record, policy_inputs
from torchrl_quad.engine.simulation import State
from torchrl_quad.engine.stepper import Stepper


class Source(Protocol):
    """Where noise and new starts come from."""

    def noise(self) -> dict[str, Tensor]:
        """What the next step needs at random, by name."""

    def starts(self, mask: Tensor) -> dict[str, Any]:
        """What a reset writes, nested, for the environments of the mask, bool (n); rows of the others mean nothing."""


def can_fly(stepper: Stepper, policy: Any, tensordict: TensorDictBase) -> bool:
    """Whether :func:`fly` gives what TorchRL's own loop does: the policy reads nothing but observation and state."""
    if not isinstance(policy, TensorDictModuleBase) or "_" in policy.out_keys:
        return False
    state = {flat_key("state", *_path(key)) for key in stepper.layout.place}
    needed = {"observation", *stepper.output_layout.place} - {"reward"}
    writes, reads = ({flat_key(*_path(key)) for key in keys} for keys in (policy.out_keys, policy.in_keys))
    given = set(tensordict.keys(True, True))
    return reads <= state | {"observation"} and "action" in writes and needed <= given <= state | needed | writes


def flies_inside(stepper: Stepper, policy: Any) -> bool:
    """Whether the policy acts inside the compiled step, as opposed to being called before each step."""
    return _plain(stepper, policy) is not None


def fly(
    stepper: Stepper, source: Source, policy: TensorDictModuleBase, state: State, tensordict: TensorDictBase, steps: int
) -> TensorDict:
    """A rollout (n, steps) with its graph, through the ends of episodes.

    Args:
        stepper: steps the simulation.
        source: of noise and starts.
        policy: reads the observation, or the state, and writes the action.
        state: where it begins.
        tensordict: what a reset or a step wrote about that state.
        steps: at least one.
    """
    state, valid = stepper.simulation.guard(state)
    start = _record(stepper, state, tensordict)
    plain = _plain(stepper, policy)
    if plain is None:
        roots, ends, written = _call(stepper, source, policy, start, valid, steps)
    else:
        roots, ends, written = _fly_inside(stepper, source, plain, start, valid, steps)
    rollout = {**roots, **ends, **{flat_key(*_path(key)): x for key, x in written.items()}}
    del rollout["reward"]
    return TensorDict(nested(rollout), (len(tensordict), steps), tensordict.device, names=[None, "time"])


def _plain(stepper: Stepper, policy: Any) -> PlainPolicy | None:
    """The policy as the engine can fly it inside its step, if it can."""
    policy = plain(policy) if stepper.is_compiled else None
    if policy is None or not policy.weights:
        return policy
    state, observation = stepper.layout.unpack(stepper.example.state), stepper.example.observation
    width = sum(x.shape[-1] for x in policy_inputs(policy, state, observation))
    wanted, first = (width, observation.dtype, observation.device), policy.weights[0]
    return policy if (first.shape[1], first.dtype, first.device) == wanted else None


def _fly_inside(
    stepper: Stepper, source: Source, policy: PlainPolicy, start: Record, valid: Tensor, steps: int
) -> tuple[dict[Key, Tensor], ...]:
    """The entries of all roots and of all ends, and what the policy wrote, of one compiled horizon."""
    kind, done_row, _ = stepper.output_layout.place["done"]

    def restarted(end: Record) -> tuple[Record, Tensor] | None:
        done = end.outputs[kind][done_row]
        return (_restarted(stepper, source, end, done), done[0]) if done.any() else None

    flight = stepper.fly(policy, start, valid, steps, source.noise, restarted)
    leaves = [[*record.state, *record.outputs, record.observation] for record in (start, flight.ends)]
    again = [(t, [*fresh.state, *fresh.outputs, fresh.observation], done) for t, fresh, done in flight.restarts]
    roots = [
        _roots(first, x, [(t, fresh[i], done) for t, fresh, done in again], 0 if i < 6 else 1)
        for i, (first, x) in enumerate(zip(*leaves, strict=True))
    ]
    roots = Record(Rows(*roots[:3]), Rows(*roots[3:6]), roots[6])
    return _entries(stepper, roots), _entries(stepper, flight.ends, "next"), flight.written


def _roots(start: Tensor, ends: Tensor, again: list[tuple[int, Tensor, Tensor]], dim: int) -> Tensor:
    """Where steps begin: at the start, where the step before ended, or afresh."""
    roots = [start, *ends.unbind(dim)[:-1]]
    for t, fresh, done in again:
        roots[t + 1] = torch.where(done.unsqueeze(1) if dim else done, fresh, roots[t + 1])
    return torch.stack(roots, dim)


def _call(
    stepper: Stepper, source: Source, policy: TensorDictModuleBase, start: Record, valid: Tensor, steps: int
) -> tuple[dict[Key, Tensor], ...]:
    """The same for a policy that is called before each step."""
    roots = [start]
    ends: list[Record] = []
    written = []
    reads_state = any(flat_key(*_path(key)) != "observation" for key in policy.in_keys)
    kind, done_row, _ = stepper.output_layout.place["done"]
    for t in range(steps):
        root = roots[-1]
        td = TensorDict({"observation": root.observation}, [len(valid)], root.observation.device)
        if reads_state:
            td["state"] = nested(stepper.layout.unpack(root.state))
        td = policy(td)
        written.append([td.get(key) for key in policy.out_keys])
        action = td.get("action")
        stepper.simulation.check_action(action)
        end = stepper.step_rows(root.state, valid, action, source.noise())
        ends.append(end)
        if t == 0:
            valid = torch.ones_like(valid)  # a step leads to meaningful states
        done = end.outputs[kind][done_row]
        if t < steps - 1:
            roots.append(_restarted(stepper, source, end, done) if done.any() else end)
    written = {key: torch.stack(x, 1) for key, x in zip(policy.out_keys, zip(*written, strict=True), strict=True)}
    return _entries(stepper, _stacked(roots)), _entries(stepper, _stacked(ends), "next"), written


def _record(stepper: Stepper, state: State, tensordict: TensorDictBase) -> Record:
    """What is known of a state, on rows; there is no reward before the first step."""
    outputs = {key: tensordict.get(key) for key in stepper.output_layout.place if key != "reward"}
    outputs["reward"] = torch.zeros_like(outputs["done"], dtype=stepper.layout.dtypes[0])
    return Record(stepper.layout.pack(state), stepper.output_layout.pack(outputs), tensordict.get("observation"))


def _restarted(stepper: Stepper, source: Source, end: Record, done: Tensor) -> Record:
    """The record to continue from, with fresh starts where ``done`` (1, n); gradients stop there."""
    entries = flat(source.starts(done[0]))
    state = {key: entries[flat_key("state", *_path(key))].detach() for key in stepper.layout.place}
    fresh = _record(stepper, state, TensorDict({k: x.detach() for k, x in entries.items()}, done.shape[1:]))
    return Record(
        fresh.state.where(done, end.state),
        fresh.outputs.where(done, end.outputs),
        torch.where(done.t(), fresh.observation, end.observation),
    )


def _stacked(records: list[Record]) -> Record:
    """Some records as one, as :func:`_entries` reads it."""
    rows = (
        Rows(*(torch.stack(x) for x in zip(*part, strict=True)))
        for part in ([record.state for record in records], [record.outputs for record in records])
    )
    return Record(*rows, torch.stack([record.observation for record in records], 1))


def _entries(stepper: Stepper, records: Record, *prefix: str) -> dict[Key, Tensor]:
    """All entries of the records of a horizon, each (n, time, ...)."""
    entries = {flat_key("state", *_path(key)): x for key, x in stepper.layout.unpack(records.state).items()}
    entries |= stepper.unpack_outputs(records.outputs)
    entries["observation"] = records.observation
    return {flat_key(*prefix, *_path(key)): x for key, x in entries.items()}


def _path(key: Key) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)
