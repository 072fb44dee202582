"""Flights by hand, a step at a time."""

import torch


def fly(env, td, actions):
    """Step through a list of actions; returns the steps, stacked along time."""
    steps = []
    for action in actions:
        td = td.copy().set("action", action)
        steps.append(env.step(td))
        td = env.step_mdp(steps[-1])
    return torch.stack(steps, 1)
