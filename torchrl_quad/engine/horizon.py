"""Fly a horizon: policy, step, reset where an episode ends, and one tensordict of it all."""

from __future__ import annotations

from typing import Any, Protocol, cast

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.engine.packing import Record, flat, like, looks_are_free, nested
from torchrl_quad.engine.policy import ENDS, GivenActions, PlainPolicy
from torchrl_quad.engine.program import policy_inputs
from torchrl_quad.engine.simulation import State
from torchrl_quad.engine.stepper import Stepper

Entries = dict[Any, Tensor]
_NAMES: Any = [None, "time"]  # of the dimensions; tensordict's annotations leave out None


class Source(Protocol):
    """Where noise and new starts come from."""

    def noise(self) -> dict[str, Tensor]:
        """What the next step needs at random, by name."""

    def starts(self, mask: Tensor) -> dict[str, Any]:
        """What a reset writes, nested, for the environments of the mask, bool (n); rows of the others mean nothing."""


def can_fly(stepper: Stepper, policy: Any, tensordict: TensorDictBase) -> bool:
    """Whether :func:`fly` gives what TorchRL's own loop does.

    So it is if the policy reads nothing but the state, the outputs of a step, and what it has written in the step
    before, which includes the memory of a recurrent one.
    """
    if not isinstance(policy, TensorDictModuleBase) or "_" in policy.out_keys:
        return False
    state = {unravel_key(("state", key)) for key in stepper.layout.place}
    needed = {"observation", *stepper.output_layout.place} - {"reward"}
    writes, reads = ({unravel_key(key) for key in keys} for keys in (policy.out_keys, policy.in_keys))
    memory = _memory(policy)
    writes |= {*memory, "is_init"} if memory else set()
    given = set(tensordict.keys(True, True))
    # The reward of the step before is nothing that a policy finds in TorchRL's loop; transforms hand it on.
    known = state | needed | writes | ({"reward"} & given & reads)
    return reads <= known and "action" in writes and needed <= given <= known


def flies_inside(stepper: Stepper, policy: Any) -> bool:
    """Whether the policy acts inside the compiled step, as opposed to being called before each step."""
    return _plain(stepper, policy) is not None


def fly(
    stepper: Stepper, source: Source, policy: TensorDictModuleBase, state: State, tensordict: TensorDictBase, steps: int
) -> TensorDict:
    """A rollout (n, steps) with its graph, through the ends of episodes.

    It begins at ``state``, about which a reset or a step wrote ``tensordict``.
    """
    state, valid = stepper.simulation.guard(state)
    loop, acts = _Loop(stepper, source, policy, tensordict), _plain(stepper, policy)
    about = _entries(tensordict, ["observation", *(key for key in stepper.output_layout.place if key != "reward")])
    if not stepper.is_compiled:
        roots, ends, written = loop.eager(state, about, valid, steps)
    elif acts is None:
        roots, ends, written = loop.called(loop.record(state, about), valid, steps)
    else:
        roots, ends, written = loop.inside(acts, loop.record(state, about), valid, steps)
    rollout = {**roots, **ends, **{unravel_key(key): x for key, x in written.items()}}
    rollout.pop("reward", None)  # there is none before the first step
    return TensorDict(nested(rollout), (len(tensordict), steps), tensordict.device, names=_NAMES)


