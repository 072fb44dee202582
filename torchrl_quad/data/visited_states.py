"""Where the next horizon starts: in visited states (paper, section IV), fresh starts, or where the last one ended."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase

from torchrl_quad.data.unwrap import (
    base_env,
    check_actor,
    check_env,
    check_tensordict,
    group,
    leaf,
    memory_keys,
    observed,
    state_keys,
)
from torchrl_quad.errors import UserTypeError, UserValueError, WrongState, one_line
from torchrl_quad.options import Device, Entries, Fraction, Seed, Size, checked

Kinds = dict[NestedKey, tuple[torch.Size, bool]]  # of the entries of one state: shape, and whether these are floats


@checked
class VisitedStateBuffer(TensorDictReplayBuffer):
    """States that the policy has visited, from which horizons and episodes can start.

    A state is the complete Markov state, including commands on their way and whatever the task keeps, detached from any
    graph. ``state_dict`` and ``dumps(path)`` save the states and the random generator, which draws them and decides
    which environments get one.

    Args:
        capacity: visited states kept; the oldest go first.
        env: the environment whose Markov state is kept; see :mod:`torchrl_quad.data`.
        state_keys: the entries that make up the Markov state. By default those of ``env``, and "state" without one.
        actor: a recurrent policy, whose memory is kept with the state, but for :meth:`source`.
        device: where the states are stored.
        seed: of the buffer's own random generator.
    """

    def __init__(
        self,
        capacity: Size = 100_000,
        env: EnvBase | None = None,
        *,
        state_keys: Entries | None = None,
        actor: TensorDictModuleBase | None = None,
        device: Device = "cpu",
        seed: Seed = 0,
    ) -> None:
        if env is not None:
            check_env(env)
        if actor is not None:
            check_actor(actor, "actor")
        generator = torch.Generator(device=device).manual_seed(seed)
        self.state_keys = tuple(state_keys or (("state",) if env is None else _state_keys(env)))
        self.memory_keys = () if actor is None else memory_keys(actor)
        self.names = (*self.state_keys, *self.memory_keys)
        known: Any = TensorDict() if env is None else observed(env).zero().reshape(-1)
        # Of each part of a state, as far as it is known.
        self.kinds: dict[NestedKey, Kinds] = {name: _kinds(known, name) for name in self.names if name in known}
        super().__init__(storage=LazyTensorStorage(capacity, device=device), generator=generator)

    def extend(self, tensordicts: TensorDictBase) -> Tensor:
        """Add the states in which the steps of a rollout (any batch size) started, and return the indices written.

        Terminated states and states that are not finite are left out.
        """
        check_tensordict("The visited-state buffer", tensordicts)
        missing = [key for key in self.names if key not in tensordicts]
        if missing:
            raise UserValueError(
                f"The visited-state buffer keeps {self.state_keys}, and the rollout lacks {missing[0]!r}. Give the "
                "buffer the environment, VisitedStateBuffer(env=env), or the entries of its Markov state, state_keys."
            )
        if tensordicts.batch_size.numel() == 0:
            return torch.zeros(0, dtype=torch.int64)
        states = tensordicts.select(*self.names).detach().reshape(-1)
        keep = torch.ones(states.shape[0], dtype=torch.bool, device=states.device)
        for value in states.values(include_nested=True, leaves_only=True):
            keep &= value.reshape(states.shape[0], -1).isfinite().all(-1)
        if "terminated" in tensordicts:
            keep &= ~leaf(tensordicts, "terminated").reshape(-1).bool()
        if not keep.any():
            return torch.zeros(0, dtype=torch.int64)
        self._check_same(states)
        self.kinds = {name: _kinds(states, name) for name in self.names}
        return super().extend(states[keep].clone())

    @checked
    def initial_state(self, env: EnvBase, fraction: Fraction = 0.9) -> TensorDictBase:
        """Reset an environment for a rollout: a fraction of its batch to visited states, the rest to fresh starts.

        Args:
            env: an environment that can be set to a state, also under transforms.
            fraction: the share of horizons that start in visited states, a probability for each member of the batch.
        """
        check_env(env)
        mixed, visited, pick = self._mixed(_fresh(env, self.state_keys), fraction)
        start = env.reset(mixed, set_state=True)
        for key in self.memory_keys:
            x = leaf(visited, key)
            start.set(key, torch.where(cast(Tensor, expand_as_right(pick, x)), x, 0.0))
            start.set("is_init", ~pick.unsqueeze(-1))
        return start

    @checked
    def source(self, env: EnvBase, fraction: Fraction = 0.9) -> Callable[[int], TensorDictBase]:
        """A function for ``env.set_initial_state_source``: resets inside a horizon then start in visited states, too.

        Args:
            env: an environment with ``sample_start`` (see :mod:`torchrl_quad.data`), also under transforms.
            fraction: the share of starts that are visited states, a probability for each.

        Returns:
            a function from n to n states: the tensordict (n) that ``env`` keeps under its one state key, or a
            tensordict (n) with all of several keys.
        """
        check_env(env)
        base: Any = base_env(env)
        if not _draws_starts(base):
            raise UserTypeError(
                f"{type(base).__name__} has no sample_start(n), from which a source takes its fresh starts. Define it, "
                "or start horizons with buffer.initial_state(env, fraction)."
            )

        def draw(n: int) -> TensorDictBase:
            states, *_ = self._mixed(base.sample_start(n).select(*self.state_keys), fraction)
            return group(states, self.state_keys[0]) if len(self.state_keys) == 1 else states

        return draw

    def _mixed(self, fresh: TensorDictBase, fraction: float) -> tuple[TensorDictBase, TensorDictBase, Tensor]:
        """States to start from, the visited ones and their memory, and which of them were taken, bool."""
        if len(self) == 0:
            raise WrongState(
                "The visited-state buffer is empty. Fly a first horizon from env.reset() and extend the buffer with it."
            )
        visited = cast(TensorDictBase, self.sample(fresh.numel())).select(*self.names).to(fresh.device)
        self._check_same(cast(TensorDictBase, fresh.reshape(-1)))
        pick = torch.rand(fresh.shape, generator=self._rng, device=self._rng.device) < fraction
        pick = pick.to(fresh.device)
        visited = cast(TensorDictBase, visited.reshape(fresh.shape))
        return visited.select(*self.state_keys).where(pick, fresh), visited, pick

    def _check_same(self, states: TensorDictBase) -> None:
        """Raise a UserValueError for states (n) of another kind than the kept ones, which would broadcast silently."""
        different: set[str] = set()
        for name in filter(states.__contains__, self.names):
            theirs = _kinds(states, name)
            different |= {str(key) for key, _ in self.kinds.get(name, theirs).items() ^ theirs.items()}
        if different:
            raise UserValueError(
                f"These are other states than those in the visited-state buffer: {', '.join(sorted(different))} differ "
                "in name, shape or type. Keep a buffer for each task and its options, such as action_delay."
            )

    def state_dict(self) -> dict[str, Any]:
        """The states (n), in their places, the place of the next one, and the random generator."""
        states = self._storage[: len(self)].select(*self.names).flatten_keys(".") if len(self) else TensorDict()
        return {
            "states": {name: x.clone() for name, x in states.items()},
            "cursor": cast(Any, self._writer)._cursor,
            "random": self._rng.get_state(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Hold what :meth:`state_dict` has returned, also that of a smaller buffer; what does not fit is refused."""
        generator, most = torch.Generator(device=self._rng.device), self._storage.max_size
        try:
            entries, cursor = state_dict["states"], operator.index(state_dict["cursor"])
            n = len(next(iter(entries.values()), ()))
            if not (0 <= cursor <= n <= most):
                raise UserValueError(f"it has {n:,} states, and its cursor is {cursor}")
            states = TensorDict(entries, [n]).detach().unflatten_keys(".").select(*self.names if n else ())
            generator.set_state(state_dict["random"])
        except Exception as error:  # of tensordict and torch: one for each thing that may be wrong
            raise UserValueError(
                f"The content does not fit this visited-state buffer of {most:,} states: {one_line(error)}. Take what "
                "a buffer of the same task and options has saved."
            ) from None
        self._check_same(states)
        if cursor < n < most:  # of a smaller buffer that was full: its oldest state is at the cursor
            states, cursor = states[torch.arange(n).roll(-cursor)], n
        storage = cast(LazyTensorStorage, self._storage)
        storage._empty()
        if n:
            states = states.to(storage.device)
            self.kinds = {name: _kinds(states, name) for name in self.names}
            index = torch.arange(n, device=states.device)
            cast(Any, storage).set(index, states.set("index", index))
        self._writer.load_state_dict({"_cursor": cursor % most, "_write_count": n})
        self.set_rng(generator)

    def dumps(self, path: str | Path) -> None:
        """Write :meth:`state_dict` into a folder."""
        Path(path).mkdir(exist_ok=True)
        torch.save(self.state_dict(), Path(path) / "buffer.pt")

    def loads(self, path: str | Path) -> None:
        """Read from a folder what :meth:`dumps` has written."""
        self.load_state_dict(torch.load(Path(path) / "buffer.pt", map_location="cpu", weights_only=True))


