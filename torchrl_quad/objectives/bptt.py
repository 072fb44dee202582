"""Backpropagation through time."""

from torchrl_quad.objectives.pathwise import PathwiseLoss


class BPTTLoss(PathwiseLoss):
    """Backpropagation through time: the discounted rewards of a rollout, differentiated (paper, equation 3).

    It has no critic, so the horizon has to be long enough to show the effect of an action. The arguments are those of
    :class:`~torchrl_quad.objectives.PathwiseLoss`.

    .. code-block:: python

        from torchrl_quad import BPTTLoss, HoveringEnv, differentiable_rollout, make_actor

        env = HoveringEnv(num_envs=8)
        actor = make_actor(env)
        loss = BPTTLoss(actor)
        rollout, carry = differentiable_rollout(env, actor, None, 16)
        loss(rollout)["loss_actor"].backward()
    """
