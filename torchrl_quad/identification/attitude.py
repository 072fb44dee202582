"""Quaternions (..., 4), w x y z from body to world, and rates of change of sampled signals, in numpy."""

from __future__ import annotations

import numpy as np

from torchrl_quad.deploy.frames import multiply
from torchrl_quad.identification.streams import Array

FLIP = np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: Array, v: Array) -> Array:
    """Vectors (..., 3) of the body in the world."""
    turn = 2.0 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * turn + np.cross(q[..., 1:], turn)


def continuous(q: Array) -> Array:
    """The same attitudes without jumps of sign: q and -q are one attitude, but not when they are interpolated."""
    jumps = (q[1:] * q[:-1]).sum(-1) < 0.0
    return q * np.where(np.concatenate(([False], np.cumsum(jumps) % 2 == 1)), -1.0, 1.0)[:, None]


def from_euler(angles: Array) -> Array:
    """From roll, pitch and yaw [rad] (..., 3): yaw about z first, then pitch about y, then roll about x."""
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(angles / 2.0), -1, 0), np.moveaxis(np.sin(angles / 2.0), -1, 0)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return np.stack((w, x, y, z), -1)


def slope(x: Array, dt: float, span: float = 0.04) -> Array:
    """The rate of change (T, n): at each sample the slope of the line through its neighbours within ``span`` [s]."""
    half = min(max(1, round(span / dt)), (len(x) - 1) // 2)
    k = np.arange(-half, half + 1)
    padded = np.concatenate((2.0 * x[0] - x[half:0:-1], x, 2.0 * x[-1] - x[-2 : -half - 2 : -1]))
    return np.stack([np.convolve(c, -k / (k @ k * dt), "valid") for c in padded.T], -1)


def body_rates(q: Array, dt: float, span: float = 0.04) -> Array:
    """Angular velocity in the body frame (T, 3) [rad/s]: twice the vector part of q^-1 dq/dt."""
    return 2.0 * multiply(q * FLIP, slope(q, dt, span))[:, 1:]


def smooth(x: Array, dt: float, span: float = 0.1) -> Array:
    """The mean of the samples within ``span / 2`` [s] of each."""
    half = min(max(0, round(span / dt / 2.0)), (len(x) - 1) // 2)
    padded = np.pad(x, ((half, half), (0, 0)), mode="edge")
    kernel = np.full(2 * half + 1, 1.0 / (2 * half + 1))
    return np.stack([np.convolve(c, kernel, "valid") for c in padded.T], -1)
