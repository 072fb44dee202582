"""Small networks for the losses: tanh-Gaussian actors, visual ones too, a state value and a state-action value."""

from torchrl_quad.modules.actors import make_actor, make_visual_actor
from torchrl_quad.modules.networks import make_qvalue, make_value

__all__ = ["make_actor", "make_qvalue", "make_value", "make_visual_actor"]
