"""The flight controller: from an action to four rotor speeds, with the drone it believes to fly."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_quad.dynamics import rotors
from torchrl_quad.dynamics.parameters import QuadrotorParams
from torchrl_quad.dynamics.rigid_body import angular_acceleration, gyroscopic_torque


class Setpoint(NamedTuple):
    """What an action asks for: collective thrust and body rates (CTBR)."""

    thrust: Tensor  # (*, 1) [N]
    body_rate: Tensor  # (*, 3) [rad/s], body frame


class FlightController:
    """Rate controller and mixer with the nominal parameters of the drone.

    The plant may differ (randomised, fitted): the controller keeps what it was built with, and no gradient flows into
    that.
    """

    def __init__(self, nominal: QuadrotorParams) -> None:
        self.nominal = nominal
        self.allocation = rotors.allocation_matrix(nominal)
        self.mixer = torch.linalg.inv(self.allocation)
        self.thrust_min, self.thrust_max = rotors.thrust_limits(nominal)
        self.weight = nominal.mass * nominal.gravity
        # Yaw torque balances in hover, and roll and pitch too for a centred layout: the mixer gives each rotor's share.
        hover_thrust = rotors.apply(self.mixer, torch.cat((self.weight, torch.zeros_like(nominal.inertia)), -1))
        self.hover_speed = rotors.speed_from_thrust(hover_thrust, nominal)
        thrust = 2.0 / nominal.max_thrust_to_weight - 1.0
        self.hover_action = torch.cat((thrust, torch.zeros_like(nominal.max_body_rate)), -1)

    def setpoint(self, action: Tensor) -> Setpoint:
        """Decode an action (*, 4) in [-1, 1]; values outside are clamped."""
        action = action.clamp(-1.0, 1.0)
        thrust = 0.5 * (action[..., :1] + 1.0) * self.nominal.max_thrust_to_weight * self.weight
        return Setpoint(thrust, action[..., 1:] * self.nominal.max_body_rate)

    def rotor_speed(self, setpoint: Setpoint, angular_velocity: Tensor, rotor_speed: Tensor) -> Tensor:
        """Commanded rotor speed (*, 4) [rad/s] for a setpoint, the body rates (*, 3), and the present speeds (*, 4).

        Torque = J K (desired rate - rate) - D (angular acceleration) + w x J w, where the angular acceleration is
        computed from the present rotor speeds. The paper prints a derivative of the desired rate as well; a setpoint
        that is held for a control step has none.
        """
        drone = self.nominal
        torque_now = rotors.apply(self.allocation, rotors.thrust_from_speed(rotor_speed, drone))[..., 1:]
        acceleration = angular_acceleration(angular_velocity, torque_now, drone.inertia)
        torque = (
            drone.inertia * drone.rate_gain * (setpoint.body_rate - angular_velocity)
            - drone.rate_damping * acceleration
            + gyroscopic_torque(angular_velocity, drone.inertia)
        )
        thrust = rotors.apply(self.mixer, torch.cat((setpoint.thrust, torque), -1))
        thrust = torch.minimum(torch.maximum(thrust, self.thrust_min), self.thrust_max)
        return rotors.speed_from_thrust(thrust, drone)
