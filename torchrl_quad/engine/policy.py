"""Policies that the engine can fly inside a compiled step, on plain tensors: their protocol, and given actions."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.errors import UserTypeError, UserValueError

#: What a policy may write, (n, 1), above zero where an episode ends with the step, such as at a limit of steps.
ENDS = "ends_episode"


class PlainPolicy(Protocol):
    """A policy as pure functions of tensors; a TensorDictModule gives it by a method ``plain()``, or gives None.

    A backward pass needs the gradient of its inputs step by step, and that of its weights only once, for many steps in
    a single batch. So ``adjoint`` returns traces, and ``weight_gradient`` goes on from there.
    """

    #: Policies with the same signature compute the same function of their tensors, and share what is compiled.
    signature: Hashable
    in_keys: Sequence[Any]  #: what it reads of observation, state, other outputs and its memory
    out_keys: Sequence[Any]  #: the entries that it writes; ``"ends_episode"`` ends one where it is above zero
    weights: tuple[Tensor, ...]  #: the tensors that it learns, of which gradients are wanted
    size: int | None  #: the entries of an action, of those drawn; None for all of them
    #: What it reads as it was written below "next" in the step before, with the shape apart from n; an episode begins
    #: with zeros.
    memory: Mapping[Any, tuple[int, ...]]
    #: Entries, or groups of them, whose gradient nobody wants, such as that of an image; the engine sets it.
    without_gradient: frozenset[Any]

    def fits(self, inputs: Sequence[Tensor]) -> bool:
        """Whether it can read inputs of this width, precision and device; otherwise it is called, and can complain."""

    def drawn(self, steps: int, n: int, before: Mapping[Any, Tensor]) -> Tensor:
        """What changes from step to step and does not depend on the state, such as noise: (steps, n, at least size).

        ``before`` holds what the policy has written in the step before the first one, if it was there.
        """

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
        """Traces for ``weight_gradient``, each (n, ...), and the gradients of its inputs and of what was drawn."""

    def weight_gradient(self, weights: Sequence[Tensor], traces: Sequence[Tensor]) -> list[Tensor]:
        """The gradients of its weights, over a batch (n) of any steps."""


class GivenActions:
    """Actions that are known beforehand, whatever the state; also those of a policy that can only be called."""

    in_keys, out_keys, weights, size = (), ("action",), (), None
    memory: Mapping[Any, tuple[int, ...]] = {}
    without_gradient: frozenset[Any] = frozenset()

    def __init__(self, take: Callable[[int], Tensor]) -> None:
        self.take = take  # from a number of steps to their actions (steps, n, k)

    def fits(self, inputs: Sequence[Tensor]) -> bool:
        """It reads nothing."""
        return True

    def drawn(self, steps: int, n: int, before: Mapping[Any, Tensor]) -> Tensor:
        """The actions of the next steps."""
        return self.take(steps)


class ActionSequence(TensorDictModuleBase):
    """A policy that plays given actions one after another, once, to optimise a trajectory itself.

    .. code-block:: python

        actions = torch.zeros(32, env.num_envs, 4, requires_grad=True)
        rollout, _ = differentiable_rollout(env, ActionSequence(actions), env.reset(), len(actions))
        rollout["next", "reward"].sum().backward()  # fills actions.grad

    Args:
        actions: (horizon, num_envs, k); gradients reach them.

    Raises:
        TypeError: they are no such tensor.
        ValueError: (in use) there are no actions left.
    """

    def __init__(self, actions: Tensor) -> None:
        if not (isinstance(actions, Tensor) and actions.ndim > 1 and actions.is_floating_point()):
            got = f"{tuple(actions.shape)}, {actions.dtype}" if isinstance(actions, Tensor) else type(actions).__name__
            raise UserTypeError(
                "actions must be a floating-point tensor (horizon, num_envs, k), such as "
                f"torch.zeros(32, env.num_envs, 4, requires_grad=True); got {got}."
            )
        self.in_keys: list[Any] = []
        self.out_keys: list[Any] = ["action"]
        super().__init__()
        self.actions, self.played = actions, 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next action."""
        return tensordict.set("action", self.take(1)[0])

    def plain(self) -> GivenActions:
        """The rest of the sequence, for a compiled step."""
        return GivenActions(self.take)

    def take(self, steps: int) -> Tensor:
        """The next actions, (steps, num_envs, k)."""
        left = len(self.actions) - self.played
        if steps > left:
            raise UserValueError(
                f"The sequence has {len(self.actions)} actions, {left} of them unplayed, and the flight needs {steps} "
                "more. Give as many actions as the flight has steps, and build a new ActionSequence for each flight."
            )
        self.played += steps
        return self.actions[self.played - steps : self.played]
