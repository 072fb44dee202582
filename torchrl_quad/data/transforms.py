"""Fly under transforms as fast as without: what they do to a policy's inputs and actions, and to a whole horizon."""

from __future__ import annotations

import copy
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor
from torch.func import vjp
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs import transforms as T

from torchrl_quad.data.normalizer import ObservationNormalizer
from torchrl_quad.data.unwrap import base_env, check_actor, check_env, leaf, memory_keys, observed
from torchrl_quad.data.values import (
    COUNTERS,
    ELEMENTWISE,
    OF_KEYS,
    OF_REWARDS,
    Followed,
    Known,
    Value,
    elementwise,
    follow,
    inverse,
    written_by,
)
from torchrl_quad.engine.packing import looks_are_free
from torchrl_quad.engine.policy import ENDS
from torchrl_quad.errors import UserValueError

OUTER = "action_of_policy"  # before the transforms, where these change it on its way to the environment


class Flown(NamedTuple):
    """An environment under transforms with which a policy flies as it does in the environment inside."""

    transforms: list[Transform]
    known: Known
    policy: TensorDictModuleBase
    memory: dict[Any, Value] = {}  # what transforms remember, as far as it is used; see :class:`Followed`

    def fly(self, env: EnvBase, actor: TensorDictModuleBase, start: TensorDictBase, horizon: int) -> Any:
        """The rollout as TorchRL's own loop writes it; None if ``start`` lacks what is counted or read."""
        counted = [key for t in self.transforms if isinstance(t, COUNTERS) for key in written_by(t)]
        read = [key for key in map(unravel_key, actor.in_keys) if key in self.known]
        if any(key not in start for key in (*counted, *read)):
            return None
        options: dict[str, Any] = {"auto_reset": False, "break_when_any_done": False}
        begin = self.start(env, start)
        if any(key not in begin for key in self.memory):
            return None
        root = base_env(env).rollout(horizon, self.policy, tensordict=begin, **options)
        after = cast(TensorDictBase, root.pop("next"))
        remembered = {key: (root.pop(key), after.pop(key))[1] for key in self.memory}
        done, ends = leaf(after, "done"), root.pop(ENDS, None)
        done = done if ends is None else done | (ends > 0)
        own = {*map(unravel_key, self.policy.out_keys), "is_init"}
        written = {key: root.pop(key) for key in own if key in root}
        memory = {key: after.pop(key) for key in ("is_init", *memory_keys(actor)) if key in after}
        if remembered and not memory_keys(actor):
            del written["is_init"], memory["is_init"]
        frames = iter(x for key, x in remembered.items() if self.memory[key].kind == "frames")
        for transform in self.transforms:
            if isinstance(transform, COUNTERS):
                _count(transform, root, after, start, done)
            elif isinstance(transform, T.CatFrames):
                for a, b in zip(transform.in_keys, transform.out_keys, strict=True):
                    new, before = leaf(after, a), next(frames)
                    size = new.shape[transform.dim]
                    old = before.narrow(transform.dim, size, before.shape[transform.dim] - size)
                    root.set(b, before)
                    after.set(b, torch.cat((old, new), transform.dim))
                    setattr(transform, f"_cat_buffers_{a}", leaf(after, b)[:, -1].detach().clone())
            elif not isinstance(transform, T.TensorDictPrimer):
                root, after = transform._reset(start, root), transform._call(after)
        for key, value in self.known.items():  # the first step is that of the start
            if key in start and value != Value("entry", key) and key in root:
                root.set(key, torch.cat((leaf(start, key).unsqueeze(1), leaf(root, key)[:, 1:]), 1))
        if OUTER in written:
            written[cast(Any, env).action_key] = (written.pop("action"), written.pop(OUTER))[1]
        return root.update(written).set("next", after.update(memory))

    def start(self, env: EnvBase, start: TensorDictBase) -> TensorDictBase:
        """What the environment inside would have written where ``start`` stands."""
        base, entries = cast(Any, base_env(env)), start
        if any(unravel_key(key) in self.known for t in self.transforms for key in t.in_keys_inv or ()):
            entries = start.copy().set(cast(Any, env).action_key, cast(Any, env).action_spec.zero())
            while isinstance(env, TransformedEnv):
                env, entries = env.base_env, env.transform.inv(entries)
        spec = dict(observed(base).items(True, True)) | {key: base.full_done_spec[key] for key in base.done_keys}
        given = cast(dict[Any, Tensor], dict(start.items(True, True)))
        found = {key: leaf(entries, key) for key in map(unravel_key, base.state_keys)}
        wanted = {*spec, *self.memory}
        values = [(key, value) for key, value in self.known.items() if value is not None and key in given]
        # What is there as it was comes first, and what is clipped last.
        values.sort(key=lambda pair: (pair[1].kind != "entry", pair[1].holds("clip")))
        for key, value in values:
            if not wanted.isdisjoint(value.sources()):
                value.undo(given[key], found, spec)
        if not spec.keys() <= found.keys():  # a transform leaves some out
            again = base.reset(entries.select("state"), set_state=True)
            found |= {key: leaf(again, key) for key in spec.keys() - found.keys()}
        own = {unravel_key(key) for key in (*self.policy.in_keys, *self.policy.out_keys)}
        kept = start.select(*(key for key in own if key not in found and key != "action"), strict=False)
        found = {key: x for key, x in found.items() if key in {*spec, *own}}
        return TensorDict(cast(Any, found), start.batch_size, start.device).update(kept)


