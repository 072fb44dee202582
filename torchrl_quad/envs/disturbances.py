"""Make any task harder, or more realistic: random drones, wind, sensors, starts, and your own disturbances."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from torchrl_quad.dynamics import QuadrotorParams, presets, quaternion
from torchrl_quad.dynamics.parameters import CONTROLLER_FIELDS, PLANT_FIELDS
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.guard import MAX_ANGULAR_VELOCITY, MAX_SPEED
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import Delay, between, check_value, checked, entries

_DISTRIBUTIONS = {
    "uniform": "low and high",
    "scale": "low and high, as factors of the nominal value",
    "normal": "mean and standard deviation, cut off at three of them",
}
MAX_WIND = 100.0  # [m/s]
# Noise and starts reach as far as flights do, whose states mean nothing beyond.
Speed = Annotated[float, between(0.0, MAX_SPEED)]
BodyRate = Annotated[float, between(0.0, MAX_ANGULAR_VELOCITY)]
Angle = Annotated[float, between(0.0, math.pi)]
Pair = Annotated[Sequence[Annotated[float, between(-1e6, 1e6)]], entries(2, 2)]


class Disturbance:
    """The protocol of all disturbances. A new one overrides some methods; ``disturbances=[MyOwn()]`` switches it on.

    Its memory is in entries of the state, each (n, ...), which are restored, stored and compiled with it.
    An entry ``("drone", field)`` changes a parameter of the drone that flies, from then on: a
    ``("drone", "rotor_effectiveness")`` of 0 is a dead rotor. ``wind`` changes the air it flies in.
    """

    privileged: Mapping[str | tuple[str, str], float] = {}  #: as of a task
    follows_params = False  #: whether it draws its entries ("drone", field) about ``env.params``, which may then change

    @property
    def noise_size(self) -> int:
        """How many standard normal numbers each environment needs for ``advance``; a plain class attribute will do."""
        return 0

    def start(self, random: Randomness, state: State) -> State:
        """The entries that it adds to the start of an episode, or changes there; it draws only from ``random``."""
        return {}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        """The entries that a control step of dt [s] changes, from the state after it and noise (n, noise_size).

        It acts once per control step, and the physics goes on from there. What follows the command within a step, the
        rotor speeds (with ``dynamics="point_mass"`` the body rates), is refused, as the change would be undone.
        """
        return {}

    def observe(self, state: State) -> State:
        """The state as the policy observes it. Rewards, crashes and success use the true one."""
        return state

    def problems(self, state: State) -> dict[str, Tensor]:
        """What is wrong with a state to start from, in words, and where it is wrong, bool (n)."""
        return {}


class DroneRandomization(Disturbance):
    """Fly another drone in each episode: any of its parameters is drawn at reset.

    A mapping, or a YAML file of one, from fields of :class:`~torchrl_quad.QuadrotorParams` to a distribution and its
    two numbers:

    .. code-block:: yaml

        mass: {scale: [0.8, 1.2]}                    # uniform factors of the nominal value, one per entry
        motor_time_constant: {uniform: [0.02, 0.05]}
        linear_drag: {normal: [0.005, 0.001]}        # cut off at three standard deviations

    "uniform" and "normal" give all entries of a field the same two numbers, "scale" each its own nominal value. The
    values drawn are entries of the state, ``("drone", field)``. The controller keeps the nominal drone. A moment of
    inertia that exceeds the sum of the two others, as in no body, is lowered to that.

    Raises:
        ValueError: a field or distribution is unknown, belongs to the controller, or may give an impossible drone, or,
            in an environment, one whose rate loop is unstable.
    """

    def __init__(
        self, spec: str | Path | Mapping, nominal: QuadrotorParams, plant_fields: Sequence[str] = PLANT_FIELDS
    ) -> None:
        source, self.spec = presets.read("randomize", spec)
        for name, distribution in self.spec.items():
            if name in CONTROLLER_FIELDS:
                raise UserValueError(
                    f"{source}: {name!r} belongs to the flight controller, which keeps the nominal drone; a random one "
                    "would change nothing. Give another drone instead."
                )
            allowed = [field for field in plant_fields if field != "rotor_spin"]
            if name not in allowed:
                raise UserValueError(f"{source}: unknown field {shown(name)}. Choose from: {', '.join(allowed)}.")
            is_one = isinstance(distribution, Mapping) and len(distribution) == 1
            if not (is_one and set(distribution) <= set(_DISTRIBUTIONS)):
                choices = "; ".join(f"{key}: {numbers}" for key, numbers in _DISTRIBUTIONS.items())
                raise UserValueError(
                    f"{source}: {name} needs one distribution of: {choices}; got {shown(distribution)}."
                )
            ((kind, numbers),) = distribution.items()
            has = f"{name} needs two numbers, {_DISTRIBUTIONS[kind]}"
            least, most = check_value(f"{source}: {kind}", numbers, Pair, f"{has}.")
            if most < (0.0 if kind == "normal" else least):
                raise UserValueError(f"{source}: {has}; got {shown(numbers)}.")
            if kind == "scale" and not nominal.value(name).any():
                raise UserValueError(f"{source}: {name} is 0, and no scale changes that. Give uniform: [low, high].")
        self.nominal = {name: nominal.value(name) for name in self.spec}
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
        drawn = {}
        for name, nominal in self.nominal.items():
            shape = (len(state["position"]), *nominal.shape[-QuadrotorParams.dim(name) :])
            is_normal = "normal" in self.spec[name]
            unit = random.normal(*shape).clamp(-3.0, 3.0) / 3.0 if is_normal else random.uniform(*shape)
            drawn["drone", name] = value = self._value(name, unit)
            if name == "inertia":  # in a body none exceeds the sum of the other two
                drawn["drone", name] = torch.minimum(value, value.sum(-1, keepdim=True) - value)
        return drawn

    def liveliest(self, nominal: QuadrotorParams) -> Iterator[QuadrotorParams]:
        """Of the drones that may be drawn those of the least inertia and the strongest rotors, with the quickest and
        with the slowest motors."""
        strong = dict.fromkeys(("thrust_map", "rotor_effectiveness", "yaw_torque_coefficient"), 1.0)
        strong |= {"rotor_positions": 1.0} if "scale" in self.spec.get("rotor_positions", ()) else {}
        for sign in (-1.0, 1.0):
            ends = {"inertia": -1.0, "motor_time_constant": sign, **strong}
            ends = {k: self._value(k, torch.full_like(x, ends[k])) for k, x in self.nominal.items() if k in ends}
            yield nominal.replace(**ends)

    def _value(self, name: str, unit: Tensor) -> Tensor:
        """From the range [-1, 1] to the one asked for."""
        ((kind, numbers),) = self.spec[name].items()
        first, second = map(float, numbers)
        if kind == "normal":
            return first + 3.0 * second * unit
        value = 0.5 * (first + second) + 0.5 * (second - first) * unit
        return value * self.nominal[name].to(value) if kind == "scale" else value


@checked
@dataclasses.dataclass(frozen=True)
class Wind(Disturbance):
    """Blow a mean wind in each episode, and gusts about it: a first-order Gauss-Markov process in time, per axis.

    Entries of the state: ``mean_wind`` and ``wind``, each (3) [m/s], world frame, held over a control step.

    Args:
        mean: along x, y and z [m/s], world frame.
        spread: by which the mean of an episode may differ to either side, along x, y and z [m/s]; drawn at reset.
        gust: standard deviation of the gusts [m/s]; five of them, the mean and the spread add up to 100 m/s at most.
        gust_time: the time after which a gust has decayed to 1/e, 0.001 to 1e6 s.
    """

    mean: Annotated[Sequence[Annotated[float, between(-MAX_WIND, MAX_WIND)]], entries(3, 3)] = (0.0, 0.0, 0.0)
    spread: Annotated[Sequence[Annotated[float, between(0.0, MAX_WIND)]], entries(3, 3)] = (0.0, 0.0, 0.0)
    gust: Annotated[float, between(0.0, 0.2 * MAX_WIND)] = 0.0
    gust_time: Annotated[float, between(1e-3, 1e6)] = 1.0

    def __post_init__(self) -> None:
        strongest = max(abs(m) + s for m, s in zip(self.mean, self.spread, strict=True)) + 5.0 * self.gust
        if strongest > MAX_WIND:
            raise UserValueError(
                f"mean, spread and five times the gust add up to {strongest:g} m/s; the model holds up to "
                f"{MAX_WIND:g} m/s."
            )

    @property
    def noise_size(self) -> int:
        return 3 if self.gust else 0

    def start(self, random: Randomness, state: State) -> State:
        n = len(state["position"])
        mean = random.tensor(self.mean) + random.tensor(self.spread) * random.uniform(n, 3)
        return {"mean_wind": mean, "wind": mean + self.gust * random.normal(n, 3) if self.gust else mean.clone()}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        if noise is None:
            return {}
        decay = math.exp(-dt / self.gust_time)
        gust = self.gust * math.sqrt(1.0 - decay * decay) * noise
        return {"wind": torch.lerp(state["mean_wind"], state["wind"], decay) + gust}


@checked
@dataclasses.dataclass(frozen=True)
class Sensors(Disturbance):
    """Delay what the policy observes of the drone, and add white noise. Rewards and ends of episodes use the truth.

    Entry of the state: ``measurements`` (delay + 1, 13), oldest first: position, quaternion, velocity and angular
    velocity, as measured.

    Args:
        position: standard deviation per axis of the world frame, 0 to 100 m.
        attitude: standard deviation per body axis, 0 to pi rad.
        velocity: standard deviation per axis of the world frame, 0 to 300 m/s.
        angular_velocity: standard deviation per axis of the body frame, 0 to 100 rad/s.
        delay: control steps by which the readings lag behind, 0 to 1000.
    """

    position: Annotated[float, between(0.0, 100.0)] = 0.0
    attitude: Angle = 0.0
    velocity: Speed = 0.0
    angular_velocity: BodyRate = 0.0
    delay: Delay = 0

    @property
    def noise_size(self) -> int:
        return 12 if any((self.position, self.attitude, self.velocity, self.angular_velocity)) else 0

    def start(self, random: Randomness, state: State) -> State:
        noise = random.normal(len(state["position"]), 12) if self.noise_size else None
        return {"measurements": self._measure(state, noise).expand(-1, self.delay + 1, -1).clone()}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        return {"measurements": torch.cat((state["measurements"][:, 1:], self._measure(state, noise)), 1)}

    def observe(self, state: State) -> State:
        position, attitude, velocity, angular_velocity = state["measurements"][:, 0].split((3, 4, 3, 3), -1)
        measured = {"position": position, "quaternion": attitude}
        return {**state, **measured, "velocity": velocity, "angular_velocity": angular_velocity}

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


@checked
@dataclasses.dataclass(frozen=True)
class RandomStart(Disturbance):
    """Turn and push the drone at the start: the draws are added to the task's own start.

    Args:
        tilt: the greatest angle by which it is tilted about a random horizontal axis, 0 to pi rad.
        yaw: the greatest angle by which it is turned to either side, 0 to pi rad.
        velocity: the greatest speed to either side per axis of the world frame, 0 to 300 m/s.
        angular_velocity: the greatest rate to either side per axis of the body frame, 0 to 100 rad/s.
    """

    tilt: Angle = 0.0
    yaw: Angle = 0.0
    velocity: Speed = 0.0
    angular_velocity: BodyRate = 0.0

    def start(self, random: Randomness, state: State) -> State:
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
