"""What an autopilot must be told so that its rate loop and its throttle are those of the training.

Betaflight's settings were read in its source and fly, in ``simulator=betaflight``. Those of PX4 and Crazyflie follow
from what their mixers do with a torque, also read in the source; they have not flown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchrl_quad.airframe import Array, quarters
from torchrl_quad.deploy import frames
from torchrl_quad.deploy.contract import AUTOPILOTS, Contract
from torchrl_quad.deploy.network import fill_in
from torchrl_quad.deploy.simulators.vehicle import Drone, PIDLoop

AXES = ("roll", "pitch", "yaw")
MIN_CHECK = 1050  # [us], Betaflight's default
TUNE = "# -- The rate loop"  # what begins the second part of betaflight.txt
MOST_GAIN = 250  # that Betaflight takes
UNTRIED = "for the policy of the task {!r}. Not flown: try gains on a stand, and that rotors turn as README.md says."


class Throttle(NamedTuple):
    """The thrust of all rotors at a signal s of the motors, 0 to 1: full_thrust (f s^2 + (1 - f) s) [N]."""

    full_thrust: float
    model_factor: float  #: f
    hover: float  #: the signal that hovers


def fit(contract: Contract) -> bool:
    """Whether there are parameters for a contract: of an X quadrotor whose rotors lag."""
    drone = contract["drone"]
    tilted = any(up[:2] != [0.0, 0.0] for up in drone.get("rotor_direction", []))
    return contract["rate_loop"] is not None and bool(quarters(drone["rotor_positions"])) and not tilted


def files(contract: Contract) -> dict[str, str]:
    """The parameters that go with a bundle by the names of their files, where they fit."""
    written = (betaflight(contract), px4(contract), crazyflie(contract)) if fit(contract) else ()
    return dict(zip(AUTOPILOTS, written, strict=False))


def throttle(drone: Drone, idle: float) -> Throttle:
    """The curve of a drone whose rotors turn at their least speed at the signal ``idle``, and faster in proportion:
    exact at hover, and nearest (least squares) over the thrusts that a policy commands."""
    low, high = drone.rotor_speed_min, drone.rotor_speed_max
    most = min(drone.max_thrust_to_weight * drone.weight, len(drone.rotor_spin) * drone.thrust_limits[1])
    thrusts = np.linspace(0.0, most, 101)
    speeds = np.append(drone.speed(thrusts / len(drone.rotor_spin)), drone.hover_speed.mean())
    *signals, hover = idle + (1.0 - idle) * np.clip((speeds - low) / (high - low), 0.0, 1.0)
    factors = np.linspace(0.0, 1.0, 1001)[:, None]
    full = drone.weight / (factors * hover**2 + (1.0 - factors) * hover)
    found = full * (factors * np.square(signals) + (1.0 - factors) * signals)
    best = np.square(found - thrusts).sum(1).argmin()
    return Throttle(float(full[best, 0]), float(factors[best, 0]), float(hover))


def gains(drone: Drone, newtons: float | Array) -> Array:
    """P, I and D of each axis (3, 3), as :class:`~torchrl_quad.deploy.simulators.vehicle.PIDLoop` has them, in rad and
    s, where one unit of output about an axis changes the thrust of each rotor by so many newtons."""
    loop = PIDLoop(drone, 0.001)
    return np.stack((loop.gain, loop.integral_gain, drone.rate_damping), 1) / np.reshape(
        newtons * np.abs(drone.allocation[1:4]).sum(1), (3, 1)
    )


def tilt_gains(contract: Contract) -> dict[str, float]:
    """P of roll and pitch [1/s] of the loop around the rate loop, where actions command attitudes or velocities."""
    return dict(zip(AXES, contract["output"]["gains"].get("tilt_gain", ()), strict=False))


def idle(drone: Drone) -> float:
    """The signal of Betaflight's motors at the least rotor speed, as it counts it: in 0.01 %."""
    return round(1e4 * drone.rotor_speed_min / drone.rotor_speed_max) / 1e4


def stick_rate(contract: Contract) -> int:
    """What a full stick of Betaflight commands [deg/s]: a multiple of 10, as it counts."""
    return 10 * int(np.ceil(np.max(contract["drone"]["max_body_rate"]) * frames.DEGREES / 10.0 - 1e-6))


