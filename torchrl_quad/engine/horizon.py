"""Fly a horizon: policy, step, reset where an episode ends, and one tensordict of it all."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.engine.packing import Key, Rows, flat, flat_key, nested
from torchrl_quad.engine.simulation import State
from torchrl_quad.engine.stepper import Record, Stepper


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
    n = len(tensordict)
    state, valid = stepper.simulation.guard(state)
    roots = [_record(stepper, state, tensordict)]
    ends: list[Record] = []
    written = []
    reads_state = any(flat_key(*_path(key)) != "observation" for key in policy.in_keys)
    kind, done_row, _ = stepper.output_layout.place["done"]
    for t in range(steps):
        root = roots[-1]
        td = TensorDict({"observation": root.observation}, [n], tensordict.device)
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
    by_policy = {
        flat_key(*_path(key)): torch.stack(x, 1)
        for key, x in zip(policy.out_keys, zip(*written, strict=True), strict=True)
    }
    rollout = _entries(stepper, roots) | _entries(stepper, ends, "next") | by_policy
    del rollout["reward"]
    return TensorDict(nested(rollout), (n, steps), tensordict.device, names=[None, "time"])


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


def _entries(stepper: Stepper, records: list[Record], *prefix: str) -> dict[Key, Tensor]:
    """All entries of some records, each (n, time, ...)."""
    state, outputs = (
        Rows(*(torch.stack(x) for x in zip(*rows, strict=True)))
        for rows in ([record.state for record in records], [record.outputs for record in records])
    )
    entries = {flat_key("state", *_path(key)): x for key, x in stepper.layout.unpack(state).items()}
    entries |= stepper.unpack_outputs(outputs)
    entries["observation"] = torch.stack([record.observation for record in records], 1)
    return {flat_key(*prefix, *_path(key)): x for key, x in entries.items()}


def _path(key: Key) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)
