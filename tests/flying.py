"""Flights by hand, a step at a time."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

# Drones of every kind of controller settings, for flights that would take too long with all that ship.
FLOWN = ("crazyflie", "flightmare", "small_racer", "visfly")


def fly(env, td, actions):
    """Step through a list of actions; returns the steps, stacked along time."""
    steps = []
    for action in actions:
        td = td.copy().set("action", action)
        steps.append(env.step(td))
        td = env.step_mdp(steps[-1])
    return torch.stack(steps, 1)


def hold(env, steps):
    """The actions that hover, for some steps."""
    return [env.hover_action.expand(env.num_envs, 4)] * steps


def start(env, **entries):
    """A reset with some entries of the state set."""
    td = env.reset()
    for key, value in entries.items():
        td["state", key] = torch.as_tensor(value, dtype=td["state", key].dtype).expand_as(td["state", key]).clone()
    return env.reset(td, set_state=True)


def anew(env, seed=0):
    """The environment, whose generator and torch's own begin from a seed."""
    env.set_seed(seed)
    torch.manual_seed(seed)
    return env


def pushed(env, actor, at, push):
    """Nine steps in TorchRL's loop, without a graph; ``push`` changes what the actor writes in step ``at``."""
    count = iter(range(100))

    def policy(td):
        td = actor(td)
        if next(count) == at:
            push(td)
        return td

    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return EnvBase.rollout(anew(env), 9, policy, auto_cast_to_device=False, break_when_any_done=False)


def on_plain_tensors(actor, td, kind=ExplorationType.RANDOM):
    """What an actor writes, its form on plain tensors, and the noise that was drawn."""
    with set_exploration_type(kind):
        torch.manual_seed(3)
        written, plain = actor(td.copy()), actor.plain()
        torch.manual_seed(3)
        return written, plain, plain.drawn(1, len(td), {})[0]


def look_at_nothing(patch):
    """Let the code believe that its tensors are on an accelerator, which it must not wait for."""
    for name in ("engine.horizon", "envs.randomness", "envs.guard"):
        patch.setattr(f"torchrl_quad.{name}.looks_are_free", lambda device: False)


class Looks(TorchDispatchMode):
    """Counts how often a value of a tensor is read."""

    count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count += function is torch.ops.aten._local_scalar_dense.default
        return function(*args, **(kwargs or {}))
