"""Policy optimisation via differentiable simulation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_quad.data.unwrap import leaf
from torchrl_quad.errors import Unsupported
from torchrl_quad.objectives.calls import action_gradient, mean_over_steps, median_length, sources_of_steps, with_fixed
from torchrl_quad.objectives.pathwise import PathwiseLoss
from torchrl_quad.options import Positive, between


class PODSLoss(PathwiseLoss):
    r"""Policy optimisation via differentiable simulation (Mora et al. 2021): a policy fitted to better actions.

    Each flown action gets a change that raises the return J of its flight, and the policy learns by least squares,

    .. math:: \tfrac12 \operatorname{mean}_t |\pi(s_t) - (a_t + \delta_t)|^2, \qquad
        \delta = g / \lambda \;\; (\text{order 1}), \qquad (\lambda - \nabla^2 J)\, \delta = g \;\; (\text{order 2}),

    with the gradient g of J in all actions of the flight, and :math:`\lambda` such that the median change of order 1
    has the length ``step``. Order 2 takes the whole second derivative through the dynamics, by conjugate gradients,
    which stop where J curves upwards. Several steps of an optimiser may fit the policy to one flight:

    .. code-block:: python

        from torchrl_quad import HoveringEnv, PODSLoss, differentiable_rollout, make_actor

        env = HoveringEnv(num_envs=8)
        actor = make_actor(env)
        loss = PODSLoss(actor)
        rollout, carry = differentiable_rollout(env, actor, None, 16)
        rollout = loss.write_action_target(rollout).detach()
        for _ in range(4):
            loss(rollout)["loss_actor"].backward()

    Mora et al. change a sequence of actions, and fit the policy where the changed sequence leads. Here the policy
    continues to react while its actions change, and is fitted where it flew: the same flights to first order, without
    flying again. In place of their line search stands ``step``.

    Args:
        actor_network: the policy that flew the rollout, as for ``clip_action_gradient``.
        order: 1 for the gradient alone; 2 needs an eager flight, since compiled ones have first derivatives only.
        step: the median length of a change of order 1, in the units of the action; those of order 2 are no longer
            than that of their gradient alone.
        iterations: at most so many conjugate gradients, each as dear as two backward passes.
        clip_action_gradient: as for :class:`~torchrl_quad.objectives.PathwiseLoss`.
        **kwargs: as there, without an entropy bonus.

    Raises:
        NotImplementedError: (in use) order 2 of a flight that was compiled.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        order: Literal[1, 2] = 1,
        step: Positive = 0.1,
        iterations: Annotated[int, between(1, 100)] = 5,
        clip_action_gradient: Positive | None = 2.0,
        **kwargs: Any,
    ) -> None:
        own = with_fixed(self, kwargs, alpha=0.0)
        super().__init__(actor_network, clip_action_gradient=clip_action_gradient, **own)
        self.order, self.step, self.iterations = order, step, iterations

    def _add_entropy_bonus(self) -> None:
        raise Unsupported(f"{type(self).__name__} has no entropy bonus: leave alpha at 0.")

    def write_action_target(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add ``action_target``, the actions to learn, to a rollout (*, horizon) that carries its graph."""
        if self.order == 1:
            target, _ = self.better_actions(tensordict, self.step)
            return tensordict.set(self.tensor_keys.action_target, target)
        objective, _ = self._objective(tensordict)
        action = leaf(tensordict, self.tensor_keys.action)
        if isinstance(sources_of_steps(action), Tensor):
            raise Unsupported(
                "PODSLoss(order=2) differentiates twice, and a compiled flight only once: call env.eager() before "
                "flying (in a recipe: compile=false), or take order=1."
            )
        whole = action_gradient(objective.sum(), action, create_graph=True)
        grad, _ = self._measure(whole.detach())
        damping = median_length(grad.norm(dim=-1)) / self.step

        def damped(x: Tensor) -> Tensor:
            """lambda - the second derivative, times a change."""
            return damping * x - action_gradient((whole * x).sum(), action)

        change = conjugate_gradients(damped, grad, grad / damping, self.iterations)
        return tensordict.set(self.tensor_keys.action_target, action.detach() + change.nan_to_num(0.0, 0.0, 0.0))

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """``loss_fit`` and its metadata; targets that are missing are added."""
        if self.tensor_keys.action_target not in tensordict:
            tensordict = self.write_action_target(tensordict.copy())
        rewards = self._discounts(tensordict) * self._next(tensordict, "reward")
        target, action = (leaf(tensordict, x) for x in (self.tensor_keys.action_target, self.tensor_keys.action))
        change = mean_over_steps((target - action).norm(dim=-1).detach(), self._counts(tensordict)).mean()
        metadata = {"n_step_return": rewards.sum((-2, -1)).detach().mean(), "change": change}
        return self.loss_fit(tensordict), metadata


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], grad: Tensor, otherwise: Tensor, iterations: int
) -> Tensor:
    """Solve ``product(x) = grad`` for each flight of a batch (*, horizon, k) alone.

    A flight stops at the first direction in which the matrix is not positive: with ``otherwise``, if that is its first.
    """

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum((-2, -1), keepdim=True)

    x, residual, direction = torch.zeros_like(grad), grad, grad
    going = dot(grad, grad) > 0
    for step in range(iterations):
        along = product(direction)
        size, curvature = dot(residual, residual), dot(direction, along)
        going = going & (curvature > 0) & (size > 0)
        if step == 0:
            x = torch.where(going, x, otherwise)
        length = torch.where(going, size / curvature, 0.0)
        x, residual = x + length * direction, residual - length * along
        direction = residual + torch.where(going, dot(residual, residual) / size, 0.0) * direction
    return x
