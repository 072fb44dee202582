"""The drone as pure functions on plain tensors: no TorchRL, no TensorDict, differentiable in everything."""

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.control import (
    CONTROLS,
    AttitudeController,
    FlightController,
    RotorThrustController,
    Setpoint,
    VelocityController,
    make_controller,
)
from torchrl_quad.dynamics.firmware import PID, Betaflight
from torchrl_quad.dynamics.gains import suggest_gains
from torchrl_quad.dynamics.importing import import_drone, load_drone
from torchrl_quad.dynamics.model import Dynamics, PointMass, Quadrotor, QuadrotorState
from torchrl_quad.dynamics.parameters import MotorCommand, QuadrotorParams, available_drones
from torchrl_quad.dynamics.rigid_body import INTEGRATORS, RigidBodyState, accelerations

#: The dynamics models by name.
DYNAMICS: dict[str, type[Dynamics]] = {
    "quadrotor": Quadrotor,
    "point_mass": PointMass,
    "pid": PID,
    "betaflight": Betaflight,
}

__all__ = [
    "CONTROLS",
    "DYNAMICS",
    "INTEGRATORS",
    "PID",
    "AttitudeController",
    "Betaflight",
    "Dynamics",
    "FlightController",
    "MotorCommand",
    "PointMass",
    "Quadrotor",
    "QuadrotorParams",
    "QuadrotorState",
    "RigidBodyState",
    "RotorThrustController",
    "Setpoint",
    "VelocityController",
    "accelerations",
    "available_drones",
    "import_drone",
    "load_drone",
    "make_controller",
    "quaternion",
    "suggest_gains",
]
