"""Write a disturbance as one class: a battery that runs down, and thrust that falls with its voltage."""

import torch

from torchrl_quad import HoveringEnv, load_drone
from torchrl_quad.envs import Disturbance

STEPS = 256


class BatterySag(Disturbance):
    """A pack whose voltage falls with every newton second that it has lifted.

    Motor controllers without a speed loop turn rotors in proportion to the voltage, so thrust goes with its square.
    Entries of the state: ``voltage`` (1), as a share of the full one, and the thrust map of the drone that flies.
    """

    def __init__(self, drone, loss):
        self.thrust_map = drone.thrust_map.tolist()
        self.loss = loss  # [1/(N s)], share of the voltage that a newton second costs

    def start(self, random, state):
        voltage = 0.95 + 0.05 * random.uniform(len(state["position"]), 1)  # 0.9 to 1: not every pack is full
        return self.entries(voltage, random.tensor(self.thrust_map))

    def advance(self, state, noise, dt):
        thrust_map, speed = state["drone", "thrust_map"], state["rotor_speed"]
        k2, k1, k0 = thrust_map.split(1, -1)
        lifted = (k2 * speed.square() + k1 * speed + k0).sum(-1, keepdim=True) * dt
        voltage = (state["voltage"] - self.loss * lifted).clamp_min(0.5)
        return self.entries(voltage, thrust_map / state["voltage"].square())

    def entries(self, voltage, full_thrust_map):
        return {"voltage": voltage, ("drone", "thrust_map"): full_thrust_map * voltage.square()}


env = HoveringEnv(num_envs=1, disturbances=[BatterySag(load_drone("visfly"), loss=0.003)])  # a very small pack
climb = env.hover_action + torch.tensor([0.2, 0.0, 0.0, 0.0])
flight = env.rollout(STEPS, lambda td: td.set("action", climb.expand(1, 4)))["next", "state"]  # until it crashes
print("time [s]   voltage [%]   height [m]   climb [m/s]")
for t in range(0, flight.shape[1], 16):
    voltage, height = flight["voltage"][0, t, 0], flight["position"][0, t, 2]
    print(f"{0.02 * (t + 1):8.2f} {100 * voltage:13.1f} {height:12.2f} {flight['velocity'][0, t, 2]:13.2f}")
