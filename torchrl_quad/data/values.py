"""How entries follow from those of the environment inside, under transforms that are pure functions of entries."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs import (
    ActionScaling,
    CatTensors,
    ClipTransform,
    DoubleToFloat,
    DTypeCastTransform,
    ExcludeTransform,
    InitTracker,
    ObservationNorm,
    RenameTransform,
    RewardClipping,
    RewardScaling,
    RewardSum,
    SelectTransform,
    StepCounter,
    TargetReturn,
    TrajCounter,
)

from torchrl_quad.data.normalizer import ObservationNormalizer

ELEMENTWISE = (ObservationNorm, ObservationNormalizer, ClipTransform, DTypeCastTransform, DoubleToFloat, ActionScaling)
OF_REWARDS = (RewardScaling, RewardClipping)
COUNTERS = (RewardSum, TargetReturn, StepCounter, InitTracker, TrajCounter)
OF_KEYS = (CatTensors, RenameTransform, SelectTransform, ExcludeTransform)


class Value(NamedTuple):
    """How an entry follows from those of the environment inside."""

    kind: str  # entry, normalize, scale, clip, cast or cat
    about: Any  # the key of an entry, the type or the dimension
    parts: tuple[Value, ...] = ()
    constants: tuple[Tensor | None, ...] = ()

    def compute(self, entries: Mapping[Any, Tensor], given: Iterator[Tensor] | None = None) -> Tensor:
        """The value (*, k) from entries (*, ...); with ``given`` instead of the constants, in the same order."""
        if self.kind == "entry":
            return entries[self.about]
        x, *more = (part.compute(entries, given) for part in self.parts)
        a, b = cast(Any, [c if c is None or given is None else next(given) for c in self.constants or (None, None)])
        if self.kind == "normalize":
            return (x - a) / b
        if self.kind == "scale":
            return x * b + a
        if self.kind == "clip":
            return x.clamp(a, b)
        return x.to(self.about) if self.kind == "cast" else torch.cat([x, *more], self.about)

    def undo(self, x: Tensor, found: dict[Any, Tensor], spec: Mapping[Any, Any]) -> None:
        """Add the entries from which the value is ``x``, unless they are found already; where it is clipped, ``x``."""
        a, b = cast(Any, self.constants or (None, None))
        if self.kind == "entry":
            found.setdefault(self.about, x.to(spec[self.about].dtype))
        elif self.kind == "cat":
            sizes = [part.size(spec, self.about) for part in self.parts]
            for part, own in zip(self.parts, x.split(sizes, self.about), strict=True):
                part.undo(own, found, spec)
        else:
            x = x * b + a if self.kind == "normalize" else (x - a) / b if self.kind == "scale" else x
            self.parts[0].undo(x, found, spec)

    def size(self, spec: Mapping[Any, Any], dim: int) -> int:
        """The size in a dimension."""
        return sum(part.size(spec, dim) for part in self.parts) if self.parts else spec[self.about].shape[dim]

    def sources(self) -> list[Any]:
        """The entries of the environment that it reads."""
        return [self.about] if self.kind == "entry" else [key for part in self.parts for key in part.sources()]

    def tensors(self) -> list[Tensor]:
        """All constants, in the order in which :meth:`compute` takes them."""
        return [x for part in self.parts for x in part.tensors()] + [x for x in self.constants if x is not None]

    def describe(self) -> tuple[Any, ...]:
        """What it computes, apart from the numbers."""
        shapes = tuple(None if x is None else x.shape for x in self.constants)
        return self.kind, self.about, shapes, *(part.describe() for part in self.parts)


Known = dict[Any, Value | None]  # by key; None for what is known only after the flight, such as counters


def follow(transform: Any, known: Known) -> None:
    """What the entries that a transform reads and writes are made of, after it."""
    ins, outs = list(map(unravel_key, transform.in_keys or ())), written_by(transform)
    if isinstance(transform, OF_REWARDS):
        if set(known) & {*ins, *outs}:
            raise NotImplementedError("a reset leaves what it writes as it was, which is followed for rewards alone")
    elif isinstance(transform, COUNTERS):
        known.update(dict.fromkeys(outs))
    elif isinstance(transform, ExcludeTransform):
        if transform.inverse:
            raise NotImplementedError("inverse=True is left to TorchRL")
        _keep(known, lambda key: not _below(key, transform.excluded_keys))
    elif isinstance(transform, SelectTransform):
        parent = cast(Any, transform.parent)
        kept = [*transform.selected_keys, *parent.state_spec.keys(True, True), *parent.done_keys]
        _keep(known, lambda key: _below(key, kept))
    elif isinstance(transform, RenameTransform):
        for a, b in zip(ins, outs, strict=True):
            known[b] = known[a] if transform.create_copy else known.pop(a)
    elif isinstance(transform, CatTensors):
        if transform.dim >= 0 or transform.unsqueeze_if_oor or not transform._initialized:
            raise NotImplementedError("only in_keys that are named, and a negative dim, mean the same in a horizon")
        parts = tuple(cast(Value, known[key]) for key in ins)
        known[outs[0]] = None if None in parts else Value("cat", transform.dim, parts)
        _keep(known, lambda key: not transform._del_keys or key not in ins or key == outs[0])
    elif not isinstance(transform, ActionScaling):
        for a, b in zip(ins, outs, strict=True):
            if a in known:
                known[b] = None if (x := known[a]) is None else elementwise(transform, x)


def written_by(transform: Any) -> list[Any]:
    """The entries that a transform writes."""
    keys = transform.step_count_keys if isinstance(transform, StepCounter) else transform.out_keys
    return list(map(unravel_key, keys or ()))


def _keep(known: Known, wanted: Any) -> None:
    for key in [key for key in known if not wanted(key)]:
        del known[key]


def _below(key: Any, groups: Sequence[NestedKey]) -> bool:
    """Whether an entry is one of some, or in a group of them."""
    path = key if isinstance(key, tuple) else (key,)
    return any(path[: len(g)] == g for g in ((x,) if isinstance(x, str) else x for x in map(unravel_key, groups)))


def elementwise(transform: Any, x: Value) -> Value:
    """What a transform makes of an entry."""
    if isinstance(transform, ObservationNorm):
        if not transform.initialized or max(transform.loc.ndim, transform.scale.ndim) > 1:
            raise NotImplementedError("statistics are vectors, or numbers; call init_stats")
        kind = "normalize" if transform.standard_normal else "scale"
        return Value(kind, None, (x,), (transform.loc, transform.scale))
    if isinstance(transform, ClipTransform):
        return Value("clip", None, (x,), (transform.low, transform.high))
    return Value("cast", transform.dtype_out, (x,))


def inverse(transform: Any, x: Value) -> Value:
    """What a transform makes of an action on its way to the environment."""
    if isinstance(transform, RenameTransform):
        return x
    if isinstance(transform, ClipTransform):
        return Value("clip", None, (x,), (transform.low, transform.high))
    if isinstance(transform, DTypeCastTransform):
        return Value("cast", transform.dtype_in, (x,))
    if isinstance(transform, ActionScaling):
        transform._ensure_initialized()
        loc, scale = transform.loc, transform.scale
        return Value("scale", None, (x,), (loc, scale) if transform.standard_normal else (loc - scale, 2.0 * scale))
    kind = "scale" if transform.standard_normal else "normalize"
    return Value(kind, None, (x,), (transform.loc, transform.scale))
