"""Experience: differentiable horizons, the states they visited, and normalised observations."""

from torchrl_quad.data.normalizer import ObservationNormalizer
from torchrl_quad.data.rollout import differentiable_rollout
from torchrl_quad.data.visited_states import VisitedStateBuffer

__all__ = ["ObservationNormalizer", "VisitedStateBuffer", "differentiable_rollout"]
