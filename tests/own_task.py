"""Tasks, a disturbance and a loss of somebody's own, as they would stand in a package of theirs."""

from dataclasses import dataclass

import torch

from torchrl_quad import ABPTLoss, QuadrotorEnv
from torchrl_quad.envs.disturbances import Disturbance
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


class RelayEnv(QuadrotorEnv):
    """Visit points in turn, over and over.

    It reads all that a state may have: commands on their way, the number of the step, whole numbers, flags, and nested
    entries.
    """

    ends_on_success = True
    weights = {"distance": 0.1}
    metric_info = {**EPISODE_METRICS, "visited": Metric("points visited"), "nearest": Metric("nearest", "cm", 100.0)}

    def set_up(self):
        self.points = self.tensor([[0.1, 0.0, 1.5], [0.0, 0.2, 1.5], [-0.1, 0.0, 1.4]])

    def initial_state(self, n):
        stage = self.integers(3, n, 1)
        start = self.hover_state(self.points[stage[:, 0]] + 0.1 * self.uniform(n, 3))
        own = {"stage": stage, "visited": torch.zeros_like(stage), "is_near": torch.zeros_like(stage, dtype=torch.bool)}
        return {**start, **own, ("record", "gap"): torch.full_like(start["position"][:, :1], 99.0)}

    def gap(self, state, stage):
        return norm(state["position"] - self.points[stage[:, 0]])

    def advance(self, previous, state):
        gap = self.gap(state, previous["stage"])
        is_near = gap < 0.1
        stage = torch.where(is_near, (previous["stage"] + 1) % 3, previous["stage"])
        nearest = torch.minimum(gap, previous["record", "gap"])
        visited = previous["visited"] + (is_near & ~previous["is_near"])
        return {**state, "stage": stage, "visited": visited, "is_near": is_near, ("record", "gap"): nearest}

    def observe(self, state):
        to_point = self.points[state["stage"][:, 0]] - state["position"]
        late = state["step"] > 20
        parts = [to_point, *body_observation(state), late.to(self.dtype), state["is_near"].to(self.dtype)]
        return torch.cat((*parts, state["action_queue"][:, -1]), -1)

    def reward_terms(self, state):
        return {"distance": -self.weights["distance"] * self.gap(state, state["stage"])}

    def is_crash(self, state):
        return outside(state["position"], self.points[0], 0.6, 4.0)

    def is_success(self, state):
        return state["visited"] >= 3

    def metrics(self, state):
        metrics = {"visited": state["visited"].to(self.dtype), "nearest": state["record", "gap"]}
        return metrics | {"spin": state["rotor_speed"].mean(-1, keepdim=True)}

    def episode_metrics(self, rollout):
        metrics = super().episode_metrics(rollout)
        return {**metrics, "solved": metrics["solved"] * (metrics["nearest"] < 0.09)}


@dataclass
class Push(Disturbance):
    """Push each drone at the start."""

    strength: float = 1.0

    def start(self, random, state):
        return {"velocity": state["velocity"] + self.strength * random.uniform(len(state["position"]), 3)}


class ThriftyLoss(ABPTLoss):
    """ABPT that charges for the size of actions."""

    def __init__(self, actor_network, qvalue_network, *, effort: float = 0.1, **kwargs):
        super().__init__(actor_network, qvalue_network, **kwargs)
        self.effort = effort

    def objective_parts(self, tensordict):
        action = tensordict.get(self.tensor_keys.action)
        return {**super().objective_parts(tensordict), "effort": -self.effort * action.square().sum((-2, -1))}
