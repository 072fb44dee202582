"""Unit quaternions (w, x, y, z) that turn body-frame vectors into world-frame vectors.

All functions broadcast over leading dimensions and have finite derivatives for every finite input.
"""

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_quad.dynamics.vector import Vector, cat, cross, dot


def multiply(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product p q, (*, 4): the rotation q followed, in the outer frame, by p."""
    (pw, pv), (qw, qv) = p.split((1, 3), -1), q.split((1, 3), -1)
    scalar = pw * qw - dot(pv, qv)
    return torch.cat((scalar, pw * qv + qw * pv + cross(pv, qv)), -1)


def identity(like: Tensor) -> Tensor:
    """No rotation, (*, 4), for each of the leading dimensions of a tensor (*, k)."""
    return pad(torch.ones_like(like[..., :1]), (0, 3))


def normalize(q: Vector) -> Vector:
    """Scale to unit norm, (*, 4). A norm below 1e-6 is treated as 1e-6, so that zero stays zero instead of NaN."""
    return q * dot(q, q).clamp_min(1e-12).rsqrt()


def rotate(q: Vector, v: Vector, sign: float = 1.0) -> Vector:
    """Body to world: the vector v (*, 3) turned by the unit quaternion q (*, 4); the other way with the sign -1."""
    # v + u x t + sign w t with t = 2 u x v, for q = (w, u)
    w, u = q[..., :1] * sign, q[..., 1:]
    turned = cross(u * 2.0, v)
    return v + cross(u, turned).addcmul(w, turned)


def rotate_inverse(q: Vector, v: Vector) -> Vector:
    """World to body: the vector v (*, 3) turned by the inverse of the unit quaternion q (*, 4)."""
    return rotate(q, v, -1.0)


def up_in_body(q: Vector) -> Vector:
    """The world's z axis in the body frame, (*, 3): what :func:`rotate_inverse` makes of (0, 0, 1)."""
    w, x, y, z = q[..., :1], q[..., 1:2], q[..., 2:3], q[..., 3:]
    return cat((x * z - w * y) * 2.0, (y * z + w * x) * 2.0, (x * x + y * y) * -2.0 + 1.0)


def derivative(q: Vector, angular_velocity: Vector) -> Vector:
    """Time derivative (*, 4) [1/s] under the body-frame angular velocity (*, 3) [rad/s]: half of q (0, w)."""
    half = q * 0.5
    w, u = half[..., :1], half[..., 1:]
    return cat(-dot(u, angular_velocity), cross(u, angular_velocity).addcmul(w, angular_velocity))


def from_axis_angle(axis_angle: Tensor) -> Tensor:
    """The rotation by |axis_angle| [rad] about the axis axis_angle (*, 3), as a unit quaternion (*, 4)."""
    half = 0.5 * axis_angle
    angle = dot(half, half).clamp_min(1e-24).sqrt()
    return torch.cat((angle.cos(), half * angle.sin() / angle), -1)


def distance(p: Tensor, q: Tensor) -> Tensor:
    """Attitude error min(|p - q|, |p + q|), (*, 1), as q and -q are one: 0 for the same, sqrt(2) for half a turn."""
    flip = torch.where(dot(p, q) < 0, -1.0, 1.0).to(p)
    return torch.linalg.vector_norm(p - flip * q, dim=-1, keepdim=True)
