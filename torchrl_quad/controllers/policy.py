"""What all controllers share: which environments they fly and where to, and how they allow for delayed actions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.data.unwrap import base_env, leaf
from torchrl_quad.dynamics import FlightController, Quadrotor, QuadrotorParams
from torchrl_quad.envs import HoveringEnv, LandingEnv, QuadrotorEnv, RacingEnv, TrackingEnv
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.options import checked

State = dict[Any, Tensor]
Reference = Callable[[State, Tensor], Tensor]

STENCIL = 0.03  # [s], between the points that derivatives are taken from: with less, rounding makes noise of the jerk
# Landing: this fast [m/s] at this height [m], which lies below that of success; higher up faster, by the rate [1/s].
LANDING_SPEED, LANDING_HEIGHT, LANDING_RATE = 0.15, 0.1, 1.1
CATCH_UP = 0.15  # of the speed of the lap, by which the reference runs ahead of a drone that is slower
# Laps:
THRUST_SHARE, RATE_SHARE = 0.9, 0.9  # of the greatest thrust and body rate; the rest is left to the feedback
LEAST_LIFT = 0.2  # vertical part of the thrust, in weights: the drone stays upright
GATE_SHARE = 0.3  # of the radius of a gate, by which the lap may miss its centre
HARMONICS = 3  # for each gate
WEIGHTS = (300.0, 3_000.0, 30_000.0)  # of what breaks a limit, one after the other
POINTS = 33  # in the table of each stretch between two gates


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
    for task, make in REFERENCES.items():
        if isinstance(env, task):
            return make(env, lead)
    raise UserValueError(
        f"{name} has no reference for {type(env).__name__}. Write {name}(env, reference=function), with a function "
        "from the state and times (T) [s] to positions (num_envs, T, 3) [m], such as "
        'lambda state, t: state["target"].unsqueeze(1).expand(-1, len(t), 3).'
    )


def check_reference(reference: Any, env: QuadrotorEnv) -> None:
    """Raise a ValueError for what is no reference: it must give the positions at two times in a safe state."""
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
    """The quickest lap, from its point next to the drone on, and a little ahead of a slower drone.

    A drone that has missed its gate has to come back, and stop at the gate.
    """
    lap = plan_lap(env.gates, env.nominal, env.track["gate_radius"])

    def reference(state: dict[Any, Tensor], t: Tensor) -> Tensor:
        begin, is_missed = lap.locate(state["position"], state["gate"][:, 0], lead)
        velocity = lap.velocity(begin[:, 0])
        along = (state["velocity"] * velocity).sum(-1, keepdim=True) / velocity.square().sum(-1, keepdim=True)
        pace = torch.where(is_missed, 0.0, (along + CATCH_UP).clamp(0.0, 1.0))
        return lap.position(begin + pace * (t - lead))

    return reference


REFERENCES: dict[Any, Any] = {HoveringEnv: hovering, LandingEnv: landing, RacingEnv: racing, TrackingEnv: tracking}


class Lap:
    """A closed path of a period [s], from the coefficients (2 K + 1, 3) [m] of 1, K cosines and K sines.

    It passes the gates at the times ``passes`` (gates) [s], the first at zero, rising.
    """

    def __init__(self, coefficients: Tensor, period: float, passes: Tensor) -> None:
        self.coefficients, self.period, self.passes = coefficients, period, passes
        self.rates = 2.0 * math.pi / period * torch.arange(1, len(coefficients) // 2 + 1).to(coefficients)
        ends = torch.where(passes > 0.0, passes, period)
        lengths = ends - passes.roll(1)  # of the stretch before each gate
        shares = torch.linspace(1.0, 0.0, POINTS, dtype=passes.dtype, device=passes.device)
        self.times = ends[:, None] - lengths[:, None] * shares
        self.points = self.position(self.times)

    def position(self, t: Tensor) -> Tensor:
        """Where it is at times (*) [s], (*, 3) [m]."""
        return basis(t, self.rates, 0) @ self.coefficients

    def velocity(self, t: Tensor) -> Tensor:
        """How it moves at times (*) [s], (*, 3) [m/s]."""
        return basis(t, self.rates, 1) @ self.coefficients

    def locate(self, position: Tensor, gate: Tensor, beyond: float) -> tuple[Tensor, Tensor]:
        """The time (n, 1) [s] at which it is next to positions (n, 3) [m] on the way to their next gates (n).

        Second, bool (n, 1), whether the gate has been missed: the time is then ``beyond`` [s] behind it.
        """
        nearest = (self.points[gate] - position.unsqueeze(1)).square().sum(-1).argmin(1, keepdim=True)
        t, low, high = self.times[gate].gather(1, nearest), self.times[gate, :1], self.times[gate, -1:] + beyond
        for _ in range(2):  # Newton's method, from the nearest point of the table
            place, velocity = self.position(t[:, 0]), self.velocity(t[:, 0])
            step = ((position - place) * velocity).sum(-1, keepdim=True) / velocity.square().sum(-1, keepdim=True)
            t = torch.minimum(torch.maximum(t + step, low), high)
        return t, t >= high


def plan_lap(gates: Tensor, drone: QuadrotorParams, gate_radius: float) -> Lap:
    """Plan the quickest lap through gates (g, 3) [m] that leaves some thrust and body rate to the feedback.

    A quadrotor is differentially flat (Mellinger and Kumar 2011): a path with the acceleration a and the jerk j asks
    for the thrust m |a + g| and, where the heading is free, for the body rate |(a + g) x j| / |a + g|^2. L-BFGS
    minimises the period and a penalty on what breaks the limits of the drone or misses the centre of a gate.
    """
    centres, least_gravity = gates.detach().double().cpu(), drone.gravity.detach().double().amin().item()
    gravity = centres.new_tensor((0.0, 0.0, least_gravity))
    max_rate = RATE_SHARE * drone.max_body_rate[..., :2].amin().item()
    most = drone.max_thrust_to_weight.detach().double().amin().item()
    max_thrust = THRUST_SHARE * most * least_gravity  # per mass [m/s2]
    harmonics = HARMONICS * max(len(centres), 4)
    orders = torch.arange(1, harmonics + 1).to(centres)
    scale = torch.cat((orders.new_tensor([1e-3]), orders**3, orders**3)).unsqueeze(1)  # jerk costs alike in all
    angles = 2.0 * math.pi * orders
    gaps = (centres.roll(-1, 0) - centres).norm(dim=1).clamp_min(2.0 * gate_radius)
    shares = torch.cat((gaps.new_zeros(1), gaps.cumsum(0)[:-1])) / gaps.sum()  # of the period, where gates are
    second, third = (basis(torch.arange(16 * harmonics).to(centres) / (16 * harmonics), angles, k) for k in (2, 3))
    with torch.enable_grad():
        x = (torch.linalg.pinv(basis(shares, angles, 0) / scale.T) @ centres).requires_grad_()
        moved = torch.zeros_like(shares[1:]).requires_grad_()
        log_period = (gaps.sum() / 4.0).log().requires_grad_()  # at 4 m/s, to begin with
        unknowns = [x, moved, log_period]
        optimizer = torch.optim.LBFGS(unknowns, max_iter=80, history_size=30, line_search_fn="strong_wolfe")
        for weight in WEIGHTS:

            def objective(weight: float = weight) -> Tensor:
                optimizer.zero_grad()
                period, path = log_period.exp(), x / scale
                force, jerk = second @ path / period**2 + gravity, third @ path / period**3
                thrust = force.norm(dim=1)
                rate = torch.linalg.cross(force, jerk).norm(dim=1) / thrust.square()
                passes = torch.cat((shares[:1], shares[1:] + moved))
                miss = ((basis(passes, angles, 0) @ path - centres).square().sum(1) + 1e-12).sqrt()
                broken = (
                    (thrust / max_thrust - 1.0).clamp_min(0.0).square().mean()
                    + (rate / max_rate - 1.0).clamp_min(0.0).square().mean()
                    + (LEAST_LIFT - force[:, 2] / gravity[2]).clamp_min(0.0).square().mean()
                    + 0.1 * (miss - GATE_SHARE * gate_radius).clamp_min(0.0).square().mean()
                )
                loss = period + weight * broken + 1e-6 * x.square().sum()
                loss.backward()
                return loss

            optimizer.step(objective)
        period = log_period.exp()
        passes = torch.cat((shares[:1], shares[1:] + moved)) * period
        return Lap((x / scale).detach().to(gates), period.item(), passes.detach().to(gates))


def basis(t: Tensor, rates: Tensor, order: int) -> Tensor:
    """The derivative of some order in time of 1, cos(rates t) and sin(rates t), (*, 2 K + 1), at times (*)."""
    angle, factor = t.unsqueeze(-1) * rates + 0.5 * math.pi * order, rates**order
    one = torch.full_like(t, float(order == 0)).unsqueeze(-1)
    return torch.cat((one, factor * angle.cos(), factor * angle.sin()), -1)
