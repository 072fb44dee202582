"""A task of somebody's own, as it would stand in a package of theirs."""

import torch

from torchrl_quad import QuadrotorEnv
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric
from torchrl_quad.envs.terms import body_observation, norm, outside


class CornerEnv(QuadrotorEnv):
    """Fly to a corner; slower drones take ``patience``."""

    weights = {"distance": 0.1}
    metric_info = {**EPISODE_METRICS, "corner_error": Metric("distance to the corner", "m")}

    def __init__(
        self, num_envs: int = 8, *, reach: float = 0.5, patience: int | None = None, dt: float = 0.01, **kwargs
    ):
        self.reach, self.patience = reach, patience
        super().__init__(num_envs, dt=dt, **kwargs)

    def initial_state(self, n):
        return self.hover_state(self.tensor([0.0, 0.0, 1.5]) + self.reach * self.uniform(n, 3))

    def error(self, state):
        return norm(state["position"] - self.tensor([1.0, 1.0, 1.0]))

    def observe(self, state):
        return torch.cat((state["position"], *body_observation(state)), -1)

    def reward_terms(self, state):
        return {"distance": -self.weights["distance"] * self.error(state)}

    def is_crash(self, state):
        return outside(state["position"], self.tensor([0.0, 0.0, 0.0]), 5.0, 4.0)

    def is_success(self, state):
        return self.error(state) < 0.1

    def metrics(self, state):
        return {"corner_error": self.error(state)}
