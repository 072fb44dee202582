"""The hovering task."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.markers import Markers
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, at_episode_end, read
from torchrl_quad.envs.terms import BODY_BOUNDS, TARGET_WEIGHTS, body_observation, distance, outside, target_reward


class HoveringEnv(QuadrotorEnv):
    """Fly to a point and stay there, level and still (paper, table I).

    ==========================  ====  =============================================
    observation                 size  unit
    ==========================  ====  =============================================
    target - position           3     m, world frame
    10 quaternion               4     (w, x, y, z), body to world
    velocity                    3     m/s, world frame
    angular velocity            3     rad/s, body frame
    ==========================  ====  =============================================

    Reward: 0.1 - (0.1/9) |p - target| - 1e-5 |q - level| - 0.002 |v| - 0.002 |w|, at most 25.6 in 256 steps. The
    attitude error is the same for q and -q.

    Start: level and at rest, uniformly within (1, 1, 0.5) m of the target. State added: ``target`` (3) [m].

    End: crash when 5 m away from the target along x or y, or outside 0 < z < 6 m; truncated after
    ``max_episode_steps``. Success of a state: within 0.1 m of the target. Success of an episode: a mean distance below
    0.1 m over its last second, without a crash. Metric: ``position_error``, the distance to the target [m].
    """

    target = (1.0, 0.0, 1.5)  # [m]
    start_range = (1.0, 1.0, 0.5)  # [m], to both sides of the target
    box_half_width = 5.0  # [m], around the target
    box_height = 6.0  # [m]
    weights = TARGET_WEIGHTS
    success_radius = 0.1  # [m]
    metric_info = {
        **EPISODE_METRICS,
        "position_error": Metric("position error", "cm", 100.0, median=True, log=True, goal="min"),
    }

    def initial_state(self, n: int) -> State:
        target = self.tensor(self.target).repeat(n, 1)
        start = target + self.uniform(n, 3) * self.tensor(self.start_range)
        return {**self.hover_state(start), "target": target}

    def observe(self, state: State) -> Tensor:
        return torch.cat((state["target"] - state["position"], *body_observation(state)), -1)

    def observation_bounds(self) -> Tensor:
        return self.tensor((self.box_half_width, self.box_half_width, self.box_height, *BODY_BOUNDS))

    def reward_terms(self, state: State) -> State:
        return target_reward(state, self.weights)

    def is_crash(self, state: State) -> Tensor:
        return outside(state["position"], state["target"], self.box_half_width, self.box_height)

    def is_success(self, state: State) -> Tensor:
        return distance(state) < self.success_radius

    def metrics(self, state: State) -> State:
        return {"position_error": distance(state)}

    def episode_metrics(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Takes ``position_error`` as the mean over the last second of the episode [m], by which it is solved, unless a
        subclass has an ``is_success`` of its own."""
        metrics = super().episode_metrics(rollout)
        error = at_episode_end(rollout, read(rollout, "metrics", "position_error"), steps=round(1 / self.control_dt))
        if type(self).is_success is HoveringEnv.is_success:
            metrics["solved"] = (error < self.success_radius) * (1 - metrics["crash"])
        return {**metrics, "position_error": error}

    def markers(self) -> Markers:
        return Markers(success=self.success_radius)
