"""Small networks for the losses: a tanh-Gaussian actor, a state value and a state-action value."""

from torchrl_quad.modules.networks import make_actor, make_qvalue, make_value

__all__ = ["make_actor", "make_qvalue", "make_value"]
