"""The hovering task."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.linalg import vector_norm

from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs.base import QuadrotorEnv, State


class HoveringEnv(QuadrotorEnv):
    """Fly to a point and stay there, level and still (paper, table I).

    ==========================  ====  =============================================
    observation                 size  unit
    ==========================  ====  =============================================
    target - position           3     10 m, world frame
    quaternion                  4     (w, x, y, z), body to world
    velocity                    3     10 m/s, world frame
    angular velocity            3     10 rad/s, body frame
    ==========================  ====  =============================================

    Reward: 0.1 - (0.1/9) |p - target| - 1e-5 |q - level| - 0.002 |v| - 0.002 |w|, at most 25.6 in 256 steps. The
    attitude error is the same for q and -q.

    Start: level and at rest, uniformly within (1, 1, 0.5) m of the target. State added: ``target`` (3) [m].

    End: crash when 5 m away from the target along x or y, or outside 0 < z < 6 m; truncated after
    ``max_episode_steps``. Success of a state: within 0.1 m of the target. Success of an episode: a mean distance below
    0.1 m over its last second, without a crash.
    """

    target = (1.0, 0.0, 1.5)  # [m]
    start_range = (1.0, 1.0, 0.5)  # [m], to both sides of the target
    survival_reward = 0.1
    position_weight = 0.1 / 9  # [1/m]
    attitude_weight = 1e-5
    velocity_weight = 0.002  # [s/m]
    angular_velocity_weight = 0.002  # [s/rad]
    success_radius = 0.1  # [m]

    def initial_state(self, n: int) -> State:
        target = self.tensor(self.target).repeat(n, 1)
        start = target + self.uniform(n, 3) * self.tensor(self.start_range)
        return {**self.hover_state(start), "target": target}

    def observe(self, state: State) -> Tensor:
        error = state["target"] - state["position"]
        return torch.cat((error / 10, state["quaternion"], state["velocity"] / 10, state["angular_velocity"] / 10), -1)

    def reward_terms(self, state: State) -> State:
        distance = self.distance(state)
        level = quaternion.identity(state["quaternion"])
        return {
            "survival": torch.full_like(distance, self.survival_reward),
            "position": -self.position_weight * distance,
            "attitude": -self.attitude_weight * quaternion.distance(state["quaternion"], level),
            "velocity": -self.velocity_weight * vector_norm(state["velocity"], dim=-1, keepdim=True),
            "angular_velocity": -self.angular_velocity_weight
            * vector_norm(state["angular_velocity"], dim=-1, keepdim=True),
        }

    def is_terminated(self, state: State) -> Tensor:
        sideways = (state["position"] - state["target"])[..., :2].abs().amax(-1, keepdim=True)
        height = state["position"][..., 2:]
        return (sideways > 5.0) | (height <= 0.0) | (height >= 6.0)

    def is_success(self, state: State) -> Tensor:
        return self.distance(state) < self.success_radius

    def distance(self, state: State) -> Tensor:
        """Distance to the target, (*, 1) [m]."""
        return vector_norm(state["position"] - state["target"], dim=-1, keepdim=True)

    def episode_metrics(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Adds ``error``, the mean distance to the target over the last second of the episode [m]."""
        metrics = super().episode_metrics(rollout)
        first = self.first_episode(rollout)
        steps_left = first.sum(1, keepdim=True) - first.cumsum(1)
        last_second = first & (steps_left < round(1 / self.control_dt))
        distance = self.distance(rollout["next", "state"])
        error = ((distance * last_second).sum(1) / last_second.sum(1)).squeeze(-1)
        success = (error < self.success_radius) * (1 - metrics["crash"])
        return {**metrics, "success": success, "error": error}
