"""The tracking task."""

import functools
import math
from collections.abc import Callable
from typing import Annotated, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.engine.packing import Key
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs import terms
from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.markers import Markers
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import Size, accepted, between

Curve = Callable[[Tensor], Tensor]


def circle(phase: Tensor, centre: tuple[float, float, float], radius: float) -> Tensor:
    """A level circle, flown counter-clockwise from +x; centre and radius in m."""
    x, y, z = centre
    return torch.stack((x + radius * phase.cos(), y + radius * phase.sin(), torch.full_like(phase, z)), -1)


def lemniscate(phase: Tensor, centre: tuple[float, float, float], half_length: float) -> Tensor:
    """A level figure of eight (Gerono's) along x, half as wide as long; centre and half_length in m."""
    x, y, z = centre
    sine, cosine = phase.sin(), phase.cos()
    return torch.stack((x + half_length * cosine, y + half_length * sine * cosine, torch.full_like(phase, z)), -1)


CURVES: dict[str, tuple[Curve, float]] = {  # by name: the curve, and its period [s]; the lemniscate is not the paper's
    "slow_circle": (functools.partial(circle, centre=(2.0, 0.0, 1.0), radius=2.0), 10.0),
    "fast_circle": (functools.partial(circle, centre=(3.0, 0.0, 2.0), radius=1.5), 2.0),
    "lemniscate": (functools.partial(lemniscate, centre=(2.0, 0.0, 1.5), half_length=2.0), 8.0),
}
_CURVE = f"one of {', '.join(CURVES)}, or a function from phases (*) [rad] to positions (*, 3) [m]"
CurveOption = Annotated[Any, accepted(lambda x: callable(x) or (isinstance(x, str) and x in CURVES), _CURVE)]


