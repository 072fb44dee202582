"""Where the drone shall be, and when: the references of the tasks that ship, and derivatives of any."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_quad.controllers.laps import plan_lap
from torchrl_quad.envs import HoveringEnv, LandingEnv, QuadrotorEnv, RacingEnv, TrackingEnv
from torchrl_quad.errors import UserValueError, shown

Reference = Callable[[dict[Any, Tensor], Tensor], Tensor]

STENCIL = 0.03  # [s], between the points that derivatives are taken from: with less, rounding makes noise of the jerk
# Landing: this fast [m/s] at this height [m], which lies below that of success; higher up faster, by the rate [1/s].
LANDING_SPEED, LANDING_HEIGHT, LANDING_RATE = 0.15, 0.1, 1.1
CATCH_UP = 0.15  # of the speed of the lap, by which the reference runs ahead of a drone that is slower


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
    """The reference of a task; ``lead`` [s] from now, an action takes effect, and the state is the drone's then.

    Raises:
        ValueError: the task has none.
    """
    for task, make in REFERENCES.items():
        if isinstance(env, task):
            return make(env, lead)
    raise UserValueError(
        f"{name} knows no reference for {type(env).__name__}. Write {name}(env, reference=function), with a function "
        "from the state and times (T) [s] to positions (num_envs, T, 3) [m], such as "
        'lambda state, t: state["target"].unsqueeze(1).expand(-1, len(t), 3).'
    )


def check_reference(reference: Any, env: QuadrotorEnv) -> None:
    """Refuse what is no reference, by asking it for the positions at two times in a state that is safe.

    Raises:
        ValueError: it is no function, fails, or gives something else.
    """
    rule = "reference is a function from the state and times (T) [s] to positions (num_envs, T, 3) [m]"
    if not callable(reference):
        raise UserValueError(f"{rule}; got {shown(reference)}.")
    state = {key: x.clone() for key, x in env.control_step.safe_state.items()}
    like = state["position"]
    try:
        points = reference(state, like.new_tensor((0.0, 0.1)))
    except Exception as error:
        raise UserValueError(f"{rule}; given two times it failed: {error}") from error
    if not isinstance(points, Tensor) or points.shape != (len(like), 2, 3) or points.dtype != like.dtype:
        got = f"{tuple(points.shape)}, {points.dtype}" if isinstance(points, Tensor) else type(points).__name__
        raise UserValueError(f"{rule}, here ({len(like)}, 2, 3), {like.dtype}; it made {got}.")


def hovering(env: HoveringEnv, lead: float) -> Reference:
    """The target."""
    return lambda state, t: state["target"].unsqueeze(1).expand(-1, len(t), 3)


def tracking(env: TrackingEnv, lead: float) -> Reference:
    """The point that runs along the curve."""
    curve, rate = env.curve, env.phase_rate
    return lambda state, t: curve(state["phase"] + rate * t)


def landing(env: LandingEnv, lead: float) -> Reference:
    """Above the target, and from the height of the drone down, ever more slowly."""
    bottom = LANDING_HEIGHT - LANDING_SPEED / LANDING_RATE

    def reference(state: dict[Any, Tensor], t: Tensor) -> Tensor:
        above = (state["position"][:, 2:] - bottom).clamp_min(0.0)
        height = bottom + above * (-LANDING_RATE * (t - lead)).exp()
        return torch.cat((state["target"][:, None, :2].expand(-1, len(t), 2), height.unsqueeze(-1)), -1)

    return reference


def racing(env: RacingEnv, lead: float) -> Reference:
    """The quickest lap, from its point next to the drone on; in step with a drone that is slower, a little ahead.

    A drone that has flown past its gate outside is to come back, and stop at the gate.
    """
    lap = plan_lap(env.gates, env.nominal, env.track["gate_radius"])

    def reference(state: dict[Any, Tensor], t: Tensor) -> Tensor:
        begin, is_missed = lap.locate(state["position"], state["gate"][:, 0], lead)
        velocity = lap.velocity(begin[:, 0])
        along = (state["velocity"] * velocity).sum(-1, keepdim=True) / velocity.square().sum(-1, keepdim=True)
        pace = torch.where(is_missed, 0.0, (along + CATCH_UP).clamp(0.0, 1.0))
        return lap.position(begin + pace * (t - lead))

    return reference


REFERENCES: dict[type[QuadrotorEnv], Callable[[Any, float], Reference]] = {
    HoveringEnv: hovering,
    LandingEnv: landing,
    RacingEnv: racing,
    TrackingEnv: tracking,
}
