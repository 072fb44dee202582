"""Fly a horizon: policy, step, reset where an episode ends, and one tensordict of it all."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.engine.packing import Key, Rows, flat, like, looks_are_free, nested
from torchrl_quad.engine.policy import GivenActions, PlainPolicy, plain
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
    """Whether :func:`fly` gives what TorchRL's own loop does.

    So it is if the policy reads nothing but state, observation and the other outputs of a step, and what it has written
    itself in the step before, which includes the memory of a recurrent one.
    """
    if not isinstance(policy, TensorDictModuleBase) or "_" in policy.out_keys:
        return False
    state = {unravel_key(("state", key)) for key in stepper.layout.place}
    needed = {"observation", *stepper.output_layout.place} - {"reward"}
    writes, reads = ({unravel_key(key) for key in keys} for keys in (policy.out_keys, policy.in_keys))
    memory = _memory(policy)
    writes |= {*memory, "is_init"} if memory else set()
    given = set(tensordict.keys(True, True))
    knows = reads <= state | needed | writes and "action" in writes
    return knows and needed <= given <= state | needed | writes


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
    plain = _plain(stepper, policy)
    memory = _memory(policy)
    own = (*policy.out_keys, *memory, "is_init")
    before = {key: tensordict.get(key) for key in own if key in tensordict and key != "action"}
    for key in memory if {"is_init", *memory} <= before.keys() else ():
        before[key] = torch.where(like(before["is_init"], before[key]), 0.0, before[key])
    if not stepper.is_compiled:
        roots, ends, written = _fly_eager(stepper, source, policy, state, tensordict, valid, steps, before)
    elif plain is None:
        start = _record(stepper, state, tensordict)
        roots, ends, written = _call(stepper, source, policy, start, valid, steps, before)
    else:
        start = _record(stepper, state, tensordict)
        roots, ends, written = _fly_inside(stepper, source, plain, start, valid, steps, before)
    rollout = {**roots, **ends, **{unravel_key(key): x for key, x in written.items()}}
    rollout.pop("reward", None)  # there is none before the first step
    return TensorDict(nested(rollout), (len(tensordict), steps), tensordict.device, names=[None, "time"])


def _plain(stepper: Stepper, policy: Any) -> PlainPolicy | GivenActions | None:
    """The policy as the engine can fly it inside its step, if it can."""
    policy = plain(policy) if stepper.is_compiled else None
    if policy is None:
        return None
    state = stepper.layout.unpack(stepper.example.state)
    if not {unravel_key(key) for key in policy.in_keys} <= {"observation", *_of_state(state)}:
        return None
    return policy if policy.fits(policy_inputs(policy, state, stepper.example.observation)) else None


def _fly_inside(
    stepper: Stepper,
    source: Source,
    policy: PlainPolicy | GivenActions,
    start: Record,
    valid: Tensor,
    steps: int,
    before: dict[Any, Tensor],
) -> tuple[dict[Key, Tensor], ...]:
    """The entries of all roots and of all ends, and what the policy wrote, of one compiled horizon."""
    kind, done_row, _ = stepper.output_layout.place["done"]

    def restarted(end: Record) -> tuple[Record, Tensor] | None:
        done = end.outputs[kind][done_row]
        return (_restarted(stepper, source, end, done), done[0]) if _may_restart(done) else None

    flight = stepper.fly(policy, start, valid, steps, source.noise, restarted, before)
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
    stepper: Stepper,
    source: Source,
    policy: TensorDictModuleBase,
    start: Record,
    valid: Tensor,
    steps: int,
    before: dict[Any, Tensor],
) -> tuple[dict[Key, Tensor], ...]:
    """The same for a policy that is called before each compiled step."""
    roots = [start]
    ends: list[Record] = []
    written = []
    kind, done_row, _ = stepper.output_layout.place["done"]
    reads = any(unravel_key(key) in stepper.output_layout.place for key in policy.in_keys)
    for t in range(steps):
        root = roots[-1]
        outputs = {"observation": root.observation, **(stepper.unpack_outputs(root.outputs) if reads else {})}
        action, now = _act(stepper, policy, outputs, stepper.layout.unpack(root.state), before)
        written.append(now)
        end = stepper.step_rows(root.state, valid, action, source.noise())
        ends.append(end)
        if t == 0:
            valid = torch.ones_like(valid)  # a step leads to meaningful states
        done = end.outputs[kind][done_row]
        before = _handed_on(policy, now, done.t())
        if t < steps - 1:
            roots.append(_restarted(stepper, source, end, done) if _may_restart(done) else end)
    return _entries(stepper, _stacked(roots)), _entries(stepper, _stacked(ends), "next"), _over_time(written)


def _fly_eager(
    stepper: Stepper,
    source: Source,
    policy: TensorDictModuleBase,
    state: State,
    tensordict: TensorDictBase,
    valid: Tensor,
    steps: int,
    before: dict[Any, Tensor],
) -> tuple[dict[Key, Tensor], ...]:
    """The same without a compiler, on entries: each is a tensor of its own anyway."""
    outputs = {key: tensordict.get(key) for key in ("observation", *stepper.output_layout.place) if key != "reward"}
    roots, ends, written = [_of_state(state) | outputs], [], []
    for t in range(steps):
        action, now = _act(stepper, policy, roots[-1], state, before)
        written.append(now)
        state, outputs = stepper.step(state, valid, action, source.noise())
        ends.append(_of_state(state) | flat(outputs))
        before = _handed_on(policy, now, outputs["done"])
        if t == 0:
            valid = torch.ones_like(valid)  # a step leads to meaningful states
        if t < steps - 1:
            root = {key: x for key, x in ends[-1].items() if key != "reward"}
            done = outputs["done"]
            if _may_restart(done):
                fresh = flat(source.starts(done[:, 0]))
                root = {key: torch.where(like(done, x), fresh[key].detach(), x) for key, x in root.items()}
                state = {key: root[unravel_key(("state", key))] for key in state}
            roots.append(root)
    return (
        _over_time(roots),
        {unravel_key(("next", key)): x for key, x in _over_time(ends).items()},
        _over_time(written),
    )


def _act(
    stepper: Stepper, policy: TensorDictModuleBase, outputs: dict[Key, Tensor], state: State, before: dict[Any, Tensor]
) -> tuple[Tensor, dict[Any, Tensor]]:
    """The action of a policy that is called, and all that it writes; it sees what it wrote in the step before."""
    handed_on = {key: x for key, x in before.items() if key != "action"}
    reads, observation = {unravel_key(key) for key in policy.in_keys}, outputs["observation"]
    read = {key: x for key, x in outputs.items() if key in reads or key == "observation"}
    td = TensorDict({**handed_on, **nested(read)}, [len(observation)], observation.device)
    if reads - {"observation"}:
        td["state"] = nested(state)
    memory = _memory(policy)
    if memory:
        td["is_init"] = before.get("is_init", torch.zeros_like(observation[:, :1], dtype=torch.bool))
    td = policy(td)
    action = td.get("action")
    stepper.simulation.check_action(action)
    written = {key: td.get(key) for key in policy.out_keys}
    for key in memory:
        after = written[unravel_key(("next", key))]
        written[key] = torch.zeros_like(after) if before.get(key) is None else before[key]
    if memory:
        written |= {"is_init": td["is_init"], ("next", "is_init"): torch.zeros_like(td["is_init"])}
    return action, written


def _memory(policy: TensorDictModuleBase) -> list[Any]:
    """The entries in which a recurrent policy remembers: it reads them, and writes them below "next"."""
    written = {unravel_key(key) for key in policy.out_keys}
    return [key for key in policy.in_keys if unravel_key(("next", key)) in written]


def _handed_on(policy: TensorDictModuleBase, written: dict[Any, Tensor], done: Tensor) -> dict[Any, Tensor]:
    """Of what a policy has written that which it sees in the next step; where an episode ends, bool (n, 1), it forgets.

    The gradient ends there with the memory.
    """
    memory = _memory(policy)
    if not memory:
        return written
    before = {key: x for key, x in written.items() if not (isinstance(key, tuple) and key[0] == "next")}
    for key in memory:
        x = written[unravel_key(("next", key))]
        before[key] = torch.where(like(done, x), 0.0, x) if _may_restart(done) else x
    return before | {"is_init": done}


def _over_time(steps: list[dict[Key, Tensor]]) -> dict[Key, Tensor]:
    """The entries of several steps, each (n, time, ...)."""
    return {key: torch.stack([entries[key] for entries in steps], 1) for key in steps[0]}


def _of_state(state: State) -> dict[Key, Tensor]:
    """The entries of a state by their names in a tensordict."""
    return {unravel_key(("state", key)): x for key, x in state.items()}


def _record(stepper: Stepper, state: State, tensordict: TensorDictBase) -> Record:
    """What is known of a state, on rows; there is no reward before the first step."""
    outputs = {key: tensordict.get(key) for key in stepper.output_layout.place if key != "reward"}
    outputs["reward"] = torch.zeros_like(outputs["done"], dtype=stepper.layout.dtypes[0])
    return Record(stepper.layout.pack(state), stepper.output_layout.pack(outputs), tensordict.get("observation"))


def _restarted(stepper: Stepper, source: Source, end: Record, done: Tensor) -> Record:
    """The record to continue from, with fresh starts where ``done`` (1, n); gradients stop there."""
    entries = flat(source.starts(done[0]))
    state = {key: entries[unravel_key(("state", key))].detach() for key in stepper.layout.place}
    fresh = _record(stepper, state, TensorDict({k: x.detach() for k, x in entries.items()}, done.shape[1:]))
    return Record(
        fresh.state.where(done, end.state),
        fresh.outputs.where(done, end.outputs),
        torch.where(done.t(), fresh.observation, end.observation),
    )


def _may_restart(done: Tensor) -> bool:
    """Whether an episode may have ended: whoever asks an accelerator has to wait for it."""
    return not looks_are_free(done.device) or bool(done.any())


def _stacked(records: list[Record]) -> Record:
    """Some records as one, as :func:`_entries` reads it."""
    rows = (
        Rows(*(torch.stack(x) for x in zip(*part, strict=True)))
        for part in ([record.state for record in records], [record.outputs for record in records])
    )
    return Record(*rows, torch.stack([record.observation for record in records], 1))


def _entries(stepper: Stepper, records: Record, *prefix: str) -> dict[Key, Tensor]:
    """All entries of the records of a horizon, each (n, time, ...)."""
    entries = _of_state(stepper.layout.unpack(records.state))
    entries |= stepper.unpack_outputs(records.outputs)
    entries["observation"] = records.observation
    return {unravel_key((*prefix, key)): x for key, x in entries.items()}
