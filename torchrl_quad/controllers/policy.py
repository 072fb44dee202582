"""What all controllers share: which environments they fly, what they read, and how they allow for delayed actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.controllers.references import Reference, check_reference, task_reference
from torchrl_quad.data.unwrap import base_env, leaf
from torchrl_quad.dynamics import FlightController, Quadrotor
from torchrl_quad.envs import QuadrotorEnv
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.options import checked

State = dict[Any, Tensor]


class Controller(TensorDictModuleBase):
    """A controller as a deterministic policy: it reads ``("state", ...)`` and writes ``action``, without gradients.

    Its model is the nominal drone, as for the flight controller below it: it does not read randomised parameters and
    wind, which stand in the state. Position, attitude, velocity and body rates are those of the environment's sensors;
    the rotor speeds are the true ones. It simulates the commands that are still on their way, and acts on where they
    lead: an action delay costs it no phase. ``observation_delay`` does.

    Args:
        env: what it will fly, with or without transforms. After ``env.to(device)``, build another one.
        reference: where the drone is wanted, a function from the state, a mapping of names to tensors (num_envs, ...),
            and times (T) [s] from now to positions (num_envs, T, 3) [m], made of torch operations. By default that of
            the task, if it is one that ships.

    Raises:
        TypeError: this is no quadrotor environment.
        ValueError: its dynamics or its actions are others, or its task has no reference.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            checked(cls)

    def __init__(self, env: Any, reference: Reference | None = None) -> None:
        env = base_env(env)
        name: Any = type(self).__name__
        if not isinstance(env, QuadrotorEnv):
            raise UserTypeError(
                f"{name} flies a QuadrotorEnv, such as HoveringEnv(num_envs=64); got {type(env).__name__}."
            )
        if type(env.dynamics) is not Quadrotor:
            raise UserValueError(
                f"{name} needs a body with attitude and rotors, and this environment flies "
                f"{type(env.dynamics).__name__}. Build it with dynamics='quadrotor'."
            )
        if type(env.dynamics.controller) is not FlightController:
            raise UserValueError(
                f"{name} commands thrust and body rates, and actions here are {', '.join(env.action_units)}. Build the "
                "environment with control='rates'."
            )
        names = [key if isinstance(key, tuple) else (key,) for key in env.control_step.safe_state]
        self.in_keys, self.out_keys = cast(list[Any], [("state", *key) for key in names]), cast(list[Any], ["action"])
        super().__init__()
        self.dynamics, self.nominal, self.control_dt = env.dynamics, env.nominal, env.control_dt
        self.lead = env.action_delay * env.control_dt  # [s], from a command to its effect
        self.reference = task_reference(env, self.lead, name) if reference is None else reference
        if reference is not None:
            check_reference(reference, env)
        self._measure: list[Callable[[State], State]] = [x.observe for x in env.disturbances.values()]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action (num_envs, 4) in [-1, 1]."""
        state = {key[1] if len(key) == 2 else key[1:]: leaf(tensordict, key).detach() for key in self.in_keys}
        for measure in self._measure:
            state = measure(state)
        drone = {name: state[name] for name in self.dynamics.sizes}
        for action in state["action_queue"].unbind(1) if "action_queue" in state else ():
            drone = self.dynamics.control_step(drone, action, self.nominal, None)
        return self.act({**state, **drone}, tensordict)

    def act(self, state: State, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action; ``state`` holds the drone as it will be when the action takes effect."""
        raise NotImplementedError
