"""Where rotors push, in numpy, for what flies and checks without torch: their wrench, and the axes that they lack.

The torch function, which has gradients, is :func:`torchrl_quad.dynamics.rigid_body.allocation_matrix`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
AXES = np.array(["thrust", "roll", "pitch", "yaw"])


def matrix(drone: Mapping[str, Any]) -> Array:
    """The matrix (6, n) from n rotor thrusts to the force along z, the torque about x, y, z, and the force along x, y.

    ``drone`` has the fields of :class:`~torchrl_quad.QuadrotorParams` as numbers and lists; the controller knows of no
    ``rotor_effectiveness``, and this neither.
    """
    spin, places = np.array(drone["rotor_spin"], float), np.array(drone["rotor_positions"], float)
    arms = np.pad(places, ((0, 0), (0, 3 - places.shape[1])))
    up = np.array(drone.get("rotor_direction") or [(0.0, 0.0, 1.0)] * len(spin), float)
    with np.errstate(invalid="ignore"):  # a rotor without a direction is NaN
        up = up / np.linalg.norm(up, axis=1, keepdims=True)
    torque = np.cross(arms, up) + float(drone["yaw_torque_coefficient"]) * spin[:, None] * up
    return np.concatenate((up[:, 2:], torque, up[:, :2]), 1).T


def quarters(positions: ArrayLike) -> list[int]:
    """For each rotor of an X quadrotor its quarter: 0 front left, 1 back left, 2 back right, 3 front right; [] of none.

    ``positions`` (n, 2 or 3) stand in any order.
    """
    x, y = np.asarray(positions, float).T[:2]
    found = np.where(x > 0.0, np.where(y > 0.0, 0, 3), np.where(y > 0.0, 1, 2))
    return found.tolist() if sorted(found.tolist()) == [0, 1, 2, 3] and (x * y != 0.0).all() else []


def uncontrolled(allocation: ArrayLike) -> str:
    """The axes about which rotors make no torque of their own, for a message; "" where they control all.

    ``allocation`` is (*, k, n), of which the first four rows count, as of :func:`matrix`. With rows of one length,
    drones have conditions below 100; rounding makes rotors on one line look controllable.
    """
    given = np.asarray(allocation, float)
    rows = given[..., :4, :].reshape(-1, 4, given.shape[-1])
    rows = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-30)
    left, strength, _ = np.linalg.svd(rows, full_matrices=True)
    strength = np.pad(strength, ((0, 0), (0, 4 - strength.shape[1])))
    weak = ~(strength > 1e-4 * strength[:, :1])
    lacks = np.any(np.abs(left) * weak[:, None, :] > 0.1, axis=(0, 2)).tolist()
    lacks[0] = lacks[0] and not any(lacks[1:])  # of a thrust that comes with a torque, the torque is lacking
    return " and ".join(", ".join(AXES[lacks]).rsplit(", ", 1))
