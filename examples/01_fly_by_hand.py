"""Fly with your own commands of thrust and body rates, read the state, and save a picture of the flight."""

import torch

from torchrl_quad import HoveringEnv
from torchrl_quad.render import plot_flight

STEPS = 100

env = HoveringEnv(num_envs=1)


def command(thrust, roll=0.0, pitch=0.0, yaw=0.0):
    """The action for a thrust in units of the drone's weight, and body rates [rad/s]."""
    stick = 2 * thrust / env.nominal.max_thrust_to_weight - 1  # an action lies in [-1, 1]: -1 is no thrust at all
    rates = torch.tensor([roll, pitch, yaw]) / env.nominal.max_body_rate
    return torch.cat((stick, rates)).expand(env.num_envs, 4)


def pilot(time):
    """Climb, slow down, lean forward, lean back, come level again, and hover, without looking where the drone is."""
    if time < 0.4:
        return command(thrust=1.3)
    if time < 0.8:
        return command(thrust=0.7)
    if time < 1.0:
        return command(thrust=1.0, pitch=2.0)
    if time < 1.4:
        return command(thrust=1.0, pitch=-2.0)
    if time < 1.6:
        return command(thrust=1.0, pitch=2.0)
    return command(thrust=1.0)


td = env.reset()
flight = []
print("time [s]    x [m]    z [m]   vx [m/s]   vz [m/s]")
for step in range(STEPS):
    time = step * env.control_dt
    td = env.step(td.set("action", pilot(time)))
    flight.append(td)
    if step % 10 == 0:
        (x, _, z), (vx, _, vz) = td["state", "position"][0], td["state", "velocity"][0]
        print(f"{time:8.2f} {x:8.2f} {z:8.2f} {vx:10.2f} {vz:10.2f}")
    td = env.step_mdp(td)  # moves "next" to where the following step reads it

plot_flight(torch.stack(flight, 1), "flight.png", env=env)
print("The flight is drawn in flight.png.")
