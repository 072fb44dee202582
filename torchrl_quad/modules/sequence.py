"""Open-loop control: a sequence of actions as a policy."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_quad.engine.policy import GivenActions


class ActionSequence(TensorDictModuleBase):
    """A policy that plays given actions one after another, to optimise a trajectory itself. It plays them once.

    .. code-block:: python

        actions = torch.zeros(32, env.num_envs, 4, requires_grad=True)
        rollout, _ = differentiable_rollout(env, ActionSequence(actions), env.reset(), len(actions))
        rollout["next", "reward"].sum().backward()  # fills actions.grad

    Args:
        actions: (horizon, num_envs, k); gradients reach them.

    Raises:
        ValueError: (in use) there are no actions left.
    """

    def __init__(self, actions: Tensor) -> None:
        self.in_keys, self.out_keys = [], ["action"]
        super().__init__()
        self.actions, self.played = actions, 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next action."""
        return tensordict.set("action", self.take(1)[0])

    def plain(self) -> GivenActions:
        """The rest of the sequence on plain tensors, for an environment that flies it inside its compiled step."""
        return GivenActions(self.take)

    def take(self, steps: int) -> Tensor:
        """The next actions, (steps, num_envs, k)."""
        left = len(self.actions) - self.played
        if steps > left:
            raise ValueError(
                f"The sequence has {len(self.actions)} actions, {left} of them unplayed, and the flight wants {steps} "
                "more. Give as many actions as the flight has steps, and build a new ActionSequence for each flight."
            )
        self.played += steps
        return self.actions[self.played - steps : self.played]
