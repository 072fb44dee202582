"""How entries follow from those of the environment inside, under transforms that are pure functions of entries."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs import transforms as T

from torchrl_quad.data.normalizer import ObservationNormalizer
from torchrl_quad.engine.packing import like

OF_NUMBERS = (T.ClipTransform, T.DTypeCastTransform, T.DoubleToFloat, T.ActionScaling)
ELEMENTWISE = (T.ObservationNorm, ObservationNormalizer, *OF_NUMBERS)
OF_REWARDS = (T.RewardScaling, T.RewardClipping)
COUNTERS = (T.RewardSum, T.TargetReturn, T.StepCounter, T.InitTracker, T.TrajCounter)
OF_KEYS = (T.CatTensors, T.RenameTransform, T.SelectTransform, T.ExcludeTransform)


class Value(NamedTuple):
    """How an entry follows from those of the environment inside."""

    kind: str  # entry, normalize, scale, clip, cast, cat, frames, sum or limit
    about: Any  # the key of an entry, the type or the dimension; of frames also their number and what they begin with
    parts: tuple[Value, ...] = ()
    constants: tuple[Tensor | float | None, ...] = ()

    def compute(self, entries: Mapping[Any, Tensor], given: Iterator[Tensor] | None = None) -> Tensor:
        """The value (*, k) from entries (*, ...); with ``given`` instead of the constants, in the same order."""
        if self.kind == "entry":
            return entries[self.about]
        x, *more = (part.compute(entries, given) for part in self.parts)
        own = [next(given) if given is not None and isinstance(c, Tensor) else c for c in self.constants]
        a, b = cast(Any, own or (None, None))
        if self.kind == "normalize":
            return (x - a) / b
        if self.kind == "scale":
            return x * b + a
        if self.kind == "clip":
            return x.clamp(a, b)
        if self.kind == "limit":
            ends = [y + 1 >= most for y, most in zip((x, *more), self.about, strict=True)]
            return torch.cat(ends, -1).any(-1, keepdim=True).to(x.dtype)
        if self.kind == "sum":
            return torch.where(more[1] > 0, x.to(more[0].dtype) + b * more[0], a)
        if self.kind == "frames":
            (dim, count, padding), (before, flown) = self.about, more
            size = x.shape[dim]
            first = [x if padding is None else torch.full_like(x, padding)] * (count - 1)
            later = before.narrow(dim, size, (count - 1) * size).to(x.dtype)
            return torch.where(like(flown, x) > 0, torch.cat((later, x), dim), torch.cat((*first, x), dim))
        return x.to(self.about) if self.kind == "cast" else torch.cat([x, *more], self.about)

    def undo(self, x: Tensor, found: dict[Any, Tensor], spec: Mapping[Any, Any]) -> None:
        """Add the entries from which the value is ``x``, unless they are found already; where it is clipped, ``x``."""
        a, b = cast(Any, self.constants or (None, None))
        if self.kind == "entry":
            found.setdefault(self.about, x.to(spec.get(self.about, spec["observation"]).dtype))
        elif self.kind == "cat":
            sizes = [part.shape(spec)[self.about] for part in self.parts]
            for part, own in zip(self.parts, x.split(sizes, self.about), strict=True):
                part.undo(own, found, spec)
        elif self.kind == "frames":
            dim, size = self.about[0], x.shape[self.about[0]] // self.about[1]
            self.parts[0].undo(x.narrow(dim, -size, size), found, spec)
            found[self.parts[1].about] = x.roll(size, dim)
            found[FLOWN] = torch.ones_like(found["done"], dtype=spec["observation"].dtype)
        elif self.kind == "sum":
            found[FLOWN] = torch.ones_like(found["done"], dtype=spec["observation"].dtype)
            found["reward"] = torch.zeros_like(found[FLOWN])  # none since
            self.parts[0].undo(x - b * self.parts[1].compute(found), found, spec)
        else:
            x = x if x.is_floating_point() else x.to(spec["observation"].dtype)
            x = x * b + a if self.kind == "normalize" else (x - a) / b if self.kind == "scale" else x
            self.parts[0].undo(x, found, spec)

    def shape(self, spec: Mapping[Any, Any]) -> list[int]:
        """Its shape, apart from n."""
        if not self.parts:
            return list(spec[self.about].shape[1:]) if self.about in spec else [1]
        shape = self.parts[0].shape(spec)
        if self.kind == "frames":
            shape[self.about[0]] *= self.about[1]
        if self.kind == "cat":
            shape[self.about] = sum(part.shape(spec)[self.about] for part in self.parts)
        return shape

    def sources(self) -> list[Any]:
        """The entries of the environment that it reads."""
        return [self.about] if self.kind == "entry" else [key for part in self.parts for key in part.sources()]

    def holds(self, kind: str) -> bool:
        """Whether a value of this kind is in it."""
        return self.kind == kind or any(part.holds(kind) for part in self.parts)

    def clips_alike(self) -> bool:
        """Whether clipped frames are those of before, clipped: none lie in others, or are scaled by their places."""
        if self.kind == "frames":
            return not self.parts[0].holds("frames")
        by_place = any(isinstance(x, Tensor) and x.numel() > 1 for x in self.constants) and self.holds("frames")
        return not by_place and all(part.clips_alike() for part in self.parts)

    def tensors(self) -> list[Tensor]:
        """All constants, in the order in which :meth:`compute` takes them."""
        own = [x for x in self.constants if isinstance(x, Tensor)]
        return [x for part in self.parts for x in part.tensors()] + own

    def describe(self) -> tuple[Any, ...]:
        """What it computes, apart from the numbers."""
        shapes = tuple(x.shape if isinstance(x, Tensor) else x for x in self.constants)
        return self.kind, self.about, shapes, *(part.describe() for part in self.parts)


Known = dict[Any, Value | None]  # by key; None for what is known only after the flight, such as a trajectory's number

FLOWN = "_flown"  # what is remembered of an episode that is under way: 1, and in its first step 0


class Followed(NamedTuple):
    """What is known of entries under transforms."""

    known: Known
    rewards: Known  # those of the step before
    memory: dict[Any, Value]  # by name, what it is in the next step; an episode begins with zeros
    limits: dict[Any, int]  # of steps, by the name under which they are remembered

    @classmethod
    def begin(cls, keys: Iterable[Any]) -> Followed:
        """Without transforms."""
        flown = Value("scale", None, (Value("entry", FLOWN),), (1.0, 0.0))
        return cls({key: Value("entry", key) for key in keys}, {"reward": Value("entry", "reward")}, {FLOWN: flown}, {})

    def evolve(self, transform: Any) -> Value | None:
        """What a counter writes, as it evolves along a horizon."""
        own, reward = Value("entry", f"_{len(self.memory)}"), self.rewards.get((transform.in_keys or [None])[0])
        if isinstance(transform, T.StepCounter | T.InitTracker):
            counts = isinstance(transform, T.StepCounter)
            self.memory[own.about] = Value("scale", None, (own,), (1.0, float(counts)))
            if (most := getattr(transform, "max_steps", None)) is not None:
                self.limits[own.about] = cast(int, most)
            is_init = Value("scale", None, (own,), (1.0, -1.0))
            return Value("cast", torch.int64, (own,)) if counts else Value("cast", torch.bool, (is_init,))
        if reward is None or len(transform.in_keys) > 1 or not isinstance(transform, T.RewardSum | T.TargetReturn):
            return None
        first, sign = 0.0, 1.0
        if isinstance(transform, T.TargetReturn):
            first, sign = float(transform.target_return), -1.0 if transform.mode == "reduce" else 0.0
        self.memory[own.about] = value = Value("sum", None, (own, reward, Value("entry", FLOWN)), (first, sign))
        return value


def follow(transform: Any, followed: Followed) -> None:
    """What the entries that a transform reads and writes are made of, after it."""
    known, rewards = followed.known, followed.rewards
    ins, outs = list(map(unravel_key, transform.in_keys or ())), written_by(transform)
    if isinstance(transform, OF_REWARDS):
        if set(known) & {*ins, *outs}:
            raise NotImplementedError("a reset leaves what it writes as it was, which is followed for rewards alone")
        rewards |= {b: elementwise(transform, cast(Value, rewards[a])) for a, b in zip(ins, outs, strict=True)}
    elif isinstance(transform, COUNTERS):
        if isinstance(transform, T.StepCounter) and (twice := [key for key in outs if key in known]):
            raise NotImplementedError(f"{twice[0]!r} is written before, by another transform: use another key")
        known.update(dict.fromkeys(outs, followed.evolve(transform)))
        if getattr(transform, "max_steps", None) is not None:
            ours = (transform.truncated_key, transform.update_done) == ("truncated", True)
            if not ours or any(known.get(key) != Value("entry", key) for key in ("done", "truncated")):
                raise NotImplementedError("max_steps is followed where it writes done and truncated")
    elif isinstance(transform, T.CatFrames):
        padding = None if transform.padding == "same" else float(transform.padding_value)
        for a, b in zip(ins, outs, strict=True):
            if (x := known[a]) is None or transform.reset_key != "_reset":
                raise NotImplementedError("frames are followed of what a step writes, with the reset_key of all")
            own = Value("entry", f"_{len(followed.memory)}")
            value = Value("frames", (transform.dim, transform.N, padding), (x, own, Value("entry", FLOWN)))
            known[b] = followed.memory[own.about] = value
    elif isinstance(transform, T.ExcludeTransform):
        if transform.inverse:
            raise NotImplementedError("inverse=True is left to TorchRL")
        _keep(known, lambda key: not _below(key, transform.excluded_keys))
    elif isinstance(transform, T.SelectTransform):
        parent = cast(Any, transform.parent)
        kept = [*transform.selected_keys, *parent.state_spec.keys(True, True), *parent.done_keys]
        _keep(known, lambda key: _below(key, kept))
        for key in (key for key, x in known.items() if x != Value("entry", key)):
            if not _below(key, transform.selected_keys):
                raise NotImplementedError(f"it keeps {key!r} in a step, and drops it before the next: select it, too")
    elif isinstance(transform, T.RenameTransform):
        for a, b in zip(ins, outs, strict=True):
            known[b] = known[a] if transform.create_copy else known.pop(a)
    elif isinstance(transform, T.CatTensors):
        if transform.dim >= 0 or transform.unsqueeze_if_oor or not transform._initialized:
            raise NotImplementedError("only in_keys that are named, and a negative dim, mean the same in a horizon")
        parts = tuple(cast(Value, known[key]) for key in ins)
        known[outs[0]] = None if None in parts else Value("cat", transform.dim, parts)
        _keep(known, lambda key: not transform._del_keys or key not in ins or key == outs[0])
    elif not isinstance(transform, T.ActionScaling):
        for a, b in zip(ins, outs, strict=True):
            for entries in (known, rewards):
                if a in entries:
                    entries[b] = None if (x := entries[a]) is None else elementwise(transform, x)


def written_by(transform: Any) -> list[Any]:
    """The entries that a transform writes."""
    keys = transform.step_count_keys if isinstance(transform, T.StepCounter) else transform.out_keys
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
    if isinstance(transform, T.ObservationNorm | T.RewardScaling):
        if not getattr(transform, "initialized", True) or max(transform.loc.ndim, transform.scale.ndim) > 1:
            raise NotImplementedError("statistics are vectors, or numbers; call init_stats")
        kind = "normalize" if transform.standard_normal else "scale"
        return Value(kind, None, (x,), (transform.loc, transform.scale))
    if isinstance(transform, T.RewardClipping):
        return Value("clip", None, (x,), (transform.clamp_min, transform.clamp_max))
    if isinstance(transform, T.ClipTransform):
        clipped = Value("clip", None, (x,), (transform.low, transform.high))
        if not clipped.clips_alike():
            raise NotImplementedError("it clips frames of frames, or frames that are scaled by their places")
        return clipped
    return Value("cast", transform.dtype_out, (x,))


def inverse(transform: Any, x: Value) -> Value:
    """What a transform makes of an action on its way to the environment."""
    if isinstance(transform, T.RenameTransform):
        return x
    if isinstance(transform, T.ClipTransform):
        return Value("clip", None, (x,), (transform.low, transform.high))
    if isinstance(transform, T.DTypeCastTransform):
        return Value("cast", transform.dtype_in, (x,))
    if isinstance(transform, T.ActionScaling):
        transform._ensure_initialized()
        loc, scale = transform.loc, transform.scale
        return Value("scale", None, (x,), (loc, scale) if transform.standard_normal else (loc - scale, 2.0 * scale))
    kind = "scale" if transform.standard_normal else "normalize"
    return Value(kind, None, (x,), (transform.loc, transform.scale))
