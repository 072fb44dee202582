"""Obstacles: solids, the distance to them, and images of them. Pure functions on plain tensors."""

from torchrl_quad.vision.camera import DepthCamera
from torchrl_quad.vision.primitives import Primitives, closest_approach, nearest
from torchrl_quad.vision.rays import cast_rays

__all__ = ["DepthCamera", "Primitives", "cast_rays", "closest_approach", "nearest"]
