"""What seconds of flight say of a drone and its air: rotors, inertia and wind, by least squares with a prior."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.data.unwrap import leaf
from torchrl_quad.dynamics import MotorCommand, QuadrotorParams
from torchrl_quad.dynamics.parameters import RawParams
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs import QuadrotorEnv
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.identification import FlightLog, NotOneDrone, prediction
from torchrl_quad.identification.estimation import held_out

#: The unknowns of a fit in the order of its coordinates: how many, how far they may lie from zero (one standard
#: deviation, before the flight), and what a flight needs to tell them.
UNKNOWNS: dict[str, tuple[int, float, str]] = {
    "rotors": (4, 0.3, "motors that carry the drone"),  # thrust and torque of each, relative to the simulator's
    "turning": (3, 0.3, "quick turns about the axis"),  # angular acceleration about each axis, likewise
    "wind": (2, 5.0, "a drone whose drag is known"),  # along x and y at the mean height [m/s]
    "shear": (2, 1.0, "flight at several heights"),  # growth of the wind with height [1/s]
}
_SIZES = [size for size, _, _ in UNKNOWNS.values()]
_PRIOR = torch.cat([torch.full((size,), spread, dtype=torch.float64) for size, spread, _ in UNKNOWNS.values()])
_GROUPS = {"rotors": range(4), "turning.x": [4], "turning.y": [5], "turning.z": [6], "wind": [7, 8], "shear": [9, 10]}
WINDOW = 0.1  # [s], over which accelerations are averaged
_CORRELATED = 4.0  # windows in a row that err alike
_LEAST = torch.tensor([0.02] * 3 + [0.1] * 3, dtype=torch.float64)  # error of a window: [m/s2] and [rad/s2]
# How far flights of one drone may lie apart when each is fitted by itself: rotors 0.25, wind 3 m/s. Eight flights of
# one Crazyflie differ by up to 0.21 and 0.8 m/s.
_APART = torch.tensor([0.25] * 4 + [torch.inf] * 3 + [3.0] * 2 + [torch.inf] * 2, dtype=torch.float64)
WORSE = 2.0  # ratio of squared errors of a flight, of a fit to several and of the simulator, that tells the same
COMMON = (0.6, 1.2)  # of the thrust, which a payload or tired motors may change; all else is another drone or command
LARGEST = 3.0  # [m/s2], the median error of a fit in the acceleration of a flight
_STEPS = 6  # of Gauss and Newton; the wind's drag is quadratic, all else nearly linear


@dataclasses.dataclass(frozen=True)
class FlightFit:
    """A drone and its air as flights show them, a normal distribution of the unknowns about ``mean``."""

    prior: QuadrotorParams  #: the simulator's drone, which all is relative to
    mean: Tensor  #: (11), in the order of UNKNOWNS
    root: Tensor  #: (11, 11), of the covariance
    height: tuple[float, float]  #: [m], the mean flown, and how far the flight went to either side of it
    not_told: Mapping[str, str]  #: what the flights leave open, and why; it is as in the simulator
    before: Mapping[str, float]  #: rms errors of the acceleration [m/s2] and angular acceleration [rad/s2], held out
    after: Mapping[str, float]  #: the same, of the fit
    gain: float  #: how much better it predicts what was held out, 1 - the ratio of weighted squares

    def fields(self, x: Tensor) -> dict[str, Tensor]:
        """The parameters of the drone that differ from the simulator's, at unknowns (*, 11)."""
        rotors, turning, _, _ = x.split(_SIZES, -1)
        inertia = self.prior.inertia.to(x) / (1.0 + turning).clamp_min(0.1)
        return {
            "rotor_effectiveness": self.prior.value("rotor_effectiveness").to(x) * (1.0 + rotors).clamp_min(0.05),
            "inertia": torch.minimum(inertia, inertia.sum(-1, keepdim=True) - inertia),
        }

    def air(self, x: Tensor) -> Tensor:
        """The wind at the mean height, its growth with height, and these heights: (*, 6), as ``wind_at`` reads them."""
        _, _, wind, shear = x.split(_SIZES, -1)
        return torch.cat((wind, shear, x.new_tensor(self.height).expand(*x.shape[:-1], 2)), -1)

    @property
    def thrust(self) -> float:
        """Of all rotors together, relative to the simulator's drone."""
        return 1.0 + float(self.mean[:4].mean())

    def drone(self) -> QuadrotorParams:
        """The drone as the flights show it."""
        changes = {name: x.tolist() for name, x in self.fields(self.mean).items()}
        return self.prior.replace(**changes)

    def spread(self) -> Tensor:
        """The standard deviation of each unknown (11)."""
        return self.root.square().sum(1).sqrt()