class _Loop:
    """Three ways to fly one horizon, each to the entries of all roots and of all ends, and what the policy wrote."""

    def __init__(
        self, stepper: Stepper, source: Source, policy: TensorDictModuleBase, tensordict: TensorDictBase
    ) -> None:
        self.stepper, self.source, self.policy, self.memory = stepper, source, policy, _memory(policy)
        self.kind, self.done_row, _ = stepper.output_layout.place["done"]
        own = (*policy.out_keys, *self.memory, "is_init")
        # What the policy has written in the step before.
        self.before = _entries(tensordict, [key for key in own if key in tensordict and key != "action"])
        # What transforms remember is as it was given; the memory of a network is empty where an episode begins.
        cleared = [key for key in self.memory if key not in getattr(policy, "transform_memory", ())]
        for key in cleared if {"is_init", *cleared} <= self.before.keys() else ():
            self.before[key] = torch.where(like(self.before["is_init"], self.before[key]), 0.0, self.before[key])

    def inside(self, acts: PlainPolicy | GivenActions, start: Record, valid: Tensor, steps: int) -> tuple[Entries, ...]:
        """With a policy that acts inside the compiled step."""

        def restarted(end: Record, ends: Tensor | None) -> tuple[Record, Tensor] | None:
            done = self.done(end, ends)
            return (self.restarted(end, done), done[0]) if _may_restart(done) else None

        flight = self.stepper.fly(acts, start, valid, steps, self.source.noise, restarted, self.before)
        restarts, written = flight.restarts, flight.written
        roots = []
        for i, (first, ends) in enumerate(zip(start.leaves, flight.ends.leaves, strict=True)):
            fresh = {t: (leaves.leaves[i], done.unsqueeze(1) if i == 6 else done) for t, leaves, done in restarts}
            roots.append(_roots(first, ends, fresh, int(i == 6)))  # only observations have the environments first
        for key in acts.memory:
            ends = written[unravel_key(("next", key))]
            first = self.before[key] if key in self.before else torch.zeros_like(ends[:, 0])
            fresh = {t: (torch.zeros_like(first), like(done, first)) for t, _, done in restarts}
            written[key] = _roots(first, ends.transpose(0, 1), fresh, 0).transpose(0, 1)
        if acts.memory:
            no = torch.zeros((len(valid), steps, 1), dtype=torch.bool, device=valid.device)
            fresh = {t: (torch.ones_like(no[:, 0]), done.unsqueeze(1)) for t, _, done in restarts}
            written["is_init"] = _roots(self.before.get("is_init", no[:, 0]), no, fresh, 1)
            written["next", "is_init"] = no
        return self.entries(Record.of(roots)), self.entries(flight.ends, "next"), written

    def called(self, start: Record, valid: Tensor, steps: int) -> tuple[Entries, ...]:
        """With a policy that is called before each compiled step."""
        roots, ends, written = [start], [], []
        reads = any(unravel_key(key) in self.stepper.output_layout.place for key in self.policy.in_keys)
        for t in range(steps):
            root = roots[-1]
            outputs = self.stepper.unpack_outputs(root.outputs) if reads else {}
            state = self.stepper.layout.unpack(root.state)
            action, now = self.act({"observation": root.observation, **outputs}, state)
            end = self.stepper.step_rows(root.state, valid, action, self.source.noise())
            written.append(now)
            ends.append(end)
            valid = torch.ones_like(valid) if t == 0 else valid  # a step leads to meaningful states
            done = self.done(end, now.get(ENDS))
            self.hand_on(now, done.t())
            roots.append(self.restarted(end, done) if t < steps - 1 and _may_restart(done) else end)
        return self.entries(_stacked(roots[:-1])), self.entries(_stacked(ends), "next"), _over_time(written)

    def eager(self, state: State, outputs: Entries, valid: Tensor, steps: int) -> tuple[Entries, ...]:
        """Without a compiler, on entries: each is a tensor of its own anyway."""
        roots, ends, written = [_of_state(state) | outputs], [], []
        reward = torch.zeros_like(outputs["observation"][:, :1])
        for t in range(steps):
            action, now = self.act({**roots[-1], "reward": reward}, state)
            state, outputs = self.stepper.step(state, valid, action, self.source.noise())
            written.append(now)
            ends.append(_of_state(state) | flat(outputs))
            done, reward = outputs["done"], outputs["reward"]
            done = done | (now[ENDS] > 0) if ENDS in now else done
            self.hand_on(now, done)
            valid = torch.ones_like(valid) if t == 0 else valid  # a step leads to meaningful states
            root = {key: x for key, x in ends[-1].items() if key != "reward"}
            if t < steps - 1 and _may_restart(done):
                fresh = flat(self.source.starts(done[:, 0]))
                root = {key: torch.where(like(done, x), fresh[key].detach(), x) for key, x in root.items()}
                state = {key: root[unravel_key(("state", key))] for key in state}
            roots.append(root)
        next_ends = {unravel_key(("next", key)): x for key, x in _over_time(ends).items()}
        return _over_time(roots[:-1]), next_ends, _over_time(written)

    def act(self, outputs: Entries, state: State) -> tuple[Tensor, Entries]:
        """The action of a policy that is called, and all that it writes; it reads what it wrote in the step before."""
        policy, before = self.policy, self.before
        handed_on = {key: x for key, x in before.items() if key != "action"}
        reads, observation = {unravel_key(key) for key in policy.in_keys}, outputs["observation"]
        read = {key: x for key, x in outputs.items() if key in reads or key == "observation"}
        td: TensorDictBase = TensorDict({**handed_on, **nested(read)}, [len(observation)], observation.device)
        if reads - {"observation"}:
            td["state"] = nested(state)
        if self.memory:
            td["is_init"] = before.get("is_init", torch.zeros_like(observation[:, :1], dtype=torch.bool))
        written = _entries(policy(td), [*policy.out_keys, *(["is_init"] if self.memory else [])])
        self.stepper.simulation.check_action(written["action"])
        for key in self.memory:
            after = written[unravel_key(("next", key))]
            written[key] = torch.zeros_like(after) if before.get(key) is None else before[key]
        if self.memory:
            written["next", "is_init"] = torch.zeros_like(written["is_init"])
        return written["action"], written

    def hand_on(self, written: Entries, done: Tensor) -> None:
        """Keep what the policy reads in the next step; where an episode ends, bool (n, 1), memory and gradient end."""
        if not self.memory:
            self.before = written
            return
        self.before = {key: x for key, x in written.items() if not (isinstance(key, tuple) and key[0] == "next")}
        for key in self.memory:
            x = written[unravel_key(("next", key))]
            self.before[key] = torch.where(like(done, x), 0.0, x) if _may_restart(done) else x
        self.before["is_init"] = done

    def done(self, end: Record, ends: Tensor | None) -> Tensor:
        """Where an episode ends, bool (1, n), also where the policy ends it, (n, 1)."""
        done = end.outputs[self.kind][self.done_row]
        return done if ends is None else done | (ends > 0).t()

    def record(self, state: State, outputs: Entries) -> Record:
        """What is known of a state, on rows; there is no reward before the first step."""
        reward = torch.zeros_like(outputs["done"], dtype=self.stepper.layout.dtypes[0])
        rows = self.stepper.output_layout.pack({**outputs, "reward": reward})
        return Record(self.stepper.layout.pack(state), rows, outputs["observation"])

    def restarted(self, end: Record, done: Tensor) -> Record:
        """The record to continue from, with fresh starts where ``done`` (1, n); gradients stop there."""
        entries = {key: x.detach() for key, x in flat(self.source.starts(done[0])).items()}
        fresh = self.record({key: entries[unravel_key(("state", key))] for key in self.stepper.layout.place}, entries)
        pairs = zip(fresh.leaves, end.leaves, strict=True)
        return Record.of([torch.where(done if i < 6 else done.t(), *pair) for i, pair in enumerate(pairs)])

    def entries(self, records: Record, *prefix: str) -> Entries:
        """All entries of the records of a horizon, each (n, time, ...)."""
        entries = _of_state(self.stepper.layout.unpack(records.state))
        entries |= self.stepper.unpack_outputs(records.outputs) | {"observation": records.observation}
        return {unravel_key((*prefix, key)): x for key, x in entries.items()}


