"""What all controllers share: which environments they fly and where to, and how they allow for delayed actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.data.unwrap import base_env, leaf
from torchrl_quad.dynamics import FlightController, Quadrotor
from torchrl_quad.envs import HoveringEnv, LandingEnv, QuadrotorEnv, TrackingEnv
from torchrl_quad.errors import UserTypeError, UserValueError

State = dict[Any, Tensor]
Reference = Callable[[State, Tensor], Tensor]

STENCIL = 0.03  # [s], between the points that derivatives are taken from: with less, rounding makes noise of the jerk
# Landing: this fast [m/s] at this height [m], which lies below that of success; higher up faster, by the rate [1/s].
LANDING_SPEED, LANDING_HEIGHT, LANDING_RATE = 0.15, 0.1, 1.1


class Controller(TensorDictModuleBase):
    """A controller as a deterministic policy: it reads ``("state", ...)`` and writes ``action``, without gradients.

    Its model is the nominal drone: it reads neither randomised parameters nor wind, but the environment's sensors, and
    the true rotor speeds. It simulates the commands that are still on their way, and acts on where they lead: an action
    delay costs it no phase. ``observation_delay`` does.

    Args:
        env: what it will fly, with or without transforms. After ``env.to(device)``, build another one.
        reference: where the drone is wanted, a function from the state, a mapping of names to tensors (num_envs, ...),
            and times (T) [s] from now to positions (num_envs, T, 3) [m], made of torch operations. By default that of
            the task, if it is one that ships.

    Raises:
        TypeError: this is no quadrotor environment.
        ValueError: its dynamics or its actions are others, or its task has no reference.
    """

    def __init__(self, env: Any, reference: Reference | None = None) -> None:
        env = base_env(env)
        name: Any = type(self).__name__
        if not isinstance(env, QuadrotorEnv):
            raise UserTypeError(f"{name} flies a QuadrotorEnv, such as HoveringEnv(); got {type(env).__name__}.")
        if type(env.dynamics) is not Quadrotor:
            model = type(env.dynamics).__name__
            raise UserValueError(f"{name} flies a Quadrotor, not a {model}: build the env with dynamics='quadrotor'.")
        if type(env.dynamics.controller) is not FlightController:
            units = ", ".join(env.action_units)
            raise UserValueError(f"{name} commands body rates, not {units}: build the env with control='rates'.")
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


class Motion(NamedTuple):
    """A reference and its derivatives in time, each (num_envs, T, 3), world frame."""

    position: Tensor  #: [m]
    velocity: Tensor  #: [m/s]
    acceleration: Tensor  #: [m/s2]
    jerk: Tensor  #: [m/s3]


def follow(reference: Reference, state: dict[Any, Tensor], times: Tensor) -> Motion:
    """A reference at times (T) [s] from now, with its derivatives by central differences over five points."""
    h = STENCIL
    around = torch.arange(-2.0, 3.0).to(times) * h
    points = reference(state, (times[:, None] + around).flatten())
    a, b, now, d, e = points.unflatten(1, (len(times), 5)).unbind(2)
    return Motion(
        now,
        (8.0 * (d - b) - (e - a)) / (12.0 * h),
        (16.0 * (b + d) - (a + e) - 30.0 * now) / (12.0 * h**2),
        (e - a - 2.0 * (d - b)) / (2.0 * h**3),
    )


def task_reference(env: QuadrotorEnv, lead: float, name: str) -> Reference:
    """The reference of a task; the action takes effect ``lead`` [s] from now, and the state is the drone's then."""
    if isinstance(env, HoveringEnv):
        return lambda state, t: state["target"].unsqueeze(1).expand(-1, len(t), 3)
    if isinstance(env, TrackingEnv):  # the point that runs along the curve
        curve, rate = env.curve, env.phase_rate
        return lambda state, t: curve(state["phase"] + rate * t)
    if isinstance(env, LandingEnv):  # above the target, and from the height of the drone down, ever more slowly
        bottom = LANDING_HEIGHT - LANDING_SPEED / LANDING_RATE

        def come_down(state: State, t: Tensor) -> Tensor:
            above = (state["position"][:, 2:] - bottom).clamp_min(0.0)
            height = bottom + above * (-LANDING_RATE * (t - lead)).exp()
            return torch.cat((state["target"][:, None, :2].expand(-1, len(t), 2), height.unsqueeze(-1)), -1)

        return come_down
    raise UserValueError(
        f"{name} has no reference for {type(env).__name__}. Write {name}(env, reference=function), with a function "
        "from the state and times (T) [s] to positions (num_envs, T, 3) [m], such as "
        'lambda state, t: state["target"].unsqueeze(1).expand(-1, len(t), 3).'
    )


def check_reference(reference: Any, env: QuadrotorEnv) -> None:
    """Raise a ValueError for what is no reference: it must give the positions at two times in a safe state."""
    rule = "reference is a function from the state and times (T) [s] to positions (num_envs, T, 3) [m]"
    state = {key: x.clone() for key, x in env.control_step.safe_state.items()}
    like = state["position"]
    try:
        points = reference(state, like.new_tensor((0.0, 0.1)))
    except Exception as error:
        raise UserValueError(f"{rule}; given two times it failed: {error}") from error
    if not isinstance(points, Tensor) or points.shape != (len(like), 2, 3) or points.dtype != like.dtype:
        got = f"{tuple(points.shape)}, {points.dtype}" if isinstance(points, Tensor) else type(points).__name__
        raise UserValueError(f"{rule}, here ({len(like)}, 2, 3), {like.dtype}; it made {got}.")