class PolicyUnder(TensorDictModuleBase):
    """A policy under transforms, as one of the environment inside.

    Args:
        policy: reads and writes what is outside.
        reads: how each entry that it reads follows from those inside.
        action: how the action inside follows from what it writes.
        writes: what is written besides, of the entries inside.
        memory: the shape, apart from n, of what it reads as it was written in the step before.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        reads: dict[Any, Value],
        action: Value,
        writes: Mapping[Any, Value] = types.MappingProxyType({}),
        memory: Mapping[Any, tuple[int, ...]] = types.MappingProxyType({}),
    ) -> None:
        passed = [key for key in policy.in_keys if unravel_key(key) not in reads]
        of_values = [key for x in (*reads.values(), *writes.values()) for key in x.sources()]
        self.in_keys = [*dict.fromkeys([*of_values, *passed])]
        changes = action != Value("entry", "action")
        self.own = action.sources()[0]  # the key under which the policy writes its action
        self.out_keys = [OUTER if changes and unravel_key(key) == self.own else key for key in policy.out_keys]
        self.out_keys += [*(["action"] if changes else []), *writes]
        super().__init__()
        self.policy, self.reads, self.action, self.changes = policy, reads, action, changes
        self.writes, self.transform_memory = writes, memory

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the policy writes, and the action inside; all else stays as it is."""
        read = tensordict.copy()
        for key, value in self.reads.items():
            if all(name in tensordict for name in value.sources()):  # otherwise the policy complains
                read.set(key, value.compute({name: leaf(tensordict, name) for name in value.sources()}))
        written = self.policy(read).select(*self.policy.out_keys, strict=False)
        if self.changes:
            outer = leaf(written, self.own)
            written = written.exclude(self.own).set(OUTER, outer).set("action", self.action.compute({self.own: outer}))
        for key, value in self.writes.items():
            written.set(key, value.compute({name: leaf(tensordict, name) for name in value.sources()}))
        return tensordict.update(written)

    def plain(self) -> Any:
        """The same on plain tensors, if the policy has such a form."""
        make = getattr(self.policy, "plain", None)
        inner = make() if callable(make) else None
        if not hasattr(inner, "weight_gradient"):  # nothing, or actions that are given
            return None if self.changes or self.writes else inner
        return _PlainUnder(inner, self)


def normalized(policy: TensorDictModuleBase, normalizer: ObservationNormalizer) -> PolicyUnder:
    """A policy of normalised observations, as one of observations that are not normalised yet."""
    (key,) = normalizer.in_keys
    own = {key: elementwise(normalizer, Value("entry", key))} if key in policy.in_keys else {}
    return PolicyUnder(policy, own, Value("entry", "action"))


