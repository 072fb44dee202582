"""The control step for a compiler: the same physics on components, with the chain rule over its steps written out.

One physics step and its derivative are each compiled once and called ``substeps`` times, which takes a fraction of the
time that compiling the whole control step would. States are rows (17, n): the entries of :class:`QuadrotorState` one
below the other, so that the numbers of one kind of all drones lie side by side.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_quad.dynamics.control import FlightController, Setpoint
from torchrl_quad.dynamics.parameters import PLANT_FIELDS, RawParams
from torchrl_quad.dynamics.quadrotor import QuadrotorState, physics_step
from torchrl_quad.dynamics.rotors import Rotors
from torchrl_quad.dynamics.vector import Components, join, put_together

ROWS = (3, 4, 3, 3, 4)  # of each entry of QuadrotorState


class CompiledControlStep:
    """:func:`~torchrl_quad.dynamics.control_step` and its derivative, as functions to call inside ``torch.compile``.

    Args:
        controller: the flight controller; its nominal parameters become constants of the compiled code.
        dt: physics step [s].
        substeps: physics steps per control step.
        integrator: name of the integrator.
    """

    def __init__(self, controller: FlightController, dt: float, substeps: int, integrator: str) -> None:
        self.controller, self.dt, self.substeps, self.integrator = controller.take_apart(), dt, substeps, integrator

        def step(state: Tensor, setpoint: Tensor, plant: tuple, wind: tuple) -> Tensor:
            return self._physics_step(state, setpoint, plant, wind)

        def adjoint(state: Tensor, setpoint: Tensor, plant: tuple, wind: tuple, grad: Tensor) -> tuple[Tensor, ...]:
            grads = torch.func.vjp(self._physics_step, state, setpoint, plant, wind)[1](grad)
            return (*grads[:2], *grads[2], *grads[3])  # a flat tuple: only such a region is traced once for all

        self._step, self._adjoint = (torch.compiler.nested_compile_region(f) for f in (step, adjoint))

    def fly(self, state: Tensor, setpoint: Tensor, plant: tuple[Tensor, ...], wind: tuple[Tensor, ...]) -> list[Tensor]:
        """The states (17, n) before, between and after the physics steps.

        Args:
            state: (17, n).
            setpoint: (4, n), thrust [N] and body rates [rad/s].
            plant: the parameters of the drones that fly, in the order of ``PLANT_FIELDS``, each (k, n) or (k, 1);
                empty for nominal drones.
            wind: (3, n) [m/s], world frame; empty for still air.
        """
        states = [state]
        for _ in range(self.substeps):
            states.append(self._step(states[-1], setpoint, plant, wind))
        return states

    def pull_back(
        self, states: list[Tensor], setpoint: Tensor, plant: tuple[Tensor, ...], wind: tuple[Tensor, ...], grad: Tensor
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]:
        """From the gradient (17, n) of the last state those of the first, the setpoint, the plant and the wind."""
        grad, total = grad.contiguous(), None
        for state in reversed(states[:-1]):
            grad, *more = self._adjoint(state, setpoint, plant, wind, grad)
            total = more if total is None else [a + b for a, b in zip(total, more, strict=True)]
        return grad, total[0], tuple(total[1 : len(plant) + 1]), tuple(total[len(plant) + 1 :])

    def _physics_step(self, state: Tensor, setpoint: Tensor, plant: tuple, wind: tuple) -> Tensor:
        rows, parts = Components(state.unbind()), []
        for size in ROWS:
            parts.append(rows[..., :size])
            rows = rows[..., size:]
        asked = Components(setpoint.unbind())
        params, rotors = self.controller.nominal, self.controller.rotors
        if plant:
            params = RawParams(**{k: Components(x.unbind()) for k, x in zip(PLANT_FIELDS, plant, strict=True)})
            rotors = Rotors(params)
        state = physics_step(
            QuadrotorState(*parts),
            Setpoint(asked[..., :1], asked[..., 1:]),
            params,
            rotors,
            self.controller,
            self.dt,
            self.integrator,
            Components(wind[0].unbind()) if wind else None,
        )
        return put_together(join(*state))
