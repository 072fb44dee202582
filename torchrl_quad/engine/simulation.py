"""The protocol of the simulations that the engine flies: a control step as a pure function, in three parts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from torch import Tensor

#: Entries (n, ...) of a state by name; a nested entry has a tuple of names.
State = dict[Any, Tensor]


class Transition(NamedTuple):
    """Where a control step leads."""

    state: State  #: the state at its end
    outputs: dict[str, Any]  #: observation, reward, flags and so on; mappings of names hold further ones
    valid: Tensor  #: where the numbers still mean something, bool (n); no gradient passes elsewhere


class Simulation(Protocol):
    """A control step, whole for an eager flight, and in three parts for a compiled one.

    The parts exist because a compiler that gets a whole step unrolls its physics steps and takes minutes.
    """

    substeps: int  #: how often ``substep`` runs between ``begin`` and ``finish``
    constants: frozenset[str]  #: the outputs that carry no gradient, such as what is only measured

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """Tensors in addition to state and action that gradients may reach, such as the mass of a drone."""

    def example(self) -> tuple[State, dict[str, Any]]:
        """A state, and outputs of the kind that a step gives; the engine reads names, shapes and types."""

    def check_action(self, action: Tensor | None) -> None:
        """Refuse an action of the wrong shape, precision or device."""

    @property
    def guard(self) -> Callable[[State], tuple[State, Tensor]]:
        """The state with safe entries where it is meaningless, and bool (n) that says where it was meaningful."""

    def __call__(self, state: State, valid: Tensor, action: Tensor, noise: dict[str, Tensor]) -> Transition:
        """The whole step."""

    def begin(
        self, state: State, valid: Tensor, action: Tensor, parameters: tuple[Tensor, ...]
    ) -> tuple[State, Tensor, Tensor, tuple[Any, ...]]:
        """The state with the action in it, ``valid``, the rows ``x`` (k, n) that substeps move, and their inputs.

        Every input of a substep is a tensor (k, n), or a tuple of some.
        """

    def rows_step(self) -> Any:
        """The function ``substep(x, *inputs)``, which returns the next ``x``."""

    def finish(self, before: State, x: Tensor, valid: Tensor, noise: dict[str, Tensor]) -> Transition:
        """The end of the step, from what ``begin`` returned and the last ``x``."""
