"""Fly the drone of a contract in RotorPy, by its vehicle ``Multirotor``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray
from rotorpy.vehicles.multirotor import Multirotor

from torchrl_quad.deploy import frames
from torchrl_quad.deploy.contract import Contract, Fields
from torchrl_quad.deploy.simulators import SPECIAL, Simulator
from torchrl_quad.deploy.simulators.vehicle import LOOPS, Array, Control, Drone

NAMES = {"position": "x", "quaternion": "q", "velocity": "v", "angular_velocity": "w"}


class RotorPy(Simulator):
    """Independent drones in RotorPy.

    RotorPy integrates over steps of the contract's simulator, in which commands are held: 5 ms by default. Its vehicle
    cannot be all that a contract says:

    - thrust is k w^2; k is chosen so that the rotors hover at the contract's speed, and have its limits of thrust;
    - linear drag acts at the hubs, and grows with the speed of the rotors; it is the contract's in hover;
    - quadratic drag is -C |v| v with the norm of the velocity, not axis by axis;
    - gravity is 9.81 m/s2.

    The loop "own" is its ``cmd_ctbr``, proportional, with the gain that gives the damping of the contract's loop.
    """

    loops, lacks = (*LOOPS, "own"), SPECIAL

    def __init__(self, contract: Contract, loop: str, motors: Sequence[int]) -> None:
        self.version = f"RotorPy {version('rotorpy')}"
        self.dt = contract["simulator"]["dt"]
        self.substeps = round(contract["control_dt"] / self.dt)
        speed = Drone(contract["drone"]).hover_speed
        nominal, drone = (_squared(x, speed) for x in (contract["drone"], contract["drone"] | contract["plant"]))
        self.drone, self.frame = drone, frames.rotorpy()
        self.hover_speed, self.motors = nominal.hover_speed, list(motors)
        self.own = loop == "own"
        self.control = Control(contract, LOOPS["contract" if self.own else loop](nominal, self.dt))
        ratio, tau = nominal.rate_loop(0.0).damping_ratio, nominal.motor_time_constant.mean()  # of continuous time
        gain = float((1.0 / (4.0 * ratio**2 * tau))[:2].mean())
        kind = "cmd_ctbr" if self.own else "cmd_motor_speeds"
        solver = {"method": "RK23", "first_step": self.dt}  # half the time of its defaults
        parameters = _parameters(drone, self.frame) | {"k_w": gain}
        self.vehicle = Multirotor(parameters, control_abstraction=kind, integrator_kwargs=solver)

    def reset(self, starts: Mapping[str, Array]) -> None:
        theirs = self.frame.to(starts)
        speeds = self.frame.to({"motors": self.hover_speed})["motors"]
        still = {"wind": np.zeros(3), "rotor_speeds": speeds}
        n = len(starts["position"])
        self.now = [{**{NAMES[k]: x[i] for k, x in theirs.items()}, **still} for i in range(n)]

    def state(self) -> dict[str, Array]:
        theirs = {name: np.stack([x[theirs] for x in self.now]) for name, theirs in NAMES.items()}
        speeds = self.frame.back({"motors": np.stack([x["rotor_speeds"] for x in self.now])})["motors"]
        return {**self.frame.back(theirs), "rotor_speed": speeds}

    def step(self, command: Array) -> None:
        for _ in range(self.substeps):
            state = self.state()
            if self.own:
                thrust, rates = self.control.rates(command, state)
                rates = self.frame.to({"body_rate": rates})["body_rate"]
                commands = [{"cmd_thrust": t, "cmd_w": w} for t, w in zip(thrust, rates, strict=True)]
            else:
                speeds = self.control(command, state)[:, self.motors]
                commands = [{"cmd_motor_speeds": x} for x in self.frame.to({"motors": speeds})["motors"]]
            self.now = [self._step(x, c) for x, c in zip(self.now, commands, strict=True)]

    def _step(self, state: Fields, command: Fields) -> Fields:
        wanted = self.vehicle.get_cmd_motor_speeds(state, command)  # holds in the step, and so do the time constants
        self.vehicle.tau_m = self.drone.time_constant(wanted - state["rotor_speeds"])
        return self.vehicle.step(state, command, self.dt)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        super().keep(chosen)
        self.now = [x for x, on in zip(self.now, chosen, strict=True) if on]


def _squared(fields: Contract, speed: Array) -> Drone:
    """The drone with thrust k w^2 that is its own at a speed (4) [rad/s] of the rotors, and with its limits."""
    drone = Drone(fields)
    k = float((drone.thrust(speed) / speed**2).mean())
    least, greatest = (float(np.sqrt(x / k)) for x in drone.thrust_limits)
    return Drone({**fields, "thrust_map": [k, 0.0, 0.0], "rotor_speed_min": least, "rotor_speed_max": greatest})


def _parameters(drone: Drone, frame: frames.Convention) -> Fields:
    """RotorPy's parameters of a drone."""
    k, order = float(drone.thrust_map[0]), list(frame.motors)
    at_hover = 4.0 * float(drone.hover_speed.mean())
    places = np.c_[drone.rotor_positions[order, :2], np.zeros(4)]
    return {
        "mass": drone.mass,
        **{f"I{a}{b}": float(np.diag(drone.inertia)[i, j]) for i, a in enumerate("xyz") for j, b in enumerate("xyz")},
        **{f"c_D{axis}": float(x) for axis, x in zip("xyz", drone.quadratic_drag, strict=True)},
        "num_rotors": 4,
        "rotor_pos": {f"r{i + 1}": place for i, place in enumerate(places)},
        "rotor_directions": drone.rotor_spin[order],
        "rotor_speed_min": drone.rotor_speed_min,
        "rotor_speed_max": drone.rotor_speed_max,
        "k_eta": k,
        "k_m": k * drone.yaw_torque_coefficient,
        "k_d": float(drone.linear_drag[:2].mean()) / at_hover,
        "k_z": float(drone.linear_drag[2]) / at_hover,
        "tau_m": drone.motor_time_constant[0],
    }
