"""The flight controller: from an action to four rotor speeds, with the drone it believes to fly."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_quad.dynamics.parameters import QuadrotorParams, RawParams
from torchrl_quad.dynamics.rigid_body import gyroscopic_torque
from torchrl_quad.dynamics.rotors import Rotors, thrust_limits
from torchrl_quad.dynamics.vector import Vector, clamp, join, multiply_add, take_apart, take_apart_rows, transform


class Setpoint(NamedTuple):
    """What an action asks for: collective thrust and body rates (CTBR)."""

    thrust: Vector  #: (*, 1) [N]
    body_rate: Vector  #: (*, 3) [rad/s], body frame


class FlightController:
    """Rate controller and mixer with the nominal parameters of the drone.

    The plant may differ (randomised, fitted): the controller keeps a copy of what it was built with, and no gradient
    flows into that.

    Raises:
        ValueError: the rotor layout cannot make thrust and torque about each axis, or the drone cannot hover.
    """

    def __init__(self, nominal: QuadrotorParams) -> None:
        nominal = nominal.detach()
        self.nominal = nominal
        self.rotors = Rotors(nominal)
        self.mixer = _inverse(self.rotors.allocation)
        self.thrust_min, self.thrust_max = thrust_limits(nominal)
        self.gain = nominal.inertia * nominal.rate_gain
        weight = nominal.mass * nominal.gravity
        self.half_range = 0.5 * nominal.max_thrust_to_weight * weight
        self.hover_speed = self.rotors.speed(transform(self.mixer, pad(weight, (0, 3))))
        self.hover_action = pad(2.0 / nominal.max_thrust_to_weight - 1.0, (0, 3))
        _require_hover(nominal, self.hover_speed)

    def take_apart(self) -> FlightController:
        """The same on components: its numbers become constants of the code that is compiled with it."""
        apart = copy.copy(self)
        apart.nominal = RawParams(
            **{
                name: take_apart(value, constant=True)
                for name, value in self.nominal.fields().items()
                if name != "rotor_positions"
            }
        )
        apart.rotors, apart.mixer = self.rotors.take_apart(), take_apart_rows(self.mixer)
        for name in ("thrust_min", "thrust_max", "gain"):
            setattr(apart, name, take_apart(getattr(self, name), constant=True))
        return apart

    def setpoint(self, action: Tensor) -> Setpoint:
        """Decode an action (*, 4) in [-1, 1]; values outside are clamped."""
        action = action.clamp(-1.0, 1.0)
        return Setpoint((action[..., :1] + 1.0) * self.half_range, action[..., 1:] * self.nominal.max_body_rate)

    def rotor_speed(self, setpoint: Setpoint, angular_velocity: Vector, wrench: Vector) -> Vector:
        """Commanded rotor speed (*, 4) [rad/s] for a setpoint, the body rates (*, 3), and the present wrench (*, 4).

        Torque = J K (desired rate - rate) - D (angular acceleration) + w x J w, where the angular acceleration follows
        from the wrench that the controller believes the rotors to exert. The paper prints a derivative of the desired
        rate as well; a setpoint that is held for a control step has none.
        """
        inertia = self.nominal.inertia
        gyroscopic = gyroscopic_torque(angular_velocity, inertia)
        acceleration = (wrench[..., 1:] - gyroscopic) / inertia
        torque = multiply_add(gyroscopic, self.gain, setpoint.body_rate - angular_velocity)
        torque = torque - self.nominal.rate_damping * acceleration
        thrust = transform(self.mixer, join(setpoint.thrust, torque))
        return self.rotors.speed(clamp(thrust, self.thrust_min, self.thrust_max))


def _require_hover(nominal: QuadrotorParams, speed: Tensor) -> None:
    low, high = nominal.rotor_speed_min, nominal.rotor_speed_max
    if not ((low < speed) & (speed < high)).all():
        raise ValueError(
            f"drone: to hover, its rotors would have to turn at {speed.tolist()} rad/s, and they can at "
            f"{low.tolist()} to {high.tolist()}. Check mass [kg], gravity, thrust_map and rotor_positions."
        )
    if not (nominal.max_thrust_to_weight > 1).all():
        raise ValueError(
            "drone: max_thrust_to_weight is what full thrust commands, in units of the weight, and must be above 1 to "
            f"hover; got {nominal.max_thrust_to_weight.tolist()}."
        )


def _inverse(allocation: Tensor) -> Tensor:
    # Rounding makes rotors on one line look invertible: with rows of one length drones have conditions below 100.
    rows = allocation.double()
    rows = rows / rows.norm(dim=-1, keepdim=True).clamp_min(1e-30)
    inverse, _ = torch.linalg.inv_ex(allocation)
    if not (torch.linalg.cond(rows) < 1e4).all():
        raise ValueError(
            "drone: with these rotor_positions and rotor_spin the four rotors cannot make thrust and torque about each "
            "axis on their own. Put them off one line, and let two of them spin each way."
        )
    return inverse
