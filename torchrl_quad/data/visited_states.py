"""Where the next horizon starts: in visited states (paper, section IV), afresh, or where the last one ended."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase

from torchrl_quad.data.unwrap import base_env, memory_keys
from torchrl_quad.errors import UserTypeError, UserValueError


class VisitedStateBuffer(TensorDictReplayBuffer):
    """States that the policy has visited, from which horizons and episodes can start.

    The buffer keeps states and no transitions, so it is no replay for off-policy learning. A state is the complete
    Markov state, including commands on their way and whatever the task keeps, detached from any graph.

    Saving and loading is inherited: ``state_dict``, ``load_state_dict``, ``dumps(path)``, ``loads(path)``. They include
    the buffer's random generator, which draws the states and decides which environments get one.

    Args:
        capacity: number of states kept; the oldest go first.
        env: the environment whose Markov state is kept; see :mod:`torchrl_quad.data`.
        state_keys: the entries that make up the Markov state. By default those of ``env``, and "state" without one.
        actor: a recurrent policy, whose memory is kept beside the state. Without it, and in :meth:`source`, it begins
            empty in a visited state.
        device: where the states are stored.
        seed: of the buffer's own random generator.

    Raises:
        ValueError: the capacity is less than 1.
    """

    def __init__(
        self,
        capacity: int = 100_000,
        env: EnvBase | None = None,
        *,
        state_keys: Sequence[NestedKey] | None = None,
        actor: TensorDictModuleBase | None = None,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        if not (isinstance(capacity, numbers.Integral) and capacity >= 1):
            raise UserValueError(f"capacity must be at least 1 state, got {capacity}.")
        if state_keys is None:
            state_keys = ("state",) if env is None else _state_keys(env)
        self.state_keys = tuple(state_keys)
        self.memory_keys = () if actor is None else memory_keys(actor)
        super().__init__(
            storage=LazyTensorStorage(capacity, device=device),
            generator=torch.Generator(device=device).manual_seed(seed),
        )

    def extend(self, tensordicts: TensorDictBase) -> Tensor:
        """Add the states in which the steps of a rollout (any batch size) started.

        Terminated states and states that are not finite are left out.

        Returns:
            the indices written.

        Raises:
            ValueError: the rollout lacks an entry of the state, or its states differ in kind from the buffer's.
        """
        missing = [key for key in (*self.state_keys, *self.memory_keys) if key not in tensordicts]
        if missing:
            raise UserValueError(
                f"The visited-state buffer keeps {self.state_keys}, and the rollout lacks {missing[0]!r}. Give the "
                "buffer the environment, VisitedStateBuffer(env=env), or the entries of its Markov state, state_keys."
            )
        states = tensordicts.select(*self.state_keys, *self.memory_keys).detach().reshape(-1)
        keep = torch.ones(states.shape[0], dtype=torch.bool, device=states.device)
        for value in states.values(include_nested=True, leaves_only=True):
            keep &= value.reshape(states.shape[0], -1).isfinite().all(-1)
        terminated = tensordicts.get("terminated", None)
        if terminated is not None:
            keep &= ~terminated.reshape(-1)
        if not keep.any():
            return torch.zeros(0, dtype=torch.int64)
        if len(self):
            _require_same(states, self[:1].select(*self.state_keys, *self.memory_keys))
        return super().extend(states[keep].clone())

    def initial_state(self, env: EnvBase, fraction: float = 0.9) -> TensorDictBase:
        """Reset an environment: a fraction of its batch to visited states, the rest to fresh starts.

        Args:
            env: an environment that can be set to a state, also under transforms.
            fraction: probability, for each member of the batch, of a visited state.

        Returns:
            the tensordict of the reset, the carry of the next rollout.

        Raises:
            ValueError: the fraction is not in [0, 1], or the environment's states differ in kind from the buffer's.
            RuntimeError: the buffer is empty.
        """
        mixed, visited, pick = self._mixed(_fresh(env, self.state_keys), fraction)
        start = env.reset(mixed, set_state=True)
        for key, x in visited.select(*self.memory_keys).items(True, True):
            start.set(key, torch.where(expand_as_right(pick, x), x, 0.0))
            start.set("is_init", ~pick.unsqueeze(-1))
        return start

    def source(self, env: EnvBase, fraction: float = 0.9) -> Callable[[int], TensorDictBase]:
        """A function for ``env.set_initial_state_source``: resets inside a horizon then start in visited states, too.

        Args:
            env: an environment with ``sample_start`` (see :mod:`torchrl_quad.data`), also under transforms.
            fraction: probability, for each state, of a visited one.

        Returns:
            a function from n to n states: the tensordict (n) that ``env`` keeps under its one state key, or, where the
            state has several keys, a tensordict (n) with all of them.

        Raises:
            TypeError: the environment has no ``sample_start``.
            ValueError: the fraction is not in [0, 1]; (in use) as :meth:`initial_state`.
            RuntimeError: (in use) the buffer is empty.
        """
        _require_fraction(fraction)
        base = base_env(env)
        if not _draws_starts(base):
            raise UserTypeError(
                f"{type(base).__name__} has no sample_start(n), from which a source takes its fresh starts. Define it, "
                "or start horizons with buffer.initial_state(env, fraction)."
            )

        def draw(n: int) -> TensorDictBase:
            states, *_ = self._mixed(base.sample_start(n).select(*self.state_keys), fraction)
            return states.get(self.state_keys[0]) if len(self.state_keys) == 1 else states

        return draw

    def _mixed(self, fresh: TensorDictBase, fraction: float) -> tuple[TensorDictBase, TensorDictBase, Tensor]:
        """States to start from, the visited ones and their memory, and which of them were taken, bool."""
        _require_fraction(fraction)
        if len(self) == 0:
            raise RuntimeError(
                "The visited-state buffer is empty. Fly a first horizon from env.reset() and extend the buffer with it."
            )
        visited = self.sample(fresh.numel()).select(*self.state_keys, *self.memory_keys).to(fresh.device)
        states = visited.select(*self.state_keys)
        _require_same(fresh.reshape(-1), states)
        pick = torch.rand(fresh.shape, generator=self._rng, device=self._rng.device) < fraction
        pick = pick.to(fresh.device)
        return states.reshape(fresh.shape).where(pick, fresh), visited.reshape(fresh.shape), pick


def restart(env: EnvBase, carry: TensorDictBase, fraction: float) -> TensorDictBase:
    """Start a random fraction of the environments afresh, and let the others go on from where they are.

    Beside visited states this is the other way to choose where the next horizon starts: most flights go on through many
    horizons, and some begin anew. The choice draws from torch's global generator, the fresh starts from the
    environment's own. Those that go on keep the memory of a recurrent policy. In all environments transforms that
    remember, such as StepCounter or a primer, begin anew, and so does the correlated noise of a policy without memory.

    Args:
        env: an environment that can be set to a state, also under transforms.
        carry: where the environments are, as ``differentiable_rollout`` returns it.
        fraction: probability, for each member of the batch, of a fresh start.

    Returns:
        the tensordict of the reset, the carry of the next rollout.

    Raises:
        ValueError: the fraction is not in [0, 1], or the carry lacks an entry of the state or has another batch size.
    """
    _require_fraction(fraction)
    keys = _state_keys(env)
    missing = [key for key in base_env(env).state_keys if key not in carry]
    if missing:
        raise UserValueError(f"restart needs the whole state, {keys}, and the carry lacks {missing[0]!r}.")
    if carry.shape != env.batch_size:
        raise UserValueError(
            f"The carry has batch size {tuple(carry.shape)}, and the environment {tuple(env.batch_size)}. Build one of "
            "that batch size, such as num_envs=..., to start flights of it afresh."
        )
    fresh = _fresh(env, keys)
    chosen = torch.rand(carry.shape, device=carry.device) < fraction
    start = env.reset(fresh.where(chosen, carry.select(*keys)), set_state=True)
    if "is_init" in carry and "is_init" not in start:  # a policy remembers, and no transform does it for it
        start = carry.copy().update(start).set("is_init", carry["is_init"] | chosen.unsqueeze(-1))
    return start


def _state_keys(env: EnvBase) -> tuple[NestedKey, ...]:
    """The first names of the entries that make up the Markov state."""
    keys = base_env(env).state_keys
    return tuple(dict.fromkeys(key if isinstance(key, str) else key[0] for key in keys))


def _fresh(env: EnvBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    """Fresh starts (env.batch_size), whatever the environment's resets draw from."""
    base = base_env(env)
    states = base.sample_start(env.numel()).reshape(env.batch_size) if _draws_starts(base) else env.reset()
    return states.select(*keys)


def _draws_starts(base: EnvBase) -> bool:
    # Of the class: environments in processes of their own die when they are asked for what they do not have.
    return hasattr(type(base), "sample_start")


def _require_fraction(fraction: float) -> None:
    if not 0.0 <= fraction <= 1.0:
        raise UserValueError(f"fraction must lie between 0 and 1, got {fraction}.")


def _require_same(states: TensorDictBase, kept: TensorDictBase) -> None:
    """Refuse states (n) of another kind than those that are kept, before they are mixed or broadcast in silence."""
    ours, theirs = ({key: x.shape[1:] for key, x in td.items(True, True)} for td in (kept, states))
    different = sorted({str(key) for key, _ in ours.items() ^ theirs.items()})
    if different:
        raise UserValueError(
            f"These are other states than those in the visited-state buffer: {', '.join(different)} differ in name or "
            "shape. Keep a buffer for each task and its options, such as action_delay."
        )
