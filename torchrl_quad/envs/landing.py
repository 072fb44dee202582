"""The landing task."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.markers import Markers, Shape
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, at_episode_end, read
from torchrl_quad.envs.terms import BODY_BOUNDS, Event, ball_entry, body_observation, level_crossing, norm, outside


class LandingEnv(QuadrotorEnv):
    """Come down on a point of the ground, slowly (paper, table I).

    ==========================  ====  =============================================
    observation                 size  unit
    ==========================  ====  =============================================
    target - position           3     m, world frame
    10 quaternion               4     (w, x, y, z), body to world
    velocity                    3     m/s, world frame
    angular velocity            3     rad/s, body frame
    ==========================  ====  =============================================

    Reward: descent + approach + success + crash. With c = clip(z, 0.05 m, 1 m), which carries no gradient, the speed of
    descent v_d, the horizontal distance d, and the base e = 1.2:

    - descent: 0.1 (e^x - 1) / (e - 1), where x = v_d / c below v_d = c, and x = 5 - 4 v_d / c above: best is to fall at
      c metres per second;
    - approach: 0.1 (e^(1 - d / (2 c)) - 1) / (e - 1);
    - success: 20, once; crash: -0.1. These two carry no gradient; with ``event_discount`` the time of touchdown does.

    The paper prints an error of the velocity instead of x; the form above is the published one.

    Start: level and at rest, uniformly within 1 m of (2, 0, 2.5) m along each axis. State added: ``target`` (3) [m].

    End: success, when z <= 0.2 m, x and y within 0.3 m of the target, and the speed at most 0.3 m/s; crash, when z <= 0
    otherwise, or 5 m away from the target along x or y, or z >= 6 m; truncated after ``max_episode_steps``. Success of
    an episode: that it ended in success.

    Metrics: ``position_error``, the horizontal distance to the target [m]; ``landing_speed``, the speed [m/s]. Of an
    episode, the values at its end; ``landing_speed`` is NaN where the drone neither came down nor solved it.
    """

    target = (2.0, 0.0, 0.0)  # [m]
    start_centre = (2.0, 0.0, 2.5)  # [m]
    start_range = 1.0  # [m], to both sides
    box_half_width = 5.0  # [m], around the target
    box_height = 6.0  # [m]
    base = 1.2  # of the exponentials in the reward
    weights = {"descent": 0.1, "approach": 0.1, "success": 20.0, "crash": 0.1}
    success_height = 0.2  # [m]
    success_radius = 0.3  # [m], along x and along y
    success_speed = 0.3  # [m/s]
    ends_on_success = True
    metric_info = {
        **EPISODE_METRICS,
        "position_error": Metric("distance over ground", "cm", 100.0, median=True, log=True, goal="min"),
        "landing_speed": Metric("landing speed", "m/s", goal="min"),
    }

    def initial_state(self, n: int) -> State:
        start = self.tensor(self.start_centre) + self.start_range * self.uniform(n, 3)
        return {**self.hover_state(start), "target": self.tensor(self.target).repeat(n, 1)}

    def observe(self, state: State) -> Tensor:
        return torch.cat((state["target"] - state["position"], *body_observation(state)), -1)

    def observation_bounds(self) -> Tensor:
        return self.tensor((self.box_half_width, self.box_half_width, self.box_height, *BODY_BOUNDS))

    def reward_terms(self, state: State) -> State:
        scale = state["position"][..., 2:].detach().clamp(0.05, 1.0)
        descent = -state["velocity"][..., 2:] / scale
        descent = self.exponential(torch.minimum(descent, 5.0 - 4.0 * descent))
        approach = self.exponential(1.0 - self.horizontal_distance(state) / (2.0 * scale))
        return {
            "descent": self.weights["descent"] * descent,
            "approach": self.weights["approach"] * approach,
            "success": self.weights["success"] * self.is_success(state).to(self.dtype),
            "crash": -self.weights["crash"] * self.is_crash(state).to(self.dtype),
        }

    def exponential(self, x: Tensor) -> Tensor:
        """(e^x - 1) / (e - 1): from 0 at x = 0 to 1 at x = 1."""
        return (self.base**x - 1.0) / (self.base - 1.0)

    def is_crash(self, state: State) -> Tensor:
        lost = outside(state["position"], state["target"], self.box_half_width, self.box_height)
        return lost & ~self.is_success(state)

    def is_success(self, state: State) -> Tensor:
        sideways = (state["position"] - state["target"])[..., :2].abs().amax(-1, keepdim=True)
        slow = norm(state["velocity"]) <= self.success_speed
        return (state["position"][..., 2:] <= self.success_height) & (sideways <= self.success_radius) & slow

    def events(self, previous: State, state: State) -> dict[str, Event]:
        """``touchdown``: the last condition of success becomes true."""
        start, end = ((x["position"] - x["target"])[..., :2] for x in (previous, state))
        side = torch.where(start.detach() < 0.0, -1.0, 1.0).to(start)  # from which it comes nearer
        conditions = (
            level_crossing(previous["position"][..., 2:], state["position"][..., 2:], self.success_height),
            level_crossing(side * start, side * end, self.success_radius),
            ball_entry(previous["velocity"], state["velocity"], 0.0, self.success_speed),
        )
        time = torch.cat(conditions, -1).amax(-1, keepdim=True)
        return {"touchdown": Event(self.is_success(state), time, self.weights["success"], term="success")}

    def metrics(self, state: State) -> State:
        return {"position_error": self.horizontal_distance(state), "landing_speed": norm(state["velocity"])}

    def horizontal_distance(self, state: State) -> Tensor:
        """Distance to the target over ground, (*, 1) [m]."""
        return norm((state["position"] - state["target"])[..., :2])

    def episode_metrics(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Gives a ``landing_speed`` only to drones that came down, or solved a subclass's task."""
        metrics = super().episode_metrics(rollout)
        height = at_episode_end(rollout, read(rollout, "state", "position")[..., 2:])
        came_down = (height <= self.success_height) | (metrics["solved"] > 0)
        return {**metrics, "landing_speed": torch.where(came_down, metrics["landing_speed"], torch.nan)}

    def markers(self) -> Markers:
        (x, y, _), reach = self.target, self.success_radius
        zone = (x - reach, y - reach, 0.0), (x + reach, y + reach, self.success_height)
        return Markers(shapes=[Shape.box(*zone, name="landing zone")])
