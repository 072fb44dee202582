"""Experience: differentiable horizons, and the states they visited."""

from torchrl_quad.data.rollout import differentiable_rollout
from torchrl_quad.data.visited_states import VisitedStateBuffer

__all__ = ["VisitedStateBuffer", "differentiable_rollout"]