class TrackingEnv(QuadrotorEnv):
    """Follow a point that moves along a periodic curve (paper, table I).

    ==========================================  ====  =============================================
    observation                                 size  unit
    ==========================================  ====  =============================================
    next 10 points of the curve - position      30    m, world frame; 0.1, 0.2 to 1.0 s ahead
    10 quaternion                               4     (w, x, y, z), body to world
    velocity                                    3     m/s, world frame
    angular velocity                            3     rad/s, body frame
    ==========================================  ====  =============================================

    Reward: that of hovering, with the point as its target: 0.1 - (0.1/9) |p - target| - 1e-5 |q - level| - 0.002 |v|
    - 0.002 |w|.

    Start: level and at rest, uniformly within 0.2 m of the point along each axis; the phase is uniform. State added:
    ``phase`` (1) [rad] in [0, 2 pi), ``target`` (3) [m], the point that belongs to it, and ``squared_error`` (1) [m2],
    summed for the metric below.

    End: crash when 5 m away from the centre of the curve along x or y, or outside 0 < z < 6 m (a curve that needs more
    room has 3 m beyond it); truncated after ``max_episode_steps``, 512. Success of a state: within 0.1 m of the
    point. Success of an episode: ``tracking_rmse`` below 0.1 m, without a crash.

    Metrics: ``position_error``, the distance to the point [m]; ``tracking_rmse``, the root of its mean square since 2 s
    after the start [m] (before that: since the start).

    Args:
        curve: "slow_circle" (2 m, 1.26 m/s), "fast_circle" (1.5 m, 4.7 m/s, 14.8 m/s2: out of reach at 2 rad/s, fly it
            with a drone that turns at 6 rad/s), "lemniscate" (2 m, 8 s), or your own function from phases (*) [rad] to
            positions (*, 3) [m], of period 2 pi, made of torch operations.
        period: time for one round, 0.1 to 10,000 s; by default that of the named curve.
        **kwargs: as for :class:`~torchrl_quad.envs.QuadrotorEnv`.

    Raises:
        ValueError: the curve is not periodic, underground, of the wrong shape, or has no period.
    """

    lookahead = 10  # points observed
    lookahead_interval = 0.1  # [s], between them
    start_range = 0.2  # [m], to both sides of the point
    settling_time = 2.0  # [s], not counted in the tracking error
    box_half_width = 5.0  # [m], around the centre of the curve
    box_margin = 3.0  # [m], beyond the curve at least
    box_height = 6.0  # [m]
    weights = terms.TARGET_WEIGHTS
    success_radius = 0.1  # [m]
    metric_info = {
        **EPISODE_METRICS,
        "tracking_rmse": Metric("tracking RMSE", "cm", 100.0, median=True, log=True, goal="min"),
        "position_error": Metric("position error", "cm", 100.0, median=True, log=True, goal="min"),
    }

    def __init__(
        self,
        num_envs: Size = 64,
        *,
        curve: CurveOption = "slow_circle",
        period: Annotated[float, between(0.1, 10_000.0)] | None = None,
        max_episode_steps: Size = 512,
        **kwargs: Any,
    ) -> None:
        if isinstance(curve, str):
            curve, usual = CURVES[curve]
            period = period or usual
        if period is None:
            raise UserValueError("Your own curve needs a period in seconds, such as period=10.0; got none.")
        self.curve = functools.partial(curve)  # not itself: an environment registers modules as its own
        self.period, self.phase_rate = period, 2 * math.pi / period  # [s], [rad/s]
        super().__init__(num_envs, max_episode_steps=max_episode_steps, **kwargs)

    def set_up(self) -> None:
        phase = torch.linspace(0, 2 * math.pi, 257, device=self.device, dtype=self.dtype)
        points = _checked_points(self.curve, phase, self.start_range)
        low, high = points.amin(0), points.amax(0)
        self.curve_points, self.centre = points, 0.5 * (low + high)  # of phases from 0 to 2 pi
        self.half_width = (0.5 * (high - low)[:2] + self.box_margin).clamp_min(self.box_half_width)
        self.ceiling = max(self.box_height, high[2].item() + self.box_margin)
        self.settling_steps = round(self.settling_time / self.control_dt)  # that the tracking error leaves out
        self.ahead = phase.new_tensor(range(1, self.lookahead + 1)) * self.lookahead_interval * self.phase_rate

    def initial_state(self, n: int) -> State:
        phase = (self.uniform(n, 1) + 1.0) * math.pi
        target = self.curve(phase[:, 0])
        start = self.hover_state(target + self.start_range * self.uniform(n, 3))
        return {**start, "phase": phase, "target": target, "squared_error": torch.zeros_like(phase)}

    def advance(self, previous: State, state: State) -> State:
        phase = torch.remainder(previous["phase"] + self.phase_rate * self.control_dt, 2 * math.pi)
        state = {**state, "phase": phase, "target": self.curve(phase[:, 0])}
        error = terms.distance(state).detach().square()
        is_settled = previous["step"] == self.settling_steps
        return {**state, "squared_error": error + torch.where(is_settled, 0.0, previous["squared_error"])}

    def observe(self, state: State) -> Tensor:
        points = self.curve(state["phase"] + self.ahead) - state["position"].unsqueeze(1)
        return torch.cat((points.flatten(1), *terms.body_observation(state)), -1)

    def observation_bounds(self) -> Tensor:
        width, depth = (2.0 * self.half_width).tolist()  # from one side of the box to the other
        return self.tensor((*self.lookahead * (width, depth, self.ceiling), *terms.BODY_BOUNDS))

    def reward_terms(self, state: State) -> State:
        return terms.target_reward(state, self.weights)

    def is_crash(self, state: State) -> Tensor:
        return terms.outside(state["position"], self.centre, self.half_width, self.ceiling)

    def is_success(self, state: State) -> Tensor:
        return terms.distance(state) < self.success_radius

    def metrics(self, state: State) -> State:
        settled = state["step"] > self.settling_steps
        counted = torch.where(settled, state["step"] - self.settling_steps, state["step"]).clamp_min(1)
        return {"position_error": terms.distance(state), "tracking_rmse": (state["squared_error"] / counted).sqrt()}

    def state_bounds(self) -> dict[Key, tuple[float, float]]:
        return {"phase": (0, 2 * math.pi), "squared_error": (0, math.inf)}

    def episode_metrics(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Judges the episode by its ``tracking_rmse``, unless a subclass has an ``is_success`` of its own."""
        metrics = super().episode_metrics(rollout)
        if type(self).is_success is TrackingEnv.is_success:
            metrics["solved"] = (metrics["tracking_rmse"] < self.success_radius) * (1 - metrics["crash"])
        return metrics

    def markers(self) -> Markers:
        phase = torch.linspace(0, 2 * math.pi, 129, device=self.device, dtype=self.dtype)
        return Markers(curve=self.curve(phase), success=self.success_radius)


def _checked_points(curve: Curve, phase: Tensor, margin: float) -> Tensor:
    """The points (257, 3) of a curve at phases (257) over one period with both ends, if it can be flown."""
    rule = f"A curve maps a tensor of phases (*) to one of positions (*, 3), both {phase.dtype}"
    try:
        points = curve(phase.repeat(2, 1))
    except Exception as error:
        raise UserValueError(f"{rule}; given a tensor of shape (2, 257) it failed: {error}") from error
    if not isinstance(points, Tensor) or points.shape != (2, 257, 3) or points.dtype != phase.dtype:
        made = f"{tuple(points.shape)}, {points.dtype}" if isinstance(points, Tensor) else f"a {type(points).__name__}"
        raise UserValueError(f"{rule}; from shape (2, 257) it made {made}.")
    points = points[0]
    if not points.isfinite().all():
        raise UserValueError("The curve is not finite everywhere in [0, 2 pi].")
    gap, lowest = terms.norm(points[0] - points[-1]).item(), points[:, 2].min().item()
    if gap > 0.01:
        raise UserValueError(f"The curve is not periodic: it moves by {gap:.3g} m from phase 0 to 2 pi. Make it close.")
    if lowest <= margin:
        raise UserValueError(
            f"The curve goes down to z = {lowest:.3g} m, and drones start up to {margin} m below it. Lift it."
        )
    return points
