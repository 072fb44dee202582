"""Any quadrotor: drones drawn by their physics, for one policy that flies them all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import QuadrotorParams, presets
from torchrl_quad.dynamics.rigid_body import Rotors, thrust_limits
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.disturbances import DroneRandomization, Pair
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import check_value

#: What is drawn, and its range; the class says what it means and where the range comes from.
RANGES = {
    "mass": [0.02, 5.0],
    "thrust_to_weight": [1.5, 8.0],
    "arm": [0.095, 0.24],
    "inertia": [0.17, 0.9],
    "inertia_ratio": [0.67, 1.5],
    "inertia_yaw": [0.5, 1.0],
    "rise": [0.005, 0.1],
    "fall": [0.005, 0.3],
    "yaw_torque": [0.02, 1.0],
    "drag": [0.0, 1.0],
    "drag_up": [0.0, 1.0],
    "delay": [0, 3],
}
_LOGARITHMIC = ("thrust_to_weight", "arm", "inertia", "inertia_ratio", "yaw_torque")  # even in the logarithm
_LIMITS = {name: (1e-2, 1e2) for name in RANGES}
_LIMITS |= {"thrust_to_weight": (1.01, 50.0), "inertia_yaw": (0.1, 1.0), "yaw_torque": (1e-3, 10.0)}
_LIMITS |= {"rise": (1e-3, 1.0), "fall": (1e-3, 1.0), "drag": (0.0, 10.0), "drag_up": (0.0, 10.0), "delay": (0, 50)}


class AnyDrone(DroneRandomization):
    """Fly any quadrotor: ``randomize="any"`` draws one by its physics, not about a nominal drone, in each episode.

    ====================  ================  ==========================================================================
    drawn                 from, to          meaning, and the source of the range
    ====================  ================  ==========================================================================
    ``mass``              0.02, 5 kg        even in its third root, a length; the sampler of RAPTOR (arXiv:2509.11481)
    ``thrust_to_weight``  1.5, 8            of all rotors; 1.5 to 5 there, 1.7 to 12 of the drones that ship
    ``arm``               0.095, 0.24       from centre to rotor [m], per third root of the mass; drones that ship
    ``inertia``           0.17, 0.9         about x, per mass times arm squared; drones that ship
    ``inertia_ratio``     0.67, 1.5         of y to x; drones that ship
    ``inertia_yaw``       0.5, 1            of z to the sum of x and y, the most that a body has; drones that ship
    ``rise``, ``fall``    5, 100 | 300 ms   lag of rotors that speed up and slow down; RAPTOR's from 30 ms, ours from 5
    ``yaw_torque``        0.02, 1           coefficient per arm; 5 to 50 mm there
    ``drag``              0, 1 1/s          linear, per mass, along x and y; drones that ship
    ``drag_up``           0, 1 1/s          along z
    ``delay``             0, 3              control steps from a command to its effect; instead of ``action_delay``
    ====================  ================  ==========================================================================

    ``thrust_to_weight``, ``arm``, ``inertia``, ``inertia_ratio`` and ``yaw_torque`` are even in their logarithms, the
    others in their values. Torque per inertia, which these give, spans 14 to 6000 rad/s2; RAPTOR draws 40 to 1200.
    ``randomize={"any": {"thrust_to_weight": [2, 4]}}`` changes ranges. Layout, order and spin of the four rotors, the
    range of their speeds and the shape of the thrust curve are those of ``drone``; all else of it is replaced by the
    middle of the ranges.

    It needs ``control="rotor_thrusts"``, whose action -1..1 is then the motor signal: 0..1 of the greatest thrust of
    the drawn drone's own rotors, so that a policy need not know which drone it flies.

    The rotors start at a speed between rest and hovering. Commands on their way are then to hover the middle drone,
    so that nothing gives away which one flies.

    Entries of the state: ``("drone", field)``; ``delay`` (1), control steps; and ``traits`` (9), of the order of one:
    all of the drone that its motion depends on but for gyroscopic torque, for critics. They are the logarithms of
    thrust to weight and of the greatest angular acceleration about x, y and z, ``rise``, ``fall``, ``drag``,
    ``drag_up``, and the delay.
    """

    privileged = {"traits": 1.0, "rotor_speed": 1e-3}

    def __init__(self, spec: str | Path | Mapping, layout: QuadrotorParams) -> None:
        source, spec = ("randomize", {"any": {}}) if spec == "any" else presets.read("randomize", spec)
        given = spec["any"] or {}
        if not isinstance(given, Mapping) or len(spec) > 1:
            raise UserValueError(
                f"{source}: any draws the whole drone, and takes ranges, such as {{any: {{mass: [0.5, 1.0]}}}}; got "
                f"{shown(spec)}."
            )
        if layout.rotor_spin.shape[-1] != 4 or layout.mass.dim() > 1 or layout.rotor_direction is not None:
            raise UserValueError(f"{source}: any draws quadrotors with upright rotors. Write drone=cf2x.")
        self.ranges = {name: _checked(name, numbers, source) for name, numbers in {**RANGES, **given}.items()}
        self.spec: Mapping[str, Any] = {name: {"any": numbers} for name, numbers in self.ranges.items()}
        self.max_delay = int(self.ranges["delay"][1])
        self.full, places = thrust_limits(layout)[1], layout.rotor_positions[:, :2]
        self.rotors, self.directions = Rotors(layout), places / places.norm(dim=-1).mean()
        self.slowest, self.gravity, self.thrust_map = layout.rotor_speed_min, layout.gravity, layout.thrust_map
        for share in (-1.0, 1.0, 0.0):
            drawn, fields = self._drone(layout.mass.new_full((1, len(RANGES)), share))
            changes = {"drag_height": 0.0, "quadratic_drag": [0.0] * 3, **{k: x[0] for k, x in fields.items()}}
            try:  # at last the middle, by which the controller scales actions
                self.middle = layout.replace(**changes, max_thrust_to_weight=drawn["thrust_to_weight"][0])
            except ValueError as error:
                raise UserValueError(f"{source}: the drones that any may draw are not all possible: {error}") from error
        self.nominal = fields

    def start(self, random: Randomness, state: State) -> State:
        drawn, fields = self._drone(random.uniform(n := len(state["position"]), len(RANGES)))
        delay = {"delay": drawn["delay"].long()} if self.max_delay else {}
        hover = self.rotors.speed(self.full / drawn["thrust_to_weight"])
        speed = torch.lerp(self.slowest, hover, 0.5 + 0.5 * random.uniform(n, 1)).expand(-1, 4).clone()
        entries: State = {("drone", name): x for name, x in fields.items()}
        return {**entries, **delay, "traits": self._traits(drawn, fields), "rotor_speed": speed}

    def queue_length(self, action_delay: int) -> int:
        """How many commands may be on their way; an ``action_delay`` other than the usual 1 must be the same."""
        if action_delay not in (1, self.max_delay):
            raise UserValueError(
                f"randomize draws the delay, and action_delay={action_delay} would change nothing. Write "
                f"randomize={{'any': {{'delay': [0, {action_delay}]}}}}."
            )
        return self.max_delay

    def problems(self, state: State) -> dict[str, Tensor]:
        """Delays that the queue does not hold."""
        wrong = (state["delay"] < 0) | (state["delay"] > self.max_delay) if self.max_delay else None
        return {} if wrong is None else {f"'delay' must be 0 to {self.max_delay}": wrong.squeeze(1)}

    def liveliest(self, nominal: QuadrotorParams) -> Iterator[QuadrotorParams]:
        """None: there is no rate loop that has to be stable."""
        return iter(())

    def _drone(self, unit: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """What is drawn, by name, each (n, 1), and fields of QuadrotorParams, from numbers (n, 12) in [-1, 1]."""
        drawn = {name: self._value(name, x) for name, x in zip(RANGES, unit.split(1, -1), strict=True)}
        mass, arm = drawn["mass"], drawn["arm"] * drawn["mass"] ** (1 / 3)
        x = drawn["inertia"] * mass * arm.square()
        y = x * drawn["inertia_ratio"]
        drag = mass * drawn["drag"]
        thrust = drawn["thrust_to_weight"] * mass * self.gravity / 4
        return drawn, {
            "mass": mass,
            "inertia": torch.cat((x, y, (x + y) * drawn["inertia_yaw"]), -1),
            "rotor_positions": arm.unsqueeze(-1) * self.directions,
            "yaw_torque_coefficient": drawn["yaw_torque"] * arm,
            "thrust_map": thrust / self.full * self.thrust_map,
            "motor_time_constant": torch.cat((drawn["rise"], drawn["fall"]), -1),
            "linear_drag": torch.cat((drag, drag, mass * drawn["drag_up"]), -1),
        }

    def _value(self, name: str, unit: Tensor) -> Tensor:
        """From [-1, 1] to the range of what is drawn."""
        (low, high), share = self.ranges[name], 0.5 + 0.5 * unit
        if name == "delay":
            return (low + share * (high - low + 1.0)).floor().clamp_max(high)
        if name in _LOGARITHMIC:
            return low * (high / low) ** share
        root = 1 / 3 if name == "mass" else 1.0
        return (low**root + share * (high**root - low**root)) ** (1 / root)

    def _traits(self, drawn: dict[str, Tensor], fields: dict[str, Tensor]) -> Tensor:
        """All that the motion depends on, (n, 9), of the order of one."""
        force = drawn["thrust_to_weight"] * drawn["mass"] * self.gravity / 4
        x, y = (0.5 * fields["rotor_positions"].abs().sum(-2)).flip(-1).split(1, -1)
        lever = torch.cat((x, y, 2.0 * fields["yaw_torque_coefficient"]), -1)
        turning = (force * lever / fields["inertia"]).log()  # at most, about each axis
        turning = (turning - turning.new_tensor((5.5, 5.5, 4.0))) / 2.0
        lag = [20.0 * drawn["rise"] - 1.0, 10.0 * drawn["fall"] - 1.5]
        rest = [drawn["drag"], drawn["drag_up"], drawn["delay"] / 3.0]
        return torch.cat((drawn["thrust_to_weight"].log() - 1.0, turning, *lag, *rest), -1)


def any_drone(spec: Any, layout: QuadrotorParams) -> AnyDrone | None:
    """The distribution that ``randomize`` asks for, if it is one of whole drones."""
    if spec == "any" or (spec and "any" in presets.read("randomize", spec)[1]):
        return AnyDrone(spec, layout)
    return None


def _checked(name: str, numbers: Any, source: str) -> list[float]:
    if name not in RANGES:
        raise UserValueError(f"{source}: any draws no {shown(name)}. Choose from: {', '.join(RANGES)}.")
    low, high = check_value(f"{source}: {name}", numbers, Pair, "Give two numbers, low and high.")
    least, most = _LIMITS[name]
    is_right = least <= low <= high <= most
    if not is_right or (name == "delay" and (low % 1 or high % 1)):
        kind = "whole numbers" if name == "delay" else "numbers"
        raise UserValueError(
            f"{source}: {name} needs two {kind}, low and high, between {least:g} and {most:g}; got {shown(numbers)}."
        )
    return [low, high]
