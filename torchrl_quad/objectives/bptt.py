"""Backpropagation through time."""

from torchrl_quad.objectives.pathwise import PathwiseLoss


class BPTTLoss(PathwiseLoss):
    """Backpropagation through time: the discounted rewards of a rollout, differentiated (paper, equation 3).

    It is the pathwise loss without a critic: nothing is known beyond the horizon, which therefore has to be long enough
    to show what an action leads to. See :class:`~torchrl_quad.objectives.PathwiseLoss` for the arguments.
    """