def _plain(stepper: Stepper, policy: Any) -> PlainPolicy | GivenActions | None:
    """The policy as the engine can fly it inside its step, if it can."""
    make = getattr(policy, "plain", None)
    acts = make() if stepper.is_compiled and callable(make) else None
    if acts is None:
        return None
    acts.without_gradient = stepper.simulation.constants
    known = {"observation", *acts.memory, *stepper.output_layout.place, *map(_in_state, stepper.layout.place)}
    if not set(map(unravel_key, acts.in_keys)) <= known:
        return None
    at, n = stepper.example, len(stepper.example.observation)
    memory = {key: at.observation.new_zeros((n, *size)) for key, size in acts.memory.items()}
    return acts if acts.fits(policy_inputs(acts, stepper.layout, stepper.output_layout, at, memory)) else None


def _roots(first: Tensor, ends: Tensor, fresh: dict[int, tuple[Tensor, Tensor]], dim: int) -> Tensor:
    """Where the steps of a horizon began, from where the first did and all ended, with fresh starts after some."""
    roots = [first, *ends.unbind(dim)[:-1]]
    for t, (start, mask) in fresh.items():
        roots[t + 1] = torch.where(mask, start, roots[t + 1])
    return torch.stack(roots, dim)


def _entries(tensordict: TensorDictBase, keys: list[Any]) -> Entries:
    return {key: cast(Tensor, tensordict.get(key)) for key in keys}


def _memory(policy: TensorDictModuleBase) -> list[Any]:
    """The entries in which a recurrent policy remembers: it reads them, and writes them below "next"."""
    written = {unravel_key(key) for key in policy.out_keys}
    return [key for key in policy.in_keys if unravel_key(("next", key)) in written]


def _over_time(steps: list[Entries]) -> Entries:
    return {key: torch.stack([entries[key] for entries in steps], 1) for key in steps[0]}


def _of_state(state: State) -> Entries:
    """The entries of a state by their names in a tensordict."""
    return {_in_state(key): x for key, x in state.items()}


def _in_state(key: Any) -> Any:
    return unravel_key(("state", key))


def _may_restart(done: Tensor) -> bool:
    """Whether an episode may have ended: reading that of an accelerator would be a synchronisation."""
    return not looks_are_free(done.device) or bool(done.any())


def _stacked(records: list[Record]) -> Record:
    leaves = zip(*(record.leaves for record in records), strict=True)
    return Record.of([torch.stack(x, 0 if i < 6 else 1) for i, x in enumerate(leaves)])
