"""Fly the drone of a contract in MuJoCo: a rigid body with rotors, built only from numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import ArrayLike, NDArray

from torchrl_quad.deploy.contract import Contract
from torchrl_quad.deploy.simulators import Simulator
from torchrl_quad.deploy.simulators.vehicle import Array, Drone
from torchrl_quad.rotations import multiply, rotate

SOLIDS = ("spheres", "cylinders", "boxes", "planes")  # kinds of obstacles
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


def _words(numbers: ArrayLike) -> str:
    return " ".join(map(repr, np.asarray(numbers, float).tolist()))


def scenery(obstacles: Mapping[str, Any]) -> str:
    """Obstacles by kind, as a contract lists them, as MJCF."""
    geoms = [("sphere", x[:3], x[3:], "") for x in obstacles["spheres"]]
    for x, y, z, radius, height in obstacles["cylinders"]:
        geoms.append(("cylinder", (x, y, z + 0.5 * height), (radius, 0.5 * height), ""))
    geoms += [("box", x[:3], x[3:6], f'quat="{_words(x[6:])}"') for x in obstacles["boxes"]]
    for *normal, offset in obstacles["planes"]:
        geoms.append(("plane", offset * np.array(normal), (0.0, 0.0, 1.0), f'zaxis="{_words(normal)}"'))
    written = (
        f'<geom type="{kind}" pos="{_words(at)}" size="{_words(size)}" {turn}/>' for kind, at, size, turn in geoms
    )
    return f'<mujoco><size memory="64K"/><worldbody>{"".join(written)}</worldbody></mujoco>'


class MuJoCo(Simulator):
    """Independent drones in MuJoCo.

    Thrust follows from the speed of the rotors by the contract's thrust map, and drag by its coefficients; both are
    forces to MuJoCo, held over a step of 1 ms. The rate loop runs at 1 kHz, too. Images are cast by its rays.
    """

    version, sees = f"MuJoCo {mujoco.__version__}", True

    def __init__(self, contract: Contract, loop: str, motors: Sequence[int]) -> None:
        super().__init__(contract, loop, motors)
        # In MuJoCo a rotor lags alike in both directions: where it is the slower one it is asked for less.
        pulls = -np.expm1(-self.dt / self.drone.motor_time_constant)
        self.pulls = pulls / pulls.max()
        self.model = mujoco.MjModel.from_xml_string(model(self.drone, self.dt))
        self.data = mujoco.MjData(self.model)
        self.rollout = rollout.Rollout(nthread=0)
        self.camera, self.fixed = contract["camera"], contract["obstacles"]
        self.scenes: list[tuple[Any, Any]] = []
        self.inputs = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED)

    def reset(self, starts: Mapping[str, Array]) -> None:
        n = len(starts["position"])
        self.x = np.zeros((n, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        for name, at in STATE.items():
            self.x[:, at] = starts.get(name, self.hover_speed)
        self._allocate()

    def place(self, obstacles: Mapping[str, Array]) -> None:
        if self.camera is None:
            return
        for i in range(len(self.x)):
            own = {kind: [*self.fixed[kind], *obstacles.get(kind, {i: ()})[i]] for kind in SOLIDS}
            scene = mujoco.MjModel.from_xml_string(scenery(own))
            self.scenes.append((scene, mujoco.MjData(scene)))
            mujoco.mj_forward(*self.scenes[-1])

    def look(self) -> Array:
        camera, state = self.camera, self.state()
        width, height, far = camera["width"], camera["height"], camera["range"]
        half = np.tan(0.5 * camera["field_of_view"])
        left = half * (1.0 - (2.0 * np.arange(width) + 1.0) / width)
        up = half * (height - 1.0 - 2.0 * np.arange(height)) / width
        ahead = np.stack(np.broadcast_arrays(1.0, left, up[:, None]), -1).reshape(-1, 3)
        length = np.linalg.norm(ahead, axis=1)
        turned = multiply(state["quaternion"], camera["quaternion"])
        rays = rotate(turned[:, None], ahead / length[:, None])
        eyes = state["position"] + rotate(state["quaternion"], camera["position"])
        found, hit = np.empty((len(eyes), len(ahead))), np.empty(len(ahead), np.int32)
        most = far * (1.0 if camera["along_ray"] else length.max())
        for (scene, data), eye, ray, ends in zip(self.scenes, eyes, rays, found, strict=True):
            mujoco.mj_multiRay(scene, data, eye, ray.ravel(), None, 1, -1, hit, ends, None, len(ray), most)
        depth = np.where(found < 0.0, far, found / (1.0 if camera["along_ray"] else length))
        return np.minimum(depth, far).reshape(-1, height, width)

    def state(self) -> dict[str, Array]:
        return {name: self.x[:, at].copy() for name, at in STATE.items()}

    def step(self, command: Array) -> None:
        drone, limits = self.drone, (self.drone.rotor_speed_min, self.drone.rotor_speed_max)
        n, inputs = len(self.motors), self.controls[:, 0]
        target, lift, force = inputs[:, :n], inputs[:, n : 2 * n], inputs[:, 2 * n + 6 :]
        for _ in range(self.substeps):
            x = self.x
            speed = x[:, STATE["rotor_speed"]]
            asked = self.control(command, {name: x[:, at] for name, at in STATE.items()})
            np.clip(asked[:, self.motors], *limits, out=target)
            if self.pulls.min() < 1.0:
                target[:] = speed + np.where(target > speed, *self.pulls) * (target - speed)
            lift[:] = drone.thrust(speed)
            force[:] = np.concatenate(drone.drag(x[:, STATE["quaternion"]], x[:, STATE["velocity"]]), 1)
            self.rollout.rollout(self.model, [self.data], x, self.controls, control_spec=self.inputs, state=self.after)
            self.x, self.after = self.after[:, 0], x[:, None]

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        super().keep(chosen)
        self.x = self.x[chosen]
        self.scenes = [x for x, on in zip(self.scenes, chosen, strict=False) if on]
        self._allocate()

    def _allocate(self) -> None:
        # Of each drone two controls for each rotor, then force and torque on the world, and on the drone.
        self.controls = np.zeros((len(self.x), 1, 2 * len(self.motors) + 12))
        self.after = np.zeros((len(self.x), 1, self.x.shape[1]))