class _PlainUnder:
    """See the engine's ``PlainPolicy``."""

    def __init__(self, inner: Any, under: PolicyUnder) -> None:
        self.reads = [under.reads.get(unravel_key(key), Value("entry", unravel_key(key))) for key in inner.in_keys]
        self.writes = dict(under.writes)
        self.in_keys = [*dict.fromkeys(key for x in (*self.reads, *self.writes.values()) for key in x.sources())]
        self.action, self.own, self.size = under.action if under.changes else None, under.own, inner.size
        self.written = list(map(unravel_key, inner.out_keys))
        self.out_keys = [OUTER if self.action and key == self.own else key for key in self.written]
        self.out_keys += [*(["action"] if self.action else []), *self.writes]
        self.command = OUTER if self.action else "action"
        values = [*self.reads, *self.writes.values(), *([self.action] if self.action else [])]
        self.signature = (inner.signature, *map(str, (self.out_keys, *(value.describe() for value in values))))
        self.inner, self.count, self.memory = inner, len(inner.weights), {**inner.memory, **under.transform_memory}
        self.constants = tuple(x for value in values for x in value.tensors())

    @property
    def weights(self) -> tuple[Tensor, ...]:
        """What the policy learns, and the constants of the transforms."""
        return (*self.inner.weights, *self.constants)

    @weights.setter
    def weights(self, weights: tuple[Tensor, ...]) -> None:
        self.inner = copy.copy(self.inner)
        self.inner.weights, self.constants = weights[: self.count], weights[self.count :]

    @property
    def without_gradient(self) -> frozenset[Any]:
        """What the policy reads that is made of nothing but such entries, and of what was remembered of them."""
        return self.inner.without_gradient

    @without_gradient.setter
    def without_gradient(self, names: frozenset[Any]) -> None:
        free = {key for key in self.in_keys if (key if isinstance(key, str) else key[0]) in names}
        free |= self.memory.keys() - self.inner.memory.keys()
        pairs = zip(self.inner.in_keys, self.reads, strict=True)
        self.inner.without_gradient = frozenset(unravel_key(key) for key, x in pairs if free.issuperset(x.sources()))

    def fits(self, inputs: Sequence[Tensor]) -> bool:
        """Whether the policy can read what the transforms make of these."""
        return self.inner.fits(self._read(self.weights, [x[:1] for x in inputs])[: len(self.reads)])

    def drawn(self, steps: int, n: int, before: Mapping[Any, Tensor]) -> Tensor:
        """What the policy draws."""
        return self.inner.drawn(steps, n, before)

    def applied(self, action: Tensor) -> Tensor:
        """What the transforms make of an action of the policy."""
        return action if self.action is None else self.action.compute({self.own: action})

    def pull(self, kept: Sequence[Tensor], grad: Tensor) -> Tensor:
        """The gradient of the policy's action, from that of what the transforms make of it."""
        return vjp(self.applied, kept[-1])[1](grad)[0]

    def forward(
        self, weights: Sequence[Tensor], inputs: Sequence[Tensor], drawn: Tensor
    ) -> tuple[list[Tensor], dict[Any, Tensor]]:
        """What the policy keeps and writes."""
        constants = iter(weights[self.count :])
        read = self._read(weights, inputs, constants)
        kept, written = self.inner.forward(weights[: self.count], read[: len(self.reads)], drawn)
        more = dict(zip(self.writes, read[len(self.reads) :], strict=True))
        if self.action is None:
            return kept, {**written, **more}
        outer = written.pop(self.own)
        action = self.action.compute({self.own: outer}, constants)
        return [*kept, outer], {**written, OUTER: outer, "action": action, **more}

    def adjoint(
        self,
        weights: Sequence[Tensor],
        inputs: Sequence[Tensor],
        kept: Sequence[Tensor],
        drawn: Tensor,
        grads: dict[Any, Tensor],
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """The gradients through policy and transforms."""
        constants = iter(weights[self.count :])
        read, pull = vjp(lambda *x: tuple(self._read(weights, x, constants)), *inputs)[:2]
        own = {key: grads.get(key) for key in self.written}  # in the order in which the policy writes
        if self.action is not None:
            action, (*kept, outer) = self.action, kept
            (grad,) = vjp(lambda x: action.compute({self.own: x}, constants), outer)[1](grads["action"])
            own[self.own] = grads[OUTER] + grad
        traces, of_read, of_drawn = self.inner.adjoint(
            weights[: self.count], read[: len(self.reads)], kept, drawn, cast(Any, own)
        )
        of_written = [grads[key] for key in self.writes]
        return traces, list(pull((*of_read, *of_written))), of_drawn

    def weight_gradient(self, weights: Sequence[Tensor], traces: Sequence[Tensor]) -> list[Tensor]:
        """Those of the policy; constants have none."""
        return self.inner.weight_gradient(weights[: self.count], traces)

    def _read(
        self, weights: Sequence[Tensor], inputs: Sequence[Tensor], constants: Iterator[Tensor] | None = None
    ) -> list[Tensor]:
        """What the policy reads, and what is written besides; it takes their constants."""
        entries = dict(zip(self.in_keys, inputs, strict=True))
        constants = iter(weights[self.count :]) if constants is None else constants
        read = [value.compute(entries, constants) for value in (*self.reads, *self.writes.values())]
        numbers = next(x.dtype for x in inputs if x.is_floating_point())  # networks join counters with these
        return [x if x.is_floating_point() else x.to(numbers) for x in read]


def transforms_of(env: EnvBase) -> list[Transform]:
    """All transforms of an environment, the innermost first."""
    transforms: list[Transform] = []
    while isinstance(env, TransformedEnv):
        transforms = [*_parts(env.transform), *transforms]
        env = env.base_env
    return transforms


def check_statistics(env: EnvBase) -> None:
    """Raise a UserValueError for statistics that change at each step, which breaks ``backward``."""
    for transform in transforms_of(env):
        if isinstance(transform, T.VecNorm | T.VecNormV2) and not getattr(transform, "frozen", False):
            raise UserValueError(
                f"{type(transform).__name__} changes its statistics in place at each step, and a graph through several "
                "steps needs those of before. Take torchrl_quad.ObservationNormalizer(env), whose statistics are fixed "
                "within a horizon: call its update(rollout) between horizons."
            )


class FlightMode(NamedTuple):
    """How a policy flies, and why not faster."""

    mode: Literal["inside", "called", "loop"]  #: see :func:`flight_mode`
    reason: str  #: what prevents the next faster mode; empty for the fastest


def flight_mode(env: EnvBase, actor: TensorDictModuleBase) -> FlightMode:
    """How :func:`differentiable_rollout` flies a policy in an environment, under transforms or without.

    ``"inside"`` the compiled step, which is fastest; ``"called"`` before each step of the engine; or in TorchRL's own
    ``"loop"``. The numbers are the same. ``reason`` names the transform or the entry that prevents the next faster
    way; it is empty for ``"inside"``.
    """
    check_env(env)
    check_actor(actor, "actor")
    flown = under_transforms(env, actor)
    if isinstance(flown, str):
        return FlightMode("loop", flown)
    base: Any = base_env(env)
    if base.flies_inside(flown.policy):
        return FlightMode("inside", "")
    if not base.is_compiled:
        return FlightMode("called", "the environment is not compiled: build it with compile=True")
    return FlightMode("called", f"{type(actor).__name__} has no form on plain tensors: build it by make_actor")


def under_transforms(env: EnvBase, actor: TensorDictModuleBase) -> Flown | str:
    """How a policy flies under the transforms of an environment as it does in the one inside, or why it cannot."""
    base, transforms = base_env(env), transforms_of(env)
    if not hasattr(type(base), "flies_inside"):
        return f"{type(base).__name__} has only TorchRL's own loop"
    memory = {unravel_key(key) for key in memory_keys(actor)}
    inside = (*observed(base).keys(True, True), *cast(Any, base).done_keys)
    followed = Followed.begin(map(unravel_key, inside))
    known, remembered = followed.known, followed.memory
    for transform in transforms:
        name, kind = type(transform).__name__, type(transform)
        if (
            kind is T.TensorDictPrimer
            and {unravel_key(key) for key in cast(Any, transform.primers).keys(True, True)} <= memory
        ):
            continue
        if kind not in (*ELEMENTWISE, *OF_REWARDS, *COUNTERS, *OF_KEYS, T.CatFrames):
            return f"{name} is none of the transforms that are pure functions of entries"
        try:
            follow(transform, followed)
        except (NotImplementedError, KeyError, RuntimeError) as error:
            return f"{name}: {error}"
    counted = (key for x in transforms if isinstance(x, COUNTERS) for key in written_by(x))
    if lost := [key for key in counted if key not in known]:
        return f"{lost[0]!r} is counted in a step, and a later transform drops it before the next: keep it there"
    reads = {}
    for key in map(unravel_key, actor.in_keys):
        if key in memory or (memory and key == "is_init") or key in map(unravel_key, actor.out_keys):
            continue
        value = known.get(key)
        if value is None:
            return f"the policy reads {key!r}, which " + ("is counted outside" if key in known else "nobody writes")
        reads[key] = value
    actions: Known = {unravel_key(key): Value("entry", unravel_key(key)) for key in actor.out_keys}
    for transform in reversed(transforms):
        pairs = zip(transform.in_keys_inv or (), transform.out_keys_inv or (), strict=True)
        for inner, outer in ((unravel_key(a), unravel_key(b)) for a, b in pairs):
            if outer in actions:
                x = cast(Value, actions.pop(outer) if type(transform) is T.RenameTransform else actions[outer])
                actions[inner] = inverse(transform, x)
    if (action := actions.get("action")) is None or action.sources()[0] not in map(unravel_key, actor.out_keys):
        return "the policy writes no action that the transforms pass on"
    writes, used = {}, {key for x in reads.values() for key in x.sources()}
    if limits := followed.limits:
        writes[ENDS] = Value("limit", tuple(limits.values()), tuple(Value("entry", key) for key in limits))
    used |= {*limits, *(key for key, x in remembered.items() if x.kind == "frames")}
    for key in reversed(remembered):  # each is made of earlier ones
        used |= {*remembered[key].sources()} if key in used else set()
    remembered = {key: x for key, x in remembered.items() if key in used}
    writes |= {("next", key): x for key, x in remembered.items()}
    if not writes and action == Value("entry", "action") and all(x == Value("entry", key) for key, x in reads.items()):
        return Flown(transforms, known, actor)
    spec = dict(observed(base).items(True, True)) if remembered else {}
    sizes = {key: tuple(x.shape(spec)) for key, x in remembered.items()}
    return Flown(transforms, known, PolicyUnder(actor, reads, action, writes, sizes), remembered)


def _parts(transform: Transform) -> list[Transform]:
    return [x for part in transform for x in _parts(part)] if isinstance(transform, T.Compose) else [transform]


def _count(transform: Any, root: TensorDictBase, after: TensorDictBase, start: TensorDictBase, done: Tensor) -> None:
    """Write what a counter has at both ends of each step of a horizon, which began at ``start``; done is (n, T, 1)."""
    begun = torch.cat((torch.zeros_like(done[:, :1]), done[:, :-1]), 1)  # an episode at this step
    steps = torch.arange(done.shape[1], device=done.device).unsqueeze(-1)
    first = torch.where(begun, steps, -1).cummax(1).values  # step of the present episode; -1 where it began before
    for i, key in enumerate(written_by(transform)):
        if isinstance(transform, T.RewardSum | T.TargetReturn):
            is_sum = isinstance(transform, T.RewardSum)
            value, roots, ends = leaf(start, key), [], []
            anew = 0.0 if is_sum else cast(float, transform.target_return)
            some = begun.any(0).flatten().tolist() if looks_are_free(done.device) else [True] * done.shape[1]
            for reward, who, any_of in zip(
                leaf(after, transform.in_keys[i]).unbind(1), begun.unbind(1), some, strict=True
            ):
                value = torch.where(who, anew, value) if any_of else value
                roots.append(value)
                value = value + reward if is_sum else value - reward if transform.mode == "reduce" else value
                ends.append(value)
            root.set(key, torch.stack(roots, 1))
            after.set(key, torch.stack(ends, 1))
        elif isinstance(transform, T.StepCounter):
            root.set(key, torch.where(first < 0, leaf(start, key).unsqueeze(1) + steps, steps - first))
            after.set(key, leaf(root, key) + 1)
            if transform.max_steps is not None:
                ends = leaf(after, key) >= transform.max_steps
                after.update({name: leaf(after, name) | ends for name in ("truncated", "done")})
        elif isinstance(transform, T.InitTracker):
            root.set(key, torch.cat((leaf(start, key).unsqueeze(1), begun[:, 1:]), 1))
            after.set(key, torch.zeros_like(done))
        else:
            flown = begun.transpose(0, 1).flatten().cumsum(0).view(begun.shape[1], -1, 1).transpose(0, 1)
            with transform._traj_count:
                fresh = transform._traj_count.value + flown - 1
                transform._traj_count.value += int(flown[-1, -1])
            count = torch.where(first < 0, leaf(start, key).unsqueeze(1), fresh.gather(1, first.clamp_min(0)))
            root.set(key, count)
            after.set(key, count.clone())
