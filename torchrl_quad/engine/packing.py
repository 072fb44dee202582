"""Pack the many entries of a state into the rows of a few tensors, and convert names of nested entries.

A tensordict with its thirty entries costs far more than the physics of a step: only a finished horizon becomes one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_quad.engine.simulation import Transition

Key = str | tuple[str, ...]
Entries = Mapping[Any, Tensor]


class Rows(NamedTuple):
    """Entries of a batch of n, below each other by kind; each (rows, n), or (time, rows, n) for a horizon."""

    floats: Tensor
    integers: Tensor
    flags: Tensor


class Record(NamedTuple):
    """A transition on rows, or all of a horizon."""

    state: Rows  # at the end of the step
    outputs: Rows  # reward, flags and so on, without the observation
    observation: Tensor  # (n, k), or (n, time, k)

    @classmethod
    def of(cls, leaves: Any) -> Record:
        """From its seven tensors."""
        return cls(Rows(*leaves[:3]), Rows(*leaves[3:6]), leaves[6])

    @property
    def leaves(self) -> tuple[Tensor, ...]:
        """Its seven tensors."""
        return (*self.state, *self.outputs, self.observation)


class Layout:
    """Which rows hold which entry (n, ...), in the order of the entries."""

    def __init__(self, entries: Entries) -> None:
        self.place: dict[Key, tuple[int, slice, torch.Size]] = {}
        heights = [0, 0, 0]
        for key, x in entries.items():
            kind = 0 if x.is_floating_point() else 2 if x.dtype == torch.bool else 1
            height = x[0].numel()
            self.place[key] = (kind, slice(heights[kind], heights[kind] + height), x.shape[1:])
            heights[kind] += height
        self.dtypes = next(x.dtype for x in entries.values() if x.is_floating_point()), torch.int64, torch.bool

    def pack(self, entries: Entries) -> Rows:
        """The rows of the entries, each (n, ...)."""
        columns: list[list[Tensor]] = [[], [], []]
        for key, (kind, _, _) in self.place.items():
            columns[kind].append(entries[key].flatten(1).t())
        like = next(iter(entries.values()))
        both = zip(columns, self.dtypes, strict=True)
        return Rows(*(torch.cat(x) if x else like.new_empty((0, len(like)), dtype=dtype) for x, dtype in both))

    def unpack(self, rows: Rows) -> dict[Key, Tensor]:
        """Views of the entries, each (n, ...), or (n, time, ...) of a horizon."""
        entries = {}
        for key, (kind, where, shape) in self.place.items():
            x = rows[kind][..., where, :].movedim(-1, 0)
            entries[key] = x if len(shape) == 1 else x.unflatten(-1, shape)
        return entries

    def add(self, floats: Tensor, entries: Entries) -> Tensor:
        """The rows of floats with some entries (n, ...) added to their own."""
        if not entries:
            return floats
        own = [(where, entries.get(key)) for key, (kind, where, _) in self.place.items() if kind == 0]
        return torch.cat([floats[where] if x is None else floats[where] + x.flatten(1).t() for where, x in own])


def record(end: Transition, layout: Layout, output_layout: Layout) -> Record:
    """A transition on rows."""
    return Record(layout.pack(end.state), output_layout.pack(flat(end.outputs)), end.outputs["observation"])


def flat(entries: Mapping[Any, Any], *prefix: str) -> dict[Any, Tensor]:
    """The entries of nested mappings, by one key each."""
    result = {}
    for key, value in entries.items():
        path = (*prefix, *key) if isinstance(key, tuple) else (*prefix, key)
        result |= flat(value, *path) if isinstance(value, Mapping) else {path if len(path) > 1 else path[0]: value}
    return result


def nested(entries: Entries) -> dict[Any, Any]:
    """The reverse of :func:`flat`."""
    result: dict[str, Any] = {}
    for key, value in entries.items():
        *path, last = key if isinstance(key, tuple) else (key,)
        inner = result
        for name in path:
            inner = inner.setdefault(name, {})
        inner[last] = value
    return result


def like(flags: Tensor, x: Tensor) -> Tensor:
    """Flags (n) or (n, 1) that broadcast to a tensor (n, ...)."""
    return flags.reshape(-1, *(1 for _ in x.shape[1:]))


def looks_are_free(device: torch.device) -> bool:
    """Whether reading values on the device needs no synchronisation."""
    return device.type == "cpu"
