"""The protocol of policies that the engine can fly inside a compiled step, on plain tensors."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any, Protocol

from torch import Tensor


class PlainPolicy(Protocol):
    """A policy as pure functions of tensors; a TensorDictModule gives it by a method ``plain()``, or gives None.

    A backward pass needs the gradient of its inputs step by step, and that of its weights only once, for many steps in
    a single batch. So ``adjoint`` returns the gradient of what ``forward`` kept, and ``weight_gradient`` goes on from
    there.
    """

    signature: Hashable
    """Policies with the same signature compute the same function of their tensors, and share what is compiled."""

    in_keys: Sequence[Any]
    """The entries that it reads: the observation, or entries of the state."""

    weights: tuple[Tensor, ...]
    """The tensors that it learns, of which gradients are wanted."""

    def drawn(self, steps: int, n: int) -> Tensor:
        """What changes from step to step and does not depend on the state, such as noise: (steps, n, k)."""

    def forward(
        self, weights: Sequence[Tensor], inputs: Sequence[Tensor], drawn: Tensor
    ) -> tuple[list[Tensor], dict[Any, Tensor]]:
        """What a backward pass needs, each (n, ...), and the entries that it writes, ``action`` among them."""

    def adjoint(
        self,
        weights: Sequence[Tensor],
        inputs: Sequence[Tensor],
        kept: Sequence[Tensor],
        drawn: Tensor,
        grads: dict[Any, Tensor],
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """The gradients of what it kept, of its inputs and of what was drawn, from those of its entries."""

    def weight_gradient(
        self, inputs: Sequence[Tensor], kept: Sequence[Tensor], grad_kept: Sequence[Tensor]
    ) -> list[Tensor]:
        """The gradients of its weights, over a batch (n) of any steps."""


class GivenActions:
    """Actions that are known beforehand, whatever the state; also those of a policy that can only be called."""

    signature = "given actions"
    in_keys, out_keys, weights = (), ("action",), ()

    def __init__(self, take: Callable[[int], Tensor]) -> None:
        self.take = take  # from a number of steps to their actions (steps, n, k)

    def drawn(self, steps: int, n: int) -> Tensor:
        """The actions of the next steps."""
        return self.take(steps)

    def forward(
        self, weights: Sequence[Tensor], inputs: Sequence[Tensor], drawn: Tensor
    ) -> tuple[list[Tensor], dict[Any, Tensor]]:
        """The action of this step."""
        return [], {"action": drawn}

    def adjoint(
        self,
        weights: Sequence[Tensor],
        inputs: Sequence[Tensor],
        kept: Sequence[Tensor],
        drawn: Tensor,
        grads: dict[Any, Tensor],
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """The gradient of the action."""
        return [], [], grads["action"]

    def weight_gradient(
        self, inputs: Sequence[Tensor], kept: Sequence[Tensor], grad_kept: Sequence[Tensor]
    ) -> list[Tensor]:
        """Nothing: it learns nothing."""
        return []


def plain(policy: Any) -> PlainPolicy | None:
    """A policy as pure functions, or None where it can only be called."""
    make = getattr(policy, "plain", None)
    return make() if callable(make) else None
