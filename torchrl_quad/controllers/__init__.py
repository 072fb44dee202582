"""Classical controllers as baselines: policies that learn nothing, and are given the drone and the task."""

from torchrl_quad.controllers.geometric import GeometricController
from torchrl_quad.controllers.mpc import MPC
from torchrl_quad.controllers.policy import Controller, Motion, follow

__all__ = ["MPC", "Controller", "GeometricController", "Motion", "follow"]
