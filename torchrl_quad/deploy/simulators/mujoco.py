"""Fly the drone of a contract in MuJoCo: a rigid body with rotors, built only from numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from torchrl_quad.deploy.contract import Contract
from torchrl_quad.deploy.simulators import Simulator
from torchrl_quad.deploy.simulators.vehicle import Array, Drone

# qpos of a free joint: position and quaternion (w, x, y, z), body to world. qvel: velocity in the world frame, angular
# velocity in the body frame. act: the rotor speeds.
STATE = {"position": slice(1, 4), "quaternion": slice(4, 8), "velocity": slice(8, 11)}
STATE |= {"angular_velocity": slice(11, 14), "rotor_speed": slice(14, None)}


def model(drone: Drone, timestep: float) -> str:
    """The drone as MJCF.

    It states everything that the motion depends on: mass and inertia, gravity, the integrator (semi-implicit Euler), no
    contact, no fluid. The first half of the actuators makes no force: they are the lag of the rotors, of first order in
    the speed and exact for any step; of two time constants it is the shorter. The others push and turn the body by what
    the thrust [N] written into them does at the place and along the direction of a rotor, with what it has left of its
    effectiveness.
    """
    n = len(drone.rotor_spin)
    places = np.pad(drone.rotor_positions, ((0, 0), (0, 3 - drone.rotor_positions.shape[1])))
    force = drone.allocation[[4, 5, 0]].T * drone.rotor_effectiveness[:, None]
    gears = np.concatenate((force, force * (drone.rotor_spin * drone.yaw_torque_coefficient)[:, None]), 1)
    sites = "".join(f'<site name="rotor{i}" pos="{_words(place)}"/>' for i, place in enumerate(places))
    shortest = float(drone.motor_time_constant.min())
    lag = f'dyntype="filterexact" dynprm="{shortest!r}" gaintype="fixed" gainprm="0" biastype="none"'
    lags = "".join(f'<general site="rotor{i}" {lag} gear="0 0 1 0 0 0" ctrllimited="false"/>' for i in range(n))
    motors = (f'<motor site="rotor{i}" gear="{_words(gear)}" ctrllimited="false"/>' for i, gear in enumerate(gears))
    most = (1.0 - 1e-12) * (drone.inertia.sum() - drone.inertia)  # rounding may put a flat body a little beyond
    thrusts, inertia = "".join(motors), _words(np.minimum(drone.inertia, most))
    return f"""<mujoco>
  <compiler inertiafromgeom="false" balanceinertia="false" boundmass="0" boundinertia="0"/>
  <option timestep="{timestep!r}" integrator="Euler" gravity="0 0 {-drone.gravity!r}" wind="0 0 0" density="0"
          viscosity="0">
    <flag contact="disable" constraint="disable" gravity="enable" actuation="enable" autoreset="disable"/>
  </option>
  <worldbody>
    <body name="drone" pos="0 0 0">
      <freejoint/>
      <inertial pos="0 0 0" mass="{drone.mass!r}" diaginertia="{inertia}"/>
      {sites}
    </body>
  </worldbody>
  <actuator>{lags}{thrusts}</actuator>
</mujoco>"""


def _words(numbers: Array) -> str:
    return " ".join(map(repr, numbers.tolist()))


class MuJoCo(Simulator):
    """Independent drones in MuJoCo.

    Thrust follows from the speed of the rotors by the contract's thrust map, and drag by its coefficients; both are
    forces to MuJoCo, held over a step of 1 ms. The rate loop runs at 1 kHz, too.
    """

    version = f"MuJoCo {mujoco.__version__}"

    def __init__(self, contract: Contract, loop: str, motors: Sequence[int]) -> None:
        super().__init__(contract, loop, motors)
        # In MuJoCo a rotor lags alike in both directions: where it is the slower one it is asked for less.
        pulls = -np.expm1(-self.dt / self.drone.motor_time_constant)
        self.pulls = pulls / pulls.max()
        self.model = mujoco.MjModel.from_xml_string(model(self.drone, self.dt))
        self.data = mujoco.MjData(self.model)
        self.rollout = rollout.Rollout(nthread=0)
        self.inputs = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED)

    def reset(self, starts: Mapping[str, Array]) -> None:
        n = len(starts["position"])
        self.x = np.zeros((n, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        for name, at in STATE.items():
            self.x[:, at] = starts.get(name, self.hover_speed)
        self._allocate()

    def state(self) -> dict[str, Array]:
        return {name: self.x[:, at].copy() for name, at in STATE.items()}

    def step(self, thrust: Array, rates: Array) -> None:
        drone, limits = self.drone, (self.drone.rotor_speed_min, self.drone.rotor_speed_max)
        n, control = len(self.motors), self.control[:, 0]
        command, lift, force = control[:, :n], control[:, n : 2 * n], control[:, 2 * n + 6 : 2 * n + 9]
        for _ in range(self.substeps):
            x = self.x
            speed = x[:, STATE["rotor_speed"]]
            asked = self.loop(thrust, rates, x[:, STATE["angular_velocity"]], speed)
            np.clip(asked[:, self.motors], *limits, out=command)
            if self.pulls.min() < 1.0:
                command[:] = speed + np.where(command > speed, *self.pulls) * (command - speed)
            lift[:] = drone.thrust(speed)
            force[:] = drone.drag(x[:, STATE["quaternion"]], x[:, STATE["velocity"]])
            self.rollout.rollout(self.model, [self.data], x, self.control, control_spec=self.inputs, state=self.after)
            self.x, self.after = self.after[:, 0], x[:, None]

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        self.x = self.x[chosen]
        self.loop.keep(chosen)
        self._allocate()

    def _allocate(self) -> None:
        # Of each drone two controls for each rotor, then force and torque on the world, and on the drone.
        self.control = np.zeros((len(self.x), 1, 2 * len(self.motors) + 12))
        self.after = np.zeros((len(self.x), 1, self.x.shape[1]))