@checked
def restart(env: EnvBase, carry: TensorDictBase, fraction: Fraction) -> TensorDictBase:
    """Give a random fraction of the environments fresh starts, and let the others continue; the carry for a rollout.

    The choice draws from torch's global generator, the fresh starts from the environment's own. The flights that
    continue keep the memory of a recurrent policy. Transforms with a memory, such as StepCounter or a primer, begin
    again in all environments, and so does the correlated noise of a policy without memory.

    Args:
        env: an environment that can be set to a state, also under transforms.
        carry: where the environments are, as ``differentiable_rollout`` returns it.
        fraction: the share of flights that are given up for a fresh start, a probability for each.
    """
    check_env(env)
    if not isinstance(carry, TensorDictBase):
        raise UserTypeError(f"carry must be the tensordict that a rollout ended with; got {type(carry).__name__}.")
    keys = _state_keys(env)
    missing = [key for key in state_keys(env) if key not in carry]
    if missing:
        raise UserValueError(f"restart needs the whole state, {keys}, and the carry lacks {missing[0]!r}.")
    size = cast(torch.Size, env.batch_size)
    if carry.shape != size:
        raise UserValueError(
            f"The carry has batch size {tuple(carry.shape)}, and the environment {tuple(size)}. Build one of "
            "that batch size, with num_envs=... or TorchRL's BatchSizeTransform, to restart flights of it."
        )
    fresh = _fresh(env, keys)
    chosen = torch.rand(carry.shape, device=carry.device) < fraction
    start = env.reset(fresh.where(chosen, carry.select(*keys)), set_state=True)
    if "is_init" in carry and "is_init" not in start:  # of a recurrent policy without a primer
        start = carry.copy().update(start).set("is_init", leaf(carry, "is_init") | chosen.unsqueeze(-1))
    return start


def _state_keys(env: EnvBase) -> tuple[NestedKey, ...]:
    """The first names of the entries that make up the Markov state."""
    if keys := state_keys(env):
        return tuple(dict.fromkeys(key if isinstance(key, str) else key[0] for key in keys))
    raise UserValueError(
        f"{type(base_env(env)).__name__} cannot be set to a state: its state_spec is empty. Declare the "
        "entries of its Markov state there, and start from them in _reset(tensordict, set_state=True), with "
        "_supports_set_state = True; or begin every rollout with env.reset()."
    )


def _fresh(env: EnvBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    """Fresh starts (env.batch_size), whatever the environment's resets draw from."""
    base: Any = base_env(env)
    states = base.sample_start(env.numel()).reshape(env.batch_size) if _draws_starts(base) else env.reset()
    return states.select(*keys)


def _draws_starts(base: EnvBase) -> bool:
    # Of the class: environments in other processes die when asked for a missing attribute.
    return hasattr(type(base), "sample_start")


def _kinds(states: TensorDictBase, name: NestedKey) -> Kinds:
    """The kind of each entry of states (n) under a name."""
    entries = cast(TensorDictBase, states.select(name)).items(True, True)
    return {key: (x.shape[1:], x.is_floating_point()) for key, x in entries}
