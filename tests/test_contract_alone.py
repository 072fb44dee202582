"""A rig that knows nothing of the package: it flies from contract.json, the network and a start, in numpy."""

import json

import numpy as np
import onnxruntime
import pytest

from torchrl_quad.deploy import load_bundle
from torchrl_quad.deploy.transfer import fly


def turn(q, x, back=False):
    """A vector (3) of the body frame in the world frame, or back."""
    w, v = q[0], -q[1:] if back else q[1:]
    return x + 2 * np.cross(v, np.cross(v, x) + w * x)


def limit(x, most):
    return x / np.sqrt(1 + (x / most) ** 2)


class Rig:
    """One drone, flown by the laws that stand in the contract."""

    def __init__(self, contract, start):
        self.about, self.drone, self.task = contract, contract["drone"], contract["task"]
        self.rules = {name: np.array(x) for name, x in self.task["constants"].items()}
        self.p, self.q, self.v, self.w = (start[x] for x in ("position", "quaternion", "velocity", "angular_velocity"))
        self.entries = {name: start[name] for name in self.task["entries"]}
        drone, arms = self.drone, np.array(self.drone["rotor_positions"])
        spin = drone["yaw_torque_coefficient"] * np.array(drone["rotor_spin"])
        self.allocation = np.stack((np.ones(len(arms)), arms[:, 1], -arms[:, 0], spin))
        self.rotors = self.speed(np.linalg.pinv(self.allocation)[:, 0] * drone["mass"] * drone["gravity"])
        output = contract["output"]
        self.queue = [np.array(output["hover_action"])] * contract["action_delay"]
        self.low, self.high = np.array(output["range"]).T
        self.memory = np.zeros((1, contract["memory"]), np.float32)

    def thrust(self, speed):
        return np.polyval(self.drone["thrust_map"], speed)

    def speed(self, thrust):
        k2, k1, k0 = self.drone["thrust_map"]
        least, most = self.drone["rotor_speed_min"], self.drone["rotor_speed_max"]
        thrust = np.clip(thrust, max(self.thrust(least), 0.0), self.thrust(most))
        return (-k1 + np.sqrt(k1 * k1 - 4 * k2 * (k0 - thrust))) / (2 * k2)

    def observation(self):
        """By the tables in ``task.documentation``."""
        p, q, v, w = self.past[-1 - min(self.about["observation_delay"], len(self.past) - 1)]
        body = (10 * q, v, w)
        if self.task["name"] == "tracking":
            phases = (self.entries["phase"] + self.rules["ahead"]) % (2 * np.pi)
            points = self.rules["curve_points"]
            at = np.linspace(0, 2 * np.pi, len(points))
            curve = np.stack([np.interp(phases, at, x) for x in points.T], 1)
            queue = self.queue if self.about["graphs"]["observe"]["reads"].get("action_queue") else []
            return np.concatenate([(curve - p).ravel(), *body, *queue])
        if self.task["name"] == "racing":
            gates = self.rules["gates"][(self.entries["gate"][0] + np.arange(2)) % len(self.rules["gates"])]
            return np.concatenate([(gates - p).ravel(), *body])
        return np.concatenate([self.entries["target"] - p, *body])

    def advance(self, before):
        if self.task["name"] == "tracking":
            step = self.rules["phase_rate"] * self.about["control_dt"]
            self.entries["phase"] = (self.entries["phase"] + step) % (2 * np.pi)
        if self.task["name"] == "racing":
            way, gate = self.p - before, self.rules["gates"][self.entries["gate"][0]]
            share = np.clip((gate - before) @ way / max(way @ way, 1e-12), 0, 1)
            passed = np.linalg.norm(before + share * way - gate) < self.rules["gate_radius"]
            self.entries["gate"] = (self.entries["gate"] + passed) % len(self.rules["gates"])

    def command(self, command):
        """Rotor speeds to ask for: ``output.law``, then ``rate_loop.torque``."""
        drone, output = self.drone, self.about["output"]
        if output["control"] == "rotor_thrusts":
            return self.speed(command)
        up, gains = turn(self.q, np.array([0, 0, 1.0]), back=True), output["gains"]
        most = np.array(output["body_rate"]["range"])[:2, 1]
        thrust, rates = command[0], command[1:]
        if output["control"] == "attitude":
            _, roll, pitch, yaw = command
            wanted = (-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch))
            tilt = limit(gains["tilt_gain"] * np.cross(wanted, up)[:2], most)
            rates = np.append(tilt + yaw * up[:2], yaw * up[2])
        if output["control"] == "velocity":
            wanted = gains["velocity_gain"] * (command[:3] - self.v)
            wanted[2] = drone["gravity"] + limit(wanted[2], gains["max_climb"][0])
            wanted[:2] /= np.sqrt(1 + wanted[:2] @ wanted[:2] / (wanted[2] * np.tan(gains["max_tilt"][0])) ** 2)
            a = turn(self.q, wanted, back=True)
            thrust = np.clip(drone["mass"] * a[2], *output["thrust"]["range"])
            tilt = limit(gains["tilt_gain"] * np.array([-a[1], a[0]]) / np.linalg.norm(a), most)
            rates = np.append(tilt, command[3] * up[2])
        inertia, gyroscopic = np.array(drone["inertia"]), np.cross(self.w, drone["inertia"] * self.w)
        a = (self.allocation[1:] @ self.thrust(self.rotors) - gyroscopic) / inertia
        torque = inertia * drone["rate_gain"] * (rates - self.w) - drone["rate_damping"] * a + gyroscopic
        mixer = np.linalg.pinv(self.allocation)  # what follows is in collective thrust, of which each rotor has a share
        share, tilt, yaw = mixer[:, 0], mixer[:, 1:3] @ torque[:2] / mixer[:, 0], mixer[:, 3] * torque[2] / mixer[:, 0]
        speeds = drone["rotor_speed_min"], drone["rotor_speed_max"]
        low, high = (max(self.thrust(speeds[0]), 0.0) / share).max(), (self.thrust(speeds[1]) / share).min()
        tilt = tilt * min((high - low) / max(np.ptp(tilt), 1e-9), 1.0)
        level = np.clip(thrust, low - tilt.min(), high - tilt.max()) + tilt
        room = np.where(yaw > 0, high - level, level - low) / np.maximum(np.abs(yaw), 1e-12)
        return self.speed((level + np.clip(room.min(), 0.0, 1.0) * yaw) * share)

    def physics(self, command, dt):
        """Semi-implicit Euler; the drag acts ``drag_height`` above the centre of mass."""
        drone, asked = self.drone, self.command(command)
        thrust, torque = np.split(self.allocation @ self.thrust(self.rotors), [1])
        air = turn(self.q, self.v, back=True)
        drag = -(np.array(drone["linear_drag"]) + drone["quadratic_drag"] * np.abs(air)) * air
        torque = torque + np.cross([0, 0, drone.get("drag_height", 0.0)], drag)
        inertia = np.array(drone["inertia"])
        force = turn(self.q, drag + [0, 0, thrust[0]]) / drone["mass"]
        self.v = self.v + dt * (force - [0, 0, drone["gravity"]])
        self.w = self.w + dt * (torque - np.cross(self.w, inertia * self.w)) / inertia
        self.p = self.p + dt * self.v
        w, v = self.q[0], self.q[1:]
        q = self.q + 0.5 * dt * np.append(-v @ self.w, w * self.w + np.cross(v, self.w))
        self.q = q / np.linalg.norm(q)
        self.rotors = asked + (self.rotors - asked) * np.exp(-dt / drone["motor_time_constant"])

    def fly(self, network, steps):
        self.past, dt = [(self.p, self.q, self.v, self.w)], self.about["simulator"]["dt"]
        for _ in range(steps):
            reads = {"observation": self.observation()[None].astype(np.float32), "memory": self.memory}
            reads = {name: reads[name] for name in self.about["graphs"]["policy"]["reads"]}
            action, *memory = network.run(None, reads)
            self.memory = memory[0] if memory else self.memory
            self.queue.append(action[0])
            now, before = self.queue.pop(0), self.p
            for _ in range(round(self.about["control_dt"] / dt)):
                self.physics(0.5 * (self.high + self.low + now * (self.high - self.low)), dt)
            self.advance(before)
            self.past.append((self.p, self.q, self.v, self.w))
        return np.stack([p for p, *_ in self.past])


@pytest.mark.parametrize("task", ["hovering", "tracking", "landing", "racing", "hovering, with memory"])
def test_a_rig_that_reads_the_contract_alone_flies_as_our_simulator_does(task, export_once):
    """Rates, attitude, velocity and rotor thrusts; drag above the centre of mass, where the drone is a Crazyflie."""
    folder = export_once(task)[2]
    contract = json.loads((folder / "contract.json").read_text())
    network = onnxruntime.InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])
    bundle = load_bundle(folder)
    ours = fly(bundle, "torchrl_quad", episodes=3)
    starts = bundle.starts()
    for i in range(3):
        steps = 1 + int(np.argmax(ours["done"][i])) if ours["done"][i].any() else ours["done"].shape[1]
        start = {name: x[i].astype(float if x.dtype.kind == "f" else x.dtype) for name, x in starts.items()}
        way = Rig(contract, start).fly(network, steps)
        np.testing.assert_allclose(way, ours["position"][i, : steps + 1], atol=5e-3)
        assert np.abs(way[-1] - way[0]).max() > 0.05 and steps > 20
