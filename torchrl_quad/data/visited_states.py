"""The buffer of visited states, from which horizons and resets can start (paper, section IV)."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, TransformedEnv


class VisitedStateBuffer(TensorDictReplayBuffer):
    """States that the policy has visited, to start horizons and episodes from.

    Only states are kept, no transitions: this is no replay for off-policy learning. A state is the complete Markov
    state, with the commands that are on their way and whatever the task keeps, detached from any graph.

    Saving and loading is inherited: ``state_dict``, ``load_state_dict``, ``dumps(path)``, ``loads(path)``; the random
    generator goes along.

    Args:
        capacity: number of states kept; the oldest go first.
        state_keys: the entries that make up the Markov state; another environment names its own, such as
            ``("th", "thdot", "params")`` for TorchRL's PendulumEnv.
        device: where the states are stored.
        seed: of the buffer's own random generator.

    Raises:
        ValueError: the capacity is less than 1.
    """

    def __init__(
        self,
        capacity: int = 100_000,
        *,
        state_keys: Sequence[NestedKey] = ("state",),
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        if not (isinstance(capacity, numbers.Integral) and capacity >= 1):
            raise ValueError(f"capacity must be at least 1 state, got {capacity}.")
        self.state_keys = tuple(state_keys)
        super().__init__(
            storage=LazyTensorStorage(capacity, device=device),
            generator=torch.Generator(device=device).manual_seed(seed),
        )

    def extend(self, tensordicts: TensorDictBase) -> Tensor:
        """Add the states that a rollout (any batch size) started its steps in.

        Terminated states and states that are not finite are left out.

        Returns:
            the indices written.

        Raises:
            ValueError: the rollout lacks an entry of the state, or its states are not those of the buffer.
        """
        missing = [key for key in self.state_keys if key not in tensordicts]
        if missing:
            raise ValueError(
                f"The visited-state buffer keeps {self.state_keys}, and the rollout lacks {missing[0]!r}. Name the "
                "entries of the environment's Markov state: VisitedStateBuffer(state_keys=[...])."
            )
        states = tensordicts.select(*self.state_keys).detach().reshape(-1)
        keep = torch.ones(states.shape[0], dtype=torch.bool, device=states.device)
        for value in states.values(include_nested=True, leaves_only=True):
            keep &= value.reshape(states.shape[0], -1).isfinite().all(-1)
        terminated = tensordicts.get("terminated", None)
        if terminated is not None:
            keep &= ~terminated.reshape(-1)
        if not keep.any():
            return torch.zeros(0, dtype=torch.int64)
        if len(self):
            _require_same(states, self[:1].select(*self.state_keys))
        return super().extend(states[keep].clone())

    def initial_state(self, env: EnvBase, fraction: float = 0.9) -> TensorDictBase:
        """Reset an environment: a fraction of its batch to visited states, the rest to fresh starts.

        Args:
            env: an environment that can be set to a state, also under transforms.
            fraction: probability, for each member of the batch, of a visited state.

        Returns:
            the tensordict of the reset, to be the carry of a rollout.

        Raises:
            ValueError: the fraction is not in [0, 1], or the states of the buffer are not those of the environment.
            RuntimeError: the buffer is empty.
        """
        base = env
        while isinstance(base, TransformedEnv):
            base = base.base_env
        # Of the class: environments in other processes cannot be asked what they know, one that does not know dies.
        if hasattr(type(base), "sample_initial_state"):  # the task's own starts, whatever its resets draw from
            fresh = TensorDict({"state": env.sample_initial_state(env.num_envs)}, env.batch_size, device=env.device)
        else:
            fresh = env.reset().select(*self.state_keys)
        return env.reset(self._mixed(fresh, fraction), set_state=True)

    def source(self, env: EnvBase, fraction: float = 0.9) -> Callable[[int], TensorDictBase]:
        """What ``env.set_initial_state_source`` takes, so that resets inside a horizon start in visited states, too.

        ``env`` is a quadrotor environment; arguments and errors are those of :meth:`initial_state`.
        """

        _require_fraction(fraction)

        def draw(n: int) -> TensorDictBase:
            return self._mixed(TensorDict({"state": env.sample_initial_state(n)}, [n], env.device), fraction).get(
                "state"
            )

        return draw

    def _mixed(self, fresh: TensorDictBase, fraction: float) -> TensorDictBase:
        _require_fraction(fraction)
        if len(self) == 0:
            raise RuntimeError(
                "The visited-state buffer is empty. Fly a first horizon from env.reset() and extend the buffer with it."
            )
        visited = self.sample(fresh.numel()).select(*self.state_keys).to(fresh.device)
        _require_same(fresh.reshape(-1), visited)
        visited = visited.reshape(fresh.shape)
        pick = torch.rand(fresh.shape, generator=self._rng, device=self._rng.device) < fraction
        return visited.where(pick.to(fresh.device), fresh)


def _require_fraction(fraction: float) -> None:
    if not 0.0 <= fraction <= 1.0:
        raise ValueError(f"fraction must lie between 0 (all fresh) and 1 (all visited), got {fraction}.")


def _require_same(states: TensorDictBase, kept: TensorDictBase) -> None:
    """Refuse states (n) of another kind than those that are kept: they would be mixed, or broadcast, in silence."""
    ours, theirs = ({key: x.shape[1:] for key, x in td.items(True, True)} for td in (kept, states))
    different = sorted({str(key) for key, _ in ours.items() ^ theirs.items()})
    if different:
        raise ValueError(
            f"These are other states than those in the visited-state buffer: {', '.join(different)} differ in name or "
            "shape. Keep a buffer for each task and its options, such as action_delay."
        )