def betaflight(contract: Contract) -> str:
    """``betaflight.txt``: lines for the command line of Betaflight 4.6, with their reasons."""
    drone, rate = Drone(contract["drone"]), stick_rate(contract)
    least = idle(drone)
    curve = throttle(drone, least)
    slope = 2.0 * drone.thrust_map[0] * (drone.hover_speed.mean() - drone.vertex_speed)  # of a rotor [N s/rad]
    found = gains(drone, slope * (drone.rotor_speed_max - drone.rotor_speed_min)) * 1000.0 / frames.DEGREES
    found /= np.outer((1.0, 1.0, 1.0), (0.032029, 0.244381, 0.000529))  # PTERM_SCALE, ITERM_SCALE, DTERM_SCALE
    found[2, 1] /= 2.5  # by which it multiplies I of yaw
    lines = []
    for axis, (p, i, d) in zip(AXES, np.rint(found).astype(int).tolist(), strict=True):
        for name, value in {"p": p, "i": i, "d": d, "d_max": d, "f": 0}.items():
            lines += [f"# The rule says {value}."] * (value > MOST_GAIN)
            lines.append(f"set {name}_{axis} = {min(value, MOST_GAIN)}")
    front_left = contract["drone"]["rotor_spin"][quarters(drone.rotor_positions).index(0)]
    rates = {"rc_rate": rate // 10, "srate": rate // 10, "expo": 0}
    values = {
        "task": contract["task"]["name"],
        "rate": rate,
        "rates": "\n".join(f"set {axis}_{name} = {value}" for axis in AXES for name, value in rates.items()),
        "min_check": MIN_CHECK,
        "idle": f"{least:.4f}",
        "motor_idle": round(1e4 * least),
        "full_thrust": f"{curve.full_thrust:.4g}",
        "model_factor": f"{curve.model_factor:.4g}",
        "hover": f"{100.0 * curve.hover:.1f}",
        "reversed": "OFF" if front_left > 0.0 else "ON",
        "gains": "\n".join(lines),
    }
    return fill_in("betaflight.txt", values, ())


def px4(contract: Contract) -> str:
    """``px4.params`` of QGroundControl. One unit of roll or pitch changes motors by 1 / sqrt(2) of their thrust, the
    larger one of both where levers differ, and one of yaw by 1; PX4 undoes the thrust curve."""
    drone = Drone(contract["drone"])
    curve, lever = throttle(drone, 0.0), np.abs(drone.allocation[1:3]).sum(1)
    unit = 0.25 * curve.full_thrust * np.array([*(0.5**0.5 * lever.min() / lever), 1.0])
    values = {
        f"MC_{axis.upper()}RATE_{name}": value
        for axis, row in zip(AXES, gains(drone, unit), strict=True)
        for name, value in zip("PIDK", (*row, 1.0), strict=True)
    }
    values |= {f"MC_{axis.upper()}_P": gain for axis, gain in tilt_gains(contract).items()}
    values |= {"MC_YAW_TQ_CUTOFF": 0.0, "THR_MDL_FAC": curve.model_factor}
    values["MPC_THR_HOVER"] = drone.weight / curve.full_thrust
    lines = [f"1\t1\t{name}\t{value:.6g}\t9\n" for name, value in values.items()]
    return f"# PX4 {UNTRIED.format(contract['task']['name'])}\n" + "".join((*lines, "1\t1\tMC_AIRMODE\t1\t6\n"))


def crazyflie(contract: Contract) -> str:
    """``crazyflie.txt``: parameters of its rate controller, whose output adds to the thrust command of each motor, half
    of it about roll and pitch."""
    drone = Drone(contract["drone"])
    found = gains(drone, drone.thrust_limits[1] / 65535.0 * np.array([0.5, 0.5, 1.0])) / frames.DEGREES
    tilts = tilt_gains(contract)
    lines = [f"flightmode.stabMode{axis.capitalize()}={int(axis in tilts)}\n" for axis in AXES]
    lines += [f"pid_attitude.{a}_kp={k:.4g}\npid_attitude.{a}_ki=0\npid_attitude.{a}_kd=0\n" for a, k in tilts.items()]
    for axis, row in zip(AXES, found, strict=True):
        lines += [f"pid_rate.{axis}_k{name}={value:.4g}\n" for name, value in zip("pid", row, strict=True)]
    return f"# Crazyflie {UNTRIED.format(contract['task']['name'])}\n" + "".join(lines)
