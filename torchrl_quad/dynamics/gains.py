"""The gains of the rate loop: which ones suit a drone in the steps of a simulation, and which are refused."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.dynamics.control import FlightController
from torchrl_quad.dynamics.parameters import QuadrotorParams, load_drone
from torchrl_quad.options import between, checked
from torchrl_quad.rate_loop import Array, RateLoop

# [s]. In a shorter step a drone at 1 m/s does not move in single precision; with a longer one the rate loop of no drone
# that ships is stable.
PhysicsStep = Annotated[float, between(1e-6, 0.1)]
WELL_DAMPED = 0.8  # a damping ratio with which a step of the command overshoots by 2 %


def rate_loop(drone: QuadrotorParams, dt: float, **changed: Array) -> RateLoop:
    """The rate loop of a drone in physics steps of dt [s]; gain or damping may be others than its own."""
    names = {"gain": "rate_gain", "inertia": "inertia", "damping": "rate_damping", "motor_time_constant": ""}
    fields = {k: _numbers(getattr(drone, name or k)) for k, name in names.items()}
    return RateLoop(**{**fields, **changed}, dt=dt)


@checked
def suggest_gains(drone: str | Path | Mapping | QuadrotorParams, dt: PhysicsStep = 0.005) -> dict[str, Tensor]:
    """Gains of the rate loop for a drone whose own are unknown: ``drone.replace(**suggest_gains(drone))``.

    The loop gets the greatest bandwidth with which its damping ratio is at least 0.8 in these steps and, at hover, a
    command of the full body rate asks for no more torque than the rotors have. D is at most J.

    Args:
        drone: :class:`QuadrotorParams`, or what :func:`load_drone` takes; a mapping may leave out the gains.
        dt: the physics step of the environment, 1e-6 to 0.1 s.

    Returns:
        ``rate_gain`` [1/s] and ``rate_damping`` [kg m2], each (3), or (num_envs, 3) for several drones.

    Raises:
        ValueError: the drone cannot be, or cannot hover.
    """
    if isinstance(drone, Mapping):
        drone = {"rate_gain": [1.0] * 3, "rate_damping": [0.0] * 3, **drone}
    params = drone if isinstance(drone, QuadrotorParams) else load_drone(drone, torch.float64)
    inertia = _numbers(params.inertia)
    torque = _numbers(FlightController(params).spare_torque())
    most = torque / (inertia * _numbers(params.max_body_rate))
    gain, ratio, best = np.zeros_like(most), np.zeros_like(most), np.zeros_like(most)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        low, high = np.zeros_like(most), most
        for _ in range(40):
            middle = 0.5 * (low + high)
            fits = rate_loop(params, dt, gain=middle, damping=share * inertia).damping_ratio >= WELL_DAMPED
            low, high = np.where(fits, middle, low), np.where(fits, high, middle)
        width = rate_loop(params, dt, gain=np.maximum(low, 1e-3), damping=share * inertia).bandwidth
        better = width > 1.05 * best
        gain, ratio, best = (np.where(better, x, y) for x, y in ((low, gain), (share, ratio), (width, best)))
    unit = 10.0 ** (np.floor(np.log10(np.maximum(gain, 1e-3))) - 1.0)  # of its second digit
    found = {"rate_gain": np.maximum(np.floor(gain / unit) * unit, 1e-3), "rate_damping": ratio * inertia}
    return {name: torch.from_numpy(x).to(params.mass) for name, x in found.items()}


def _numbers(x: Any) -> Array:
    return x.detach().double().cpu().numpy()
