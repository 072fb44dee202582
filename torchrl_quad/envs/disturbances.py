"""Make any task harder, or more realistic: other drones, wind, sensors, starts, and disturbances of your own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import QuadrotorParams, presets, quaternion
from torchrl_quad.dynamics.parameters import CONTROLLER_FIELDS, PLANT_FIELDS
from torchrl_quad.dynamics.presets import is_number, is_numbers
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.checks import MAX_DELAY, require_count
from torchrl_quad.envs.guard import MAX_ANGULAR_VELOCITY, MAX_SPEED
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.errors import UserValueError

_DISTRIBUTIONS = {
    "uniform": "low and high",
    "scale": "low and high, as factors of the nominal value",
    "normal": "mean and standard deviation, cut off at three of them",
}
MAX_WIND = 100.0  # [m/s]


class Disturbance:
    """The protocol of all disturbances. A new one overrides some methods; ``disturbances=[MyOwn()]`` switches it on.

    Its memory is in entries of the state, each (n, ...), which are restored, stored and compiled with it.
    An entry ``("drone", field)`` changes a parameter of the drone that flies, ``wind`` the air it flies in.
    """

    noise_size = 0  #: standard normal numbers that each environment needs for ``advance``

    def start(self, random: Randomness, state: State) -> State:
        """The entries that it adds to the start of an episode, or changes there; it draws from ``random`` alone."""
        return {}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        """The entries that a control step of dt [s] changes, from the state after it and noise (n, noise_size)."""
        return {}

    def observe(self, state: State) -> State:
        """The state as the policy sees it. Rewards, crashes and success use the true one."""
        return state

    def complaints(self, state: State) -> dict[str, Tensor]:
        """What is wrong with a state to start from, in words, and where it is wrong, bool (n)."""
        return {}


class DroneRandomization(Disturbance):
    """Fly another drone in each episode: any of its parameters, drawn at reset.

    A mapping, or a YAML file of one, from fields of :class:`~torchrl_quad.QuadrotorParams` to a distribution and its
    two numbers:

    .. code-block:: yaml

        mass: {scale: [0.8, 1.2]}                    # uniform factors of the nominal value, one per entry
        motor_time_constant: {uniform: [0.02, 0.05]}
        linear_drag: {normal: [0.005, 0.001]}        # cut off at three standard deviations

    "uniform" and "normal" give all entries of a field the same two numbers, "scale" each its own nominal value. The
    values drawn are entries of the state, ``("drone", field)``. The controller keeps the nominal drone.

    Raises:
        ValueError: a field or distribution is unknown, belongs to the controller, or may give an impossible drone.
    """

    def __init__(
        self, spec: str | Path | Mapping, nominal: QuadrotorParams, plant_fields: Sequence[str] = PLANT_FIELDS
    ) -> None:
        source, self.spec = presets.read("randomize", spec)
        fields = nominal.fields()
        for name, distribution in self.spec.items():
            if name in CONTROLLER_FIELDS:
                raise UserValueError(
                    f"{source}: {name!r} belongs to the flight controller, which keeps the nominal drone; a random one "
                    "would change nothing. Give another drone instead."
                )
            if name not in plant_fields or name == "rotor_spin":
                allowed = ", ".join(field for field in plant_fields if field != "rotor_spin")
                raise UserValueError(f"{source}: unknown field {name!r}. Choose from: {allowed}.")
            if not (
                isinstance(distribution, Mapping)
                and len(distribution) == 1
                and set(distribution) <= set(_DISTRIBUTIONS)
            ):
                choices = "; ".join(f"{key}: {numbers}" for key, numbers in _DISTRIBUTIONS.items())
                raise UserValueError(f"{source}: {name} needs one distribution of: {choices}; got {distribution!r}.")
            numbers = next(iter(distribution.values()))
            if not (is_numbers(numbers, 2) and numbers[1] >= (0.0 if "normal" in distribution else numbers[0])):
                kind = next(iter(distribution))
                raise UserValueError(f"{source}: {name} needs two numbers, {_DISTRIBUTIONS[kind]}; got {numbers!r}.")
        self.nominal = {name: fields[name] for name in self.spec}
        # The least and the greatest of each; and for what has to lie below something else, the other way round.
        for sign in (-1.0, 1.0):
            extreme = {
                name: self._value(name, torch.full_like(value, -sign if name == "rotor_speed_min" else sign))
                for name, value in self.nominal.items()
            }
            try:
                nominal.replace(**extreme)
            except ValueError as error:
                raise UserValueError(f"{source}: the drones that may be drawn are not all possible: {error}") from error

    def start(self, random: Randomness, state: State) -> State:
        """Draw a drone for each start."""
        drawn = {}
        for name, nominal in self.nominal.items():
            shape = (len(state["position"]), *nominal.shape[-QuadrotorParams.dim(name) :])
            is_normal = "normal" in self.spec[name]
            unit = random.normal(*shape).clamp(-3.0, 3.0) / 3.0 if is_normal else random.uniform(*shape)
            drawn["drone", name] = self._value(name, unit)
        return drawn

    def _value(self, name: str, unit: Tensor) -> Tensor:
        """From the range [-1, 1] to the one asked for."""
        (kind, (first, second)) = next(iter(self.spec[name].items()))
        if kind == "normal":
            return first + 3.0 * second * unit
        value = 0.5 * (first + second) + 0.5 * (second - first) * unit
        return value * self.nominal[name].to(value) if kind == "scale" else value


@dataclasses.dataclass(frozen=True)
class Wind(Disturbance):
    """Blow a mean wind in each episode, and gusts about it: a first-order Gauss-Markov process in time, per axis.

    Entries of the state: ``mean_wind`` and ``wind``, each (3) [m/s], world frame, held over a control step.

    Raises:
        ValueError: a value is negative, not finite, or has the wrong number of entries.
    """

    mean: Sequence[float] = (0.0, 0.0, 0.0)  #: [m/s], world frame
    spread: Sequence[float] = (0.0, 0.0, 0.0)  #: [m/s], to both sides of the mean; drawn at reset
    gust: float = 0.0  #: [m/s], standard deviation of the gusts
    gust_time: float = 1.0  #: [s], after which a gust has decayed to 1/e

    def __post_init__(self) -> None:
        for name in ("mean", "spread"):
            if not is_numbers(getattr(self, name), 3):
                raise UserValueError(f"wind: {name} must be three numbers [m/s], got {getattr(self, name)!r}.")
        if min(self.spread) < 0:
            raise UserValueError(f"wind: spread must not be negative, got {self.spread!r}.")
        if not (is_number(self.gust) and self.gust >= 0):
            raise UserValueError(f"wind: gust must be zero or positive [m/s], got {self.gust!r}.")
        if not (is_number(self.gust_time) and self.gust_time > 0):
            raise UserValueError(f"wind: gust_time must be positive [s], got {self.gust_time!r}.")
        strongest = max(abs(m) + s for m, s in zip(self.mean, self.spread, strict=True)) + 5.0 * self.gust
        if strongest > MAX_WIND:
            raise UserValueError(
                f"wind: mean, spread and five times the gust add up to {strongest:g} m/s; the model holds up to "
                f"{MAX_WIND:g} m/s."
            )

    @property
    def noise_size(self) -> int:
        """Gusts need one number for each axis."""
        return 3 if self.gust else 0

    def start(self, random: Randomness, state: State) -> State:
        """Draw mean winds, and gusts in their steady state."""
        n = len(state["position"])
        mean = random.tensor(self.mean) + random.tensor(self.spread) * random.uniform(n, 3)
        return {"mean_wind": mean, "wind": mean + self.gust * random.normal(n, 3) if self.gust else mean.clone()}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        """The wind a time dt [s] later."""
        if noise is None:
            return {}
        decay = math.exp(-dt / self.gust_time)
        gust = self.gust * math.sqrt(1.0 - decay * decay) * noise
        return {"wind": torch.lerp(state["mean_wind"], state["wind"], decay) + gust}


@dataclasses.dataclass(frozen=True)
class Sensors(Disturbance):
    """Show the policy the drone late, and with white noise. Rewards, crashes and success use the true state.

    Entry of the state: ``measurements`` (delay + 1, 13), oldest first: position, quaternion, velocity and angular
    velocity, as measured.

    Raises:
        ValueError: a standard deviation or the delay is negative.
    """

    position: float = 0.0  #: [m], standard deviation per axis, world frame
    attitude: float = 0.0  #: [rad], per body axis
    velocity: float = 0.0  #: [m/s], per axis, world frame
    angular_velocity: float = 0.0  #: [rad/s], per axis, body frame
    delay: int = 0  #: control steps

    def __post_init__(self) -> None:
        for name in ("position", "attitude", "velocity", "angular_velocity"):
            if not (is_number(getattr(self, name)) and getattr(self, name) >= 0):
                raise UserValueError(
                    f"observation_noise: {name} must be zero or positive, got {getattr(self, name)!r}."
                )
        require_count("observation_delay", self.delay, 0, MAX_DELAY, "zero or more control steps")

    @property
    def noise_size(self) -> int:
        """Three numbers for each of the four measurements."""
        return 12 if any((self.position, self.attitude, self.velocity, self.angular_velocity)) else 0

    def start(self, random: Randomness, state: State) -> State:
        """A queue full of the first measurement."""
        noise = random.normal(len(state["position"]), 12) if self.noise_size else None
        return {"measurements": self._measure(state, noise).expand(-1, self.delay + 1, -1).clone()}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        """Measure once more, and forget the oldest measurement."""
        return {"measurements": torch.cat((state["measurements"][:, 1:], self._measure(state, noise)), 1)}

    def observe(self, state: State) -> State:
        """The state with the oldest measurement instead of the truth."""
        position, attitude, velocity, angular_velocity = state["measurements"][:, 0].split((3, 4, 3, 3), -1)
        return {
            **state,
            "position": position,
            "quaternion": attitude,
            "velocity": velocity,
            "angular_velocity": angular_velocity,
        }

    def _measure(self, state: State, noise: Tensor | None) -> Tensor:
        position, attitude = state["position"], state["quaternion"]
        velocity, angular_velocity = state["velocity"], state["angular_velocity"]
        if noise is not None:
            by_position, by_attitude, by_velocity, by_rate = noise.split(3, -1)
            if self.position:
                position = position + self.position * by_position
            if self.attitude:
                attitude = quaternion.multiply(attitude, quaternion.from_axis_angle(self.attitude * by_attitude))
            if self.velocity:
                velocity = velocity + self.velocity * by_velocity
            if self.angular_velocity:
                angular_velocity = angular_velocity + self.angular_velocity * by_rate
        return torch.cat((position, attitude, velocity, angular_velocity), -1).unsqueeze(1)


@dataclasses.dataclass(frozen=True)
class RandomStart(Disturbance):
    """Turn and push the drone at the start: the draws are added to the task's own start.

    Raises:
        ValueError: a value is negative, not finite, or beyond the bounds of a flight.
    """

    tilt: float = 0.0  #: [rad], at most; about a random horizontal axis
    yaw: float = 0.0  #: [rad], to both sides
    velocity: float = 0.0  #: [m/s], to both sides, per axis of the world frame
    angular_velocity: float = 0.0  #: [rad/s], to both sides, per axis of the body frame

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (is_number(value) and value >= 0):
                raise UserValueError(f"random_start: {field.name} must be zero or positive, got {value!r}.")
        for name, most in (("velocity", MAX_SPEED), ("angular_velocity", MAX_ANGULAR_VELOCITY)):
            if getattr(self, name) > most:
                raise UserValueError(f"random_start: {name} must be at most {most:g}, got {getattr(self, name)!r}.")

    def start(self, random: Randomness, state: State) -> State:
        """Turn and push the starts of a task."""
        n = len(state["position"])
        heading, tilt = math.pi * random.uniform(n, 1), 0.5 * self.tilt * (random.uniform(n, 1) + 1.0)
        zero = torch.zeros_like(tilt)
        tilting = quaternion.from_axis_angle(torch.cat((tilt * heading.cos(), tilt * heading.sin(), zero), -1))
        turning = quaternion.from_axis_angle(torch.cat((zero, zero, self.yaw * random.uniform(n, 1)), -1))
        return {
            "quaternion": quaternion.multiply(turning, quaternion.multiply(tilting, state["quaternion"])),
            "velocity": state["velocity"] + self.velocity * random.uniform(n, 3),
            "angular_velocity": state["angular_velocity"] + self.angular_velocity * random.uniform(n, 3),
        }


def build(cls: type, name: str, spec: Any, **more: Any) -> Any:
    """A disturbance from its mapping, or the disturbance itself, with what is given (not zero) beside it.

    Raises:
        ValueError: it is neither, or has an unknown key.
    """
    if isinstance(spec, cls):
        return dataclasses.replace(spec, **{name: value for name, value in more.items() if value})
    allowed = [field.name for field in dataclasses.fields(cls) if field.name not in more]
    if not isinstance(spec, Mapping):
        raise UserValueError(f"{name} must be a mapping with any of {', '.join(allowed)}; got {spec!r}.")
    unknown = sorted(str(key) for key in spec if key not in allowed)
    if unknown:
        raise UserValueError(f"{name}: unknown key {unknown[0]!r}. Allowed: {', '.join(allowed)}.")
    return cls(**spec, **more)
