"""What follows from the numbers of a drone: whether there can be one, where its rotors push, how its rate loop answers.

Nothing here imports torch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_quad.errors import shown

Array = NDArray[np.float64]
AXES = np.array(["thrust", "roll", "pitch", "yaw"])
NEARLY_LINEAR = 1e-3  # of a thrust map, k2 / k1 times the highest speed, below which single precision loses the speed
MOST_LIFT = 100.0  # times the weight; rpm for rad/s make 90 times as much as is true
INTEGRAL_SHARE = 0.1  # an integral as firmware has it: I is P times this share of the bandwidth without it

JUDGED = ("mass", "inertia", "rotor_positions", "thrust_map", "rotor_speed_min", "rotor_speed_max")


def contradictions(fields: Mapping[str, ArrayLike]) -> Iterator[str]:
    """Why there is no drone with these fields, of one drone or (n, ...) of several, in words."""
    drone = {name: np.asarray(fields[name], float) for name in JUDGED}
    inertia, k2, k1 = drone["inertia"], drone["thrust_map"][..., 0], drone["thrust_map"][..., 1]
    mass, low, high = (drone[x].reshape(-1) for x in ("mass", "rotor_speed_min", "rotor_speed_max"))
    units = "Check the order of the axes and the unit (1 g cm2 is 1e-7 kg m2), or give another inertia"
    if (twisted := 2.0 * inertia.max(-1) > inertia.sum(-1) * (1.0 + 1e-5)).any():
        worst = listed(inertia[twisted])
        yield f"inertia {worst} kg m2: in a body none of the three exceeds the sum of the others. {units}"
    arm = np.sqrt((drone["rotor_positions"] ** 2).sum(-1)).max(-1)
    radius = np.sqrt(inertia.max(-1) / mass)
    if (unlike := (radius > 2.0 * arm) | (arm > 10.0 * radius)).any():
        worst = unlike.argmax()
        arm, radius, one = (np.broadcast_to(x, unlike.shape).flat[worst] for x in (arm, radius, mass))
        inertia = np.broadcast_to(inertia, (*unlike.shape, 3))[worst]
        yield (
            f"inertia {listed(inertia)} kg m2: with a mass of {one:.4g} kg it is that of a ring of {radius:.3g} m "
            f"radius, and the farthest rotor is {arm:.3g} m from the centre. {units}; mass is in kg, rotor_positions "
            "in m"
        )
    if not (low < high).all():
        yield f"rotor_speed_min must be below rotor_speed_max, got {listed(low)} and {listed(high)}"
    slow, fast = k1 + 2.0 * k2 * low, k1 + 2.0 * k2 * high
    if not ((slow >= 0.0) & (fast >= 0.0) & (slow + fast > 0.0)).all():
        yield (
            "thrust_map must rise with rotor speed: k1 + 2 k2 w is "
            f"{listed(slow)} at rotor_speed_min and {listed(fast)} at rotor_speed_max"
        )
    lift = drone["rotor_positions"].shape[-2] * (k2 * high + k1) * high / (9.81 * mass)
    if (lift > MOST_LIFT).any():
        yield (
            f"its rotors would lift {lift.max():.0f} times the weight. rotor_speed_max and thrust_map are in rad/s, of "
            f"which 60 rpm are {2.0 * np.pi:.4g}, and mass is in kg"
        )
    least = NEARLY_LINEAR * abs(k1) / high
    if (abs(k2) < least).any():
        yield (
            f"thrust_map must bend, so that a speed follows from a thrust: k2 is {listed(k2)}. Write "
            f"{1.1 * least.max():.2g}, which changes thrust by 0.1 %"
        )


def listed(x: ArrayLike) -> str:
    """Numbers in four digits."""
    return shown([float(f"{value:.4g}") for value in np.asarray(x, float).flat])


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
    return found.tolist() if sorted(found.tolist()) == [0, 1, 2, 3] and (abs(x * y) > 0.0).all() else []


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


class RateLoop:
    """The rate loop as it is flown, in steps, about each body axis, in arrays (3), or (n, 3) for several drones.

    About hover a physics step of dt takes the body rate w and the angular acceleration A of an axis to

    .. math:: \\begin{pmatrix} w \\\\ A \\end{pmatrix} \\leftarrow \\begin{pmatrix} 1 & dt \\\\
        -(1 - a) K & a - (1 - a) D / J \\end{pmatrix} \\begin{pmatrix} w \\\\ A \\end{pmatrix}
        + \\begin{pmatrix} 0 \\\\ (1 - a) K \\end{pmatrix} w^c, \\qquad a = e^{-dt / \\tau_m},

    with every integrator: the present rotor speeds turn the body, while the controller commands the next ones.

    Args:
        gain: K [1/s].
        inertia: J [kg m2].
        damping: D [kg m2], on the angular acceleration.
        motor_time_constant: (1) or (n, 1) [s]. Of two, for speeding up and slowing down, half of the rotors have each:
            the loop then overshoots by up to 0.02 more of the step than this says.
        dt: the physics step [s]; 0 is continuous time.

    Attributes:
        poles: (\\*, 2), the eigenvalues of the step; within the unit circle the loop is stable.
        natural_frequency: [rad/s].
        damping_ratio: 1 and more where no pole rings.
    """

    def __init__(
        self, gain: ArrayLike, inertia: ArrayLike, damping: ArrayLike, motor_time_constant: ArrayLike, dt: float
    ) -> None:
        gain, inertia, damping, tau = (np.asarray(x, float) for x in (gain, inertia, damping, motor_time_constant))
        self.dt = max(dt, 1e-6 * float(np.min(tau)))
        share = np.mean(-np.expm1(-self.dt / np.atleast_1d(tau)), -1, keepdims=True)  # 1 - a
        # Of a pole z the distance y = 1 - z solves y^2 - m y + g = 0, which keeps its digits in short steps.
        self._m, self._g = share * (1.0 + damping / inertia), share * gain * self.dt
        root = np.sqrt(0.25 * self._m**2 - self._g + 0j)
        root = np.where(abs(root) < 1e-6 * self._m, 1e-6 * self._m, root)  # two equal poles, a little apart
        y = 0.5 * self._m[..., None] + np.stack((-root, root), -1)
        self._error = y[..., 1] / (y[..., 1] - y[..., 0])  # of a step of the command: twice its part along the first
        self.poles = 1.0 - y
        s = np.log1p(np.where(abs(self.poles) < 1e-12, 1e-12 - 1.0, -y)) / self.dt  # as of continuous time
        rings = (self.poles.imag != 0.0) | (self.poles.real < 0.0)
        self.natural_frequency = np.sqrt(abs(s.prod(-1)))
        ringing = (-s.real / abs(s)).min(-1)
        self.damping_ratio = np.where(rings.any(-1), ringing, -s.real.sum(-1) / (2.0 * self.natural_frequency))
        self.is_stable = (abs(self.poles) < 1.0).all(-1)

    @property
    def bandwidth(self) -> Array:
        """At which the answer to a sine has fallen by 3 dB [rad/s]; at most that of one change of sign in each step."""
        m, g = self._m, self._g
        d = 1.0 - m + g  # the product of the poles
        b = (m - g) ** 2 - g * (2.0 - m + g)  # u = 1 - cos(w dt) solves 4 d u^2 + 2 b u = g^2
        u = g**2 / np.maximum(b + np.sqrt(np.maximum(b**2 + 4.0 * d * g**2, 0.0)), 1e-300)
        return 2.0 * np.arcsin(np.sqrt(np.clip(0.5 * u, 0.0, 1.0))) / self.dt

    @property
    def overshoot(self) -> Array:
        """By which the rate exceeds a small step of the command at most, as a share of it; infinite where unstable."""
        first, second = np.moveaxis(np.where(self.is_stable[..., None], self.poles, 0.5), -1, 0)
        angle, phase = np.angle(first), np.angle(self._error)
        early = np.arange(2.0, 8.0)  # where poles lie on the negative axis
        turn = (np.pi + np.arctan2(np.log(abs(first)), angle) - phase) / np.maximum(angle, 1e-9)
        steps = [turn // 1.0, turn // 1.0 + 1.0, *(np.full_like(turn, k) for k in early)]
        error = [self._error * first**k + (1.0 - self._error) * second**k for k in steps]
        return np.where(self.is_stable, np.maximum(-np.real(error).min(0), 0.0), np.inf)
