"""Backpropagation through time."""

from torchrl_quad.objectives.pathwise import PathwiseLoss


class BPTTLoss(PathwiseLoss):
    """Backpropagation through time: the discounted rewards of a rollout, differentiated (paper, equation 3).

    It has no critic and knows nothing beyond the horizon, which has to be long enough to show the effect of an action.
    See :class:`~torchrl_quad.objectives.PathwiseLoss` for the arguments.
    """
