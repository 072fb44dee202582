"""The gains of the rate loop: which ones suit a drone in the steps of a simulation, and which are refused."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.airframe import Array, RateLoop, listed
from torchrl_quad.dynamics.control import FlightController
from torchrl_quad.dynamics.parameters import QuadrotorParams, read_drone, read_fields
from torchrl_quad.dynamics.rigid_body import Rotors
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import between, checked

# [s]. In a shorter step a drone at 1 m/s does not move in single precision; with a longer one the rate loop of no drone
# that ships is stable.
PhysicsStep = Annotated[float, between(1e-6, 0.1)]
MAX_SUBSTEPS = 200  # physics steps of a control step, which take half a second without compilation
FAR = 0.15  # of a step of the command
STRONG = 5.0  # times the torque of the rotors
WELL_DAMPED = 0.8  # a damping ratio with which a step of the command overshoots by 2 %


def rate_loop(drone: QuadrotorParams, dt: float, **changed: Array) -> RateLoop:
    """The rate loop of a drone in physics steps of dt [s]; fields of the loop may be others than its own."""
    names = {"gain": "rate_gain", "inertia": "inertia", "damping": "rate_damping", "motor_time_constant": ""}
    fields = {k: _numbers(getattr(drone, name or k)) for k, name in names.items()}
    return RateLoop(**{**fields, **changed}, dt=dt)


@checked
def suggest_gains(drone: str | Path | Mapping | QuadrotorParams, dt: PhysicsStep = 0.005) -> dict[str, Tensor]:
    """Gains of the rate loop for a drone whose own are unknown: ``drone.replace(**suggest_gains(drone))``.

    The loop gets about the greatest bandwidth with which its damping ratio is at least 0.8 in these steps and, at
    hover, a command of the full body rate asks for no more torque than the rotors have. D is at most J.

    Args:
        drone: :class:`QuadrotorParams`, a preset, a YAML file or a mapping, which may leave out the gains.
        dt: the physics step of the environment, 1e-6 to 0.1 s.

    Returns:
        ``rate_gain`` [1/s] and ``rate_damping`` [kg m2], each (3), or (num_envs, 3) for several drones.

    Raises:
        ValueError: the drone cannot be, or cannot hover.
    """
    if isinstance(drone, QuadrotorParams):
        params = drone
    else:
        source, fields = read_fields(drone)
        params = read_drone({"rate_gain": [1.0] * 3, "rate_damping": [0.0] * 3, **fields}, torch.float64, source)
    inertia = _numbers(params.inertia)
    most = _numbers(FlightController(params).spare_torque()) / _full_torque(params)
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


def check_gains(controller: FlightController, dt: float, substeps: int) -> None:
    """Refuse a nominal drone whose rate loop does not fly as its gains say, in physics steps of dt [s].

    That is one that is unstable; or overshoots a small step of the command by 0.15 of it more than in continuous time;
    or asks, for the full body rate, for more than five times the torque that the rotors have at hover. Policies learn
    with shipped drones, at up to three times it, and with Gazebo's iris at four, but not at nine.
    """
    nominal = controller.nominal
    loop, smooth = rate_loop(nominal, dt), rate_loop(nominal, 0.0).overshoot
    asked = _full_torque(nominal) * _numbers(nominal.rate_gain) / _numbers(controller.spare_torque())
    strong = asked > STRONG
    bad = strong | ~(loop.overshoot <= smooth + FAR)
    if not bad.any():
        return
    row = np.atleast_2d(bad).any(-1).argmax()  # the first such drone, of several

    def of(x: Any) -> Array:
        numbers = np.atleast_2d(_numbers(x) if isinstance(x, Tensor) else x)
        return numbers[min(row, len(numbers) - 1)]

    axes = " and ".join(np.array(["roll", "pitch", "yaw"])[of(bad)])
    worst, by, torque = (of(x)[of(bad)].max() for x in (loop.overshoot, smooth, asked))
    rings = f"overshoots by {worst:.0%} (in continuous time by {by:.0%})"
    what = "is unstable" if np.isinf(worst) else rings if worst > by + FAR else ""
    much = f"asks at full rate for {torque:.1f} times the torque that the rotors have at hover"
    what = " and ".join(x for x in (what, much if torque > STRONG else "") if x)
    found = {k: np.where(of(bad), of(x), of(getattr(nominal, k))) for k, x in suggest_gains(nominal, dt).items()}
    mend = " and ".join(f"{name}: {listed(x)}" for name, x in found.items())
    for k in () if strong.any() else range(2, MAX_SUBSTEPS // substeps + 1):
        if (rate_loop(nominal, dt / k).overshoot <= smooth + FAR).all():
            mend += f", or dt={dt / k:.10g}"
            break
    raise UserValueError(
        f"drone: in steps of dt={dt:g} s the rate loop about {axes} {what}, with rate_gain "
        f"{listed(of(nominal.rate_gain))} 1/s, rate_damping {listed(of(nominal.rate_damping))} kg m2 and motors of "
        f"{listed(of(nominal.motor_time_constant))} s. Write {mend}."
    )


def check_flown(controller: FlightController, flown: QuadrotorParams, dt: float) -> None:
    """Refuse a drone that flies, if with its body, motors and rotors the rate loop is unstable in steps of dt [s].

    How well it is damped is left to the drone: a policy has to bear that.
    """
    nominal, rotors, speed = controller.nominal, Rotors(flown), controller.hover_speed
    steeper = rotors.curvature * (speed - rotors.vertex_speed)  # of thrust over speed, beside what the mixer expects
    steeper = steeper / (controller.rotors.curvature * (speed - controller.rotors.vertex_speed))
    torque = rotors.allocation[..., 1:4, :] * steeper.unsqueeze(-2) * controller.mixer[..., 1:4].mT
    stronger = _numbers(torque.sum(-1))  # than what is asked for, about each axis at hover
    believed, true = ((_numbers(x.inertia), _numbers(x.motor_time_constant)) for x in (nominal, flown))
    gain = _numbers(nominal.rate_gain) * believed[0] / true[0] * stronger
    if not rate_loop(nominal, dt, gain=gain, motor_time_constant=true[1]).is_stable.all():
        parts = (
            ("an inertia of {} kg m2", true[0], believed[0]),
            ("motors of {} s", true[1], believed[1]),
            ("rotors that give {} times the torque", stronger.round(2), np.ones_like(stronger)),
        )
        apart = [(how.format(listed(x)), listed(y)) for how, x, y in parts if not np.allclose(x, y, rtol=1e-3)]
        raise UserValueError(
            f"drone: in steps of dt={dt:g} s the rate loop is unstable with {', '.join(x for x, _ in apart)}, since "
            f"its gains are for {', '.join(y for _, y in apart)}. "
            + ("List its rotors in the order of the controller's. " if (stronger < 0.2).any() else "")
            + "Choose them nearer to these, a smaller dt, or a drone with a lower rate_gain."
        )


def _full_torque(drone: QuadrotorParams) -> Array:
    """What the full body rate asks for at first [N m], with a gain of 1 1/s."""
    return _numbers(drone.inertia * drone.max_body_rate)


def _numbers(x: Any) -> Array:
    return x.detach().double().cpu().numpy()