def wind_at(air: Tensor, position: Tensor) -> Tensor:
    """The wind (*, 3) [m/s] at positions (*, 3); beyond the heights that were flown it is as at their end."""
    wind, shear, mean, reach = air.split((2, 2, 1, 1), -1)
    above = (position[..., 2:] - mean).maximum(-reach).minimum(reach)
    return torch.nn.functional.pad(wind + shear * above, (0, 1))


class Flown(Disturbance):
    """Draw the drone and the wind of each episode from a :class:`FlightFit`, as it is when the episode begins.

    Entries of the state: ``("drone", "rotor_effectiveness")``, ``("drone", "inertia")``, ``wind`` (3) [m/s] and
    ``air`` (6), from which the wind follows.
    """

    follows_params = True

    def __init__(self, prior: QuadrotorParams) -> None:
        nothing = torch.zeros(len(_PRIOR))
        self.fit = FlightFit(prior, nothing, torch.diag(nothing), (0.0, 0.0), {}, {}, {}, 0.0)

    def start(self, random: Randomness, state: State) -> State:
        """Draw."""
        drawn = random.normal(len(state["position"]), len(_PRIOR)) @ self.fit.root.T.to(state["position"])
        x, air = drawn + self.fit.mean.to(drawn), {}
        air["air"] = self.fit.air(x)
        air["wind"] = wind_at(air["air"], state["position"])
        return air | {("drone", name): value for name, value in self.fit.fields(x).items()}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        """Blow as the height says."""
        return {"wind": wind_at(state["air"], state["position"])}


def fit_flight(logs: Sequence[FlightLog], drone: QuadrotorParams, motors: MotorCommand) -> FlightFit:
    """Fit rotors, inertia and wind to the mean accelerations of short windows of flights.

    Each window asks that the accelerations of the model, averaged over a tenth of a second, be those of the flight.
    They are nearly linear in the unknowns, so that a few weighted ridge regressions solve for all of them. What the
    flights leave as open as it was before is set back to the simulator's. A fifth of the windows is held out.

    Args:
        logs: flights of the same drone in the same air.
        drone: the simulator's drone.
        motors: from the commands in the logs to rotor speeds.

    Raises:
        TooShort: no piece of a flight is long enough for a window.
        NotOneDrone: the flights are not of one drone in one air, or not of this drone by these motor commands.
    """
    prior = prediction.as_params(drone)
    windows = prediction.cut(logs, 0.02, WINDOW, WINDOW, nominal_voltage=motors.nominal_voltage)
    late = torch.tensor([prediction.stream_delay(log) for log in logs], dtype=torch.float64)[windows.log]
    plant = prediction.plant_of(prior, motors, late)
    speed, held = windows.rotor_speed(plant), held_out(windows)
    z = windows.motion[windows.log, windows.start, 2]
    nothing = torch.zeros_like(_PRIOR)
    height = float(z.mean()), float((z - z.mean()).abs().max())
    fit = FlightFit(prior, nothing, torch.diag(nothing), height, {}, {}, {}, 0.0)

    def errors(x: Tensor) -> Tensor:  # (W, 6): linear and angular, body frame
        flown = plant._replace(params=RawParams(**{**prior.fields(), **fit.fields(x)}))
        return torch.cat(windows.push(flown, speed, lambda s: wind_at(fit.air(x), s.position)), -1)

    open_ = {name: list(group) for name, group in _GROUPS.items()}
    while True:
        free = [i for group in open_.values() for i in group]
        x, cover, scale = _solve(errors, free, ~held)
        wide = {name for name, group in open_.items() if (cover.diag()[group].sqrt() > 0.5 * _PRIOR[group]).any()}
        if not wide:
            break
        open_ = {name: group for name, group in open_.items() if name not in wide}
    if len(logs) > 1 and free:
        _check_agreement(logs, [windows.log == k for k in range(len(logs))], errors, x, free, held)
    kept = [errors(nothing)[held], errors(x)[held]]
    squares = [_misses(e, scale) for e in kept]
    rms = [
        {"acceleration": float(e[:, :3].square().sum(1).mean().sqrt()),
         "angular_acceleration": float(e[:, 3:].square().sum(1).mean().sqrt())}
        for e in kept
    ]  # fmt: skip
    values, vectors = torch.linalg.eigh(cover)
    found = dataclasses.replace(
        fit,
        mean=x,
        root=vectors * values.clamp_min(0.0).sqrt(),
        not_told={name: UNKNOWNS[name.partition(".")[0]][2] for name in _GROUPS if name not in open_},
        before=rms[0],
        after=rms[1],
        gain=1.0 - squares[1] / squares[0],
    )
    if "rotors" in open_ and not COMMON[0] < found.thrust < COMMON[1]:
        raise NotOneDrone(
            f"all rotors together would give {found.thrust:.2f} of the thrust of the simulator's drone. Check its mass "
            "and thrust map, and what a motor command means (motor_command, the battery): no fit tells these apart."
        )
    if "rotors" in open_ and (left := float(kept[1][:, :3].norm(dim=1).median())) > LARGEST:
        raise NotOneDrone(
            f"the fit still misses the acceleration by {left:.2g} m/s2. Check the drone, the units "
            "of the log, and what a motor command means (motor_command)."
        )
    return found


