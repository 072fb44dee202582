"""Differentiate the end of a flight in every action and in the mass of the drone, and fit the mass."""

import torch

from torchrl_quad import HoveringEnv

ITERATIONS = 30

torch.manual_seed(0)
env = HoveringEnv(num_envs=1, dtype=torch.float64)  # finite differences are accurate in double precision
start = env.reset()
drone = env.params


def fly(mass, actions):
    """The positions (time, 3) [m] of a drone with a mass [kg] under a sequence of actions."""
    env.params = drone.replace(mass=mass)  # the drone that flies; its controller still believes in the nominal one
    td, positions = start, []
    for action in actions:
        td = env.step_mdp(env.step(td.clone().set("action", action.expand(1, 4))))
        positions.append(td["state", "position"][0])
    return torch.stack(positions)


# 1. How high does the flight end? One backward pass gives the derivative to all 100 entries of the actions.
mass = drone.mass.clone().requires_grad_()
actions = (env.hover_action + 0.1 * torch.randn(25, 4, dtype=env.dtype)).requires_grad_()
height = fly(mass, actions)[-1, 2]
by_mass, by_action = torch.autograd.grad(height, (mass, actions))

# 2. The same by flying twice, with a little more and a little less.
h, nudge = 1e-6, torch.zeros_like(actions)
nudge[0, 0] = 1e-6
with torch.no_grad():
    mass_check = (fly(mass + h, actions) - fly(mass - h, actions))[-1, 2] / (2 * h)
    action_check = (fly(mass, actions + nudge) - fly(mass, actions - nudge))[-1, 2] / (2 * h)
print(f"height by mass:         {by_mass.item():.8f} m/kg, by finite difference {mass_check:.8f}")
print(f"height by first thrust: {by_action[0, 0]:.8f} m,    by finite difference {action_check:.8f}")

# 3. Which mass had the drone of a recorded flight? Minimise the error of the predicted flight.
with torch.no_grad():
    recorded = fly(torch.tensor([0.55], dtype=env.dtype), actions)
log_mass = drone.mass.log().requires_grad_()  # the exponential of any number is a possible mass
optimizer = torch.optim.Adam([log_mass], 0.02, betas=(0.5, 0.9))  # one number needs little memory
for iteration in range(ITERATIONS):
    mass = log_mass.exp()
    error = (fly(mass, actions.detach()) - recorded).square().mean()
    optimizer.zero_grad()
    error.backward()
    optimizer.step()
    if iteration % 5 == 0:
        print(f"iteration {iteration:2}: mass {mass.item():.4f} kg, flight off by {1000 * error.sqrt():.2f} mm")
print(f"fitted: {log_mass.exp().item():.4f} kg; the drone on the record has 0.5500 kg")
