"""Fly the drone of a contract in Crazyflow, by its dynamics from first principles, in JAX."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from importlib.metadata import version

import jax.numpy as jnp
import numpy as np
from crazyflow.control import Control
from crazyflow.dynamics import Dynamics
from crazyflow.sim import Sim
from crazyflow.sim.integration import Integrator
from crazyflow.sim.sim import clip_rotor_vel_cmd
from numpy.typing import NDArray

from torchrl_quad.deploy import frames
from torchrl_quad.deploy.contract import Fields
from torchrl_quad.deploy.simulators import SPECIAL, Simulator
from torchrl_quad.deploy.simulators.vehicle import Array, Drone

RPM = 60.0 / (2.0 * np.pi)  # in 1 rad/s
NAMES = {"position": "pos", "quaternion": "quat", "velocity": "vel", "angular_velocity": "ang_vel"}


class Crazyflow(Simulator):
    """Independent drones in Crazyflow.

    Its dynamics have everything that a contract says of a drone except quadratic drag. They compute in
    float32, and hold drones above the ground. Physics and rate loop run at 1 kHz, by symplectic Euler.
    """

    lacks = SPECIAL
    version, frame = f"Crazyflow {version('crazyflow')}", frames.crazyflow()

    def reset(self, starts: Mapping[str, Array]) -> None:
        n, drone = len(starts["position"]), self.drone
        self.sim = Sim(
            n_worlds=n,
            dynamics=Dynamics.first_principles,
            control=Control.rotor_vel,
            integrator=Integrator.symplectic_euler,
            freq=round(1.0 / self.dt),
        )
        limits = {"lower": drone.rotor_speed_min * RPM, "upper": drone.rotor_speed_max * RPM}
        clip = partial(clip_rotor_vel_cmd, dynamics=Dynamics.first_principles, **limits)
        self.sim.step_pipeline["clip_rotor_vel_cmd"] = clip
        self.sim.build_step_fn()
        theirs = {NAMES[name]: x for name, x in self.frame.to(starts).items()}
        theirs["rotor_vel"] = np.tile(self.frame.to({"motors": self.hover_speed})["motors"] * RPM, (n, 1))
        data = self.sim.data
        states = data.states.replace(**{name: jnp.asarray(x, jnp.float32)[:, None] for name, x in theirs.items()})
        fields = _parameters(drone, self.frame)
        params = data.params.replace(**{name: jnp.asarray(x, jnp.float32) for name, x in fields.items()})
        self.sim.data = data.replace(states=states, params=params)
        self.flying = np.arange(n)  # the others also fly on, unobserved

    def state(self) -> dict[str, Array]:
        states = self.sim.data.states
        theirs = {name: np.asarray(getattr(states, key), float)[self.flying, 0] for name, key in NAMES.items()}
        speeds = np.asarray(states.rotor_vel, float)[self.flying, 0] / RPM
        return {**self.frame.back(theirs), "rotor_speed": self.frame.back({"motors": speeds})["motors"]}

    def step(self, command: Array) -> None:
        speeds = np.array(self.sim.data.controls.rotor_vel)
        for _ in range(self.substeps):
            asked = self.control(command, self.state())[:, self.motors]
            speeds[self.flying, 0] = self.frame.to({"motors": asked})["motors"] * RPM
            self.sim.rotor_vel_control(jnp.asarray(speeds))
            self.sim.step(1)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        super().keep(chosen)
        self.flying = self.flying[chosen]


def _parameters(drone: Drone, frame: frames.Convention) -> Fields:
    """Crazyflow's parameters of a drone; lengths of arms are in its mixing matrix."""
    order = list(frame.motors)
    k2, k1, k0 = drone.thrust_map
    curve = np.array([[k0, k1 / RPM, k2 / RPM**2]])
    x, y = drone.rotor_positions[order, :2].T
    up, down = 1.0 / drone.motor_time_constant
    return {
        "mass": drone.mass,
        "L": [1.0],
        "prop_inertia": [0.0],
        "gravity_vec": [0.0, 0.0, -drone.gravity],
        "J": np.diag(drone.inertia),
        "J_inv": np.diag(1.0 / drone.inertia),
        "rpm2thrust": curve,
        "rpm2torque": curve * drone.yaw_torque_coefficient,
        "mixing_matrix": [y, -x, drone.rotor_spin[order]],
        "drag_matrix": -np.diag(drone.linear_drag),
        "rotor_dyn_coef": [[up, 0.0, down, 0.0]],
    }