def _check_agreement(
    logs: Sequence[FlightLog],
    rows: Sequence[Tensor],
    errors: Callable[[Tensor], Tensor],
    x: Tensor,
    free: list[int],
    held: Tensor,
) -> None:
    """Refuse flights of which one, by itself, shows another drone or wind than the fit x to all of them."""
    alone = [_solve(errors, free, ~held & own) for own in rows]
    apart = torch.stack([y for y, _, _ in alone])
    apart = (apart - apart.mean(0)).abs()
    before, after = errors(torch.zeros_like(x)), errors(x)
    for log, own, far, (_, cover, usual) in zip(logs, rows, apart, alone, strict=True):
        without, together = (_misses(e[held & own], usual) for e in (before, after))
        if (far > torch.maximum(0.5 * _APART, 5.0 * cover.diag().sqrt())).any() or together > WORSE * without:
            raise NotOneDrone(
                f"{log.name} does not agree with the others: by itself it shows another drone or wind. Give "
                "flights of one drone in one wind, or each by itself."
            )


def _misses(e: Tensor, scale: Tensor) -> float:
    """The mean square of errors (W, 6) in units of their usual size; below those of a good fit they say nothing."""
    return float((e / scale).square().clamp_max(100.0).mean().clamp_min(1.0))


def _solve(errors: Callable[[Tensor], Tensor], free: list[int], train: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The unknowns (11), of which only some are free, their covariance, and the scale of the errors (6)."""
    x, cover = torch.zeros_like(_PRIOR), torch.zeros(len(_PRIOR), len(_PRIOR), dtype=torch.float64)
    scale = _LEAST
    if not free:
        return x, cover, scale
    penalty = normal = torch.diag(_PRIOR[free] ** -2)
    for _ in range(_STEPS):
        e = errors(x)[train]
        slope = torch.func.jacfwd(errors)(x)[train][..., free]
        scale = torch.maximum(1.4826 * e.abs().median(0).values, _LEAST)
        weight = (2.0 * scale / e.abs().clamp_min(1e-12)).clamp_max(1.0) / scale.square() / _CORRELATED  # Huber's
        normal = torch.einsum("wci,wc,wcj->ij", slope, weight, slope) + penalty
        down = torch.einsum("wci,wc,wc->i", slope, weight, e) + penalty @ x[free]
        x = x.clone()
        x[free] -= torch.linalg.solve(normal, down)
    cover[torch.tensor(free)[:, None], torch.tensor(free)] = torch.linalg.inv(normal)
    return x, cover, scale


def simulated_log(rollout: TensorDictBase, env: QuadrotorEnv, drone: int = 0) -> FlightLog:
    """The first episode of one drone of a rollout as a log, of which ``env.params`` or ``MotorCommand(rotor_speed_max,
    1.0)`` say what its commands mean: those that make its rotors turn as they did, steady over a control step."""
    params, over = env.params, leaf(rollout, ("next", "done"))[drone, :, 0]
    steps = int(over.int().argmax()) + 1 if over.any() else len(over)
    state: dict[str, Any] = {
        name: leaf(rollout, ("state", name))[drone, :steps].double().cpu().numpy() for name in env.dynamics.sizes
    }
    motors = params.motor_command or MotorCommand(float(params.rotor_speed_max.max()), 1.0)
    speed = state.pop("rotor_speed")
    change = np.diff(speed, axis=0, append=speed[-1:])
    up, down = params.motor_time_constant.double().expand(2).tolist()
    wanted = speed + change / -np.expm1(-env.control_dt / np.where(change > 0.0, up, down))
    command = (wanted - motors.speed_at_zero) / (motors.speed_per_volt * motors.nominal_voltage)
    time: Any = env.control_dt * np.arange(steps)
    command = np.stack([np.interp(time + motors.delay, time, x) for x in command.T], 1).clip(0.0, 1.0)
    state |= {"time": time, "segments": ((0, steps),), "acceleration": None, "battery_voltage": None, "setpoint": None}
    state["motor_command"] = command[:, np.argsort(prediction.log_columns(params))]
    return FlightLog("simulated", **state, onboard=(), notes=("simulated",))
