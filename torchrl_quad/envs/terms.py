"""Parts that several tasks share: observations, reward terms, boxes."""

import torch
from torch import Tensor
from torch.linalg import vector_norm

from torchrl_quad.dynamics import quaternion

# Of the reward of hovering, tracking and racing (paper, table I); distances in m, speeds in m/s and rad/s.
TARGET_WEIGHTS = {
    "survival": 0.1,
    "position": 0.1 / 9,
    "attitude": 1e-5,
    "velocity": 0.002,
    "angular_velocity": 0.002,
}


def norm(x: Tensor) -> Tensor:
    """Length of vectors (*, k), as (*, 1); its derivative at zero is zero."""
    return vector_norm(x, dim=-1, keepdim=True)


def distance(state: dict[str, Tensor]) -> Tensor:
    """Distance to the target, (*, 1) [m]."""
    return norm(state["position"] - state["target"])


def body_observation(state: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Ten times the quaternion, velocity [m/s] in the world frame, angular velocity [rad/s] in the body frame.

    The paper observes a tenth of all this, and of positions, which networks learn from slowly. Times ten, a tilt of
    0.1 rad, a velocity of 0.5 m/s and a distance of 0.5 m weigh alike.
    """
    return 10 * state["quaternion"], state["velocity"], state["angular_velocity"]


# Magnitudes of the above that no useful flight exceeds: the quaternion's are exact.
BODY_BOUNDS = (*4 * (10.0,), *3 * (50.0,), *3 * (50.0,))  # velocity in m/s, angular velocity in rad/s


def target_reward(state: dict[str, Tensor], weights: dict[str, float]) -> dict[str, Tensor]:
    """The terms of "be at the target, level and still", each (*, 1): ``survival``, and four penalties."""
    level = quaternion.identity(state["quaternion"])
    return {
        "survival": torch.full_like(state["position"][..., :1], weights["survival"]),
        "position": -weights["position"] * distance(state),
        "attitude": -weights["attitude"] * quaternion.distance(state["quaternion"], level),
        "velocity": -weights["velocity"] * norm(state["velocity"]),
        "angular_velocity": -weights["angular_velocity"] * norm(state["angular_velocity"]),
    }


def outside(position: Tensor, centre: Tensor, half_width: Tensor | float, height: float) -> Tensor:
    """Whether a position (*, 3) [m] has left the box, (*, 1).

    The box reaches half_width (a number, or one for x and one for y) [m] to all sides of the centre (*, 3), and from
    the ground at 0 up to the height [m].
    """
    sideways = ((position - centre)[..., :2].abs() > half_width).any(-1, keepdim=True)
    z = position[..., 2:]
    return sideways | (z <= 0.0) | (z >= height)
