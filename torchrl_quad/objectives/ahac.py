"""Adaptive-horizon actor-critic."""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_quad.errors import UserValueError
from torchrl_quad.objectives.calls import median_length, with_fixed
from torchrl_quad.objectives.shac import SHACLoss
from torchrl_quad.options import Below1, Copies, Field, Horizon, Share

SMOOTHING = 0.2  # how much of the multiplier is new in each iteration


class AHACLoss(SHACLoss):
    """Adaptive-horizon actor-critic (Georgiev et al. 2024, arXiv:2405.17784): SHAC whose horizon follows the stiffness.

    Where the dynamics are stiff the adjoint, the gradient of the objective in each action, grows backwards through the
    horizon. Its ``stiffness`` is the root mean square of the lengths of these gradients over all environments and
    steps, in units of their median: 1 to 2 if all are alike, and large if a few explode. :meth:`adapt_horizon` holds it
    at a bound by a Lagrange multiplier phi on a horizon of N steps:

        phi <- phi + 0.2 (clip(stiffness / max_stiffness - 1, -1, 1) - phi),    N <- N exp(-horizon_lr phi)

    A rollout has N steps, but at least ``min_horizon``. With ``min_lr_factor`` below 1, N falls on while even the
    shortest horizon is too stiff, to ``min_lr_factor * min_horizon``. Multiply the actor's learning rate by
    ``loss.lr_factor``, N / ``min_horizon``, before each iteration: smaller updates make exploding gradients rarer.

    The least of two critics without target networks is the value at the end of the horizon, and that of their targets.
    Georgiev et al. average over the horizon, and have no ``lr_factor``.

    .. code-block:: python

        from torchrl_quad import AHACLoss, HoveringEnv, differentiable_rollout, make_actor, make_value

        env = HoveringEnv(num_envs=8)
        actor = make_actor(env)
        loss = AHACLoss(actor, make_value(env), horizon=16)
        rollout, carry = differentiable_rollout(env, actor, None, loss.horizon)
        losses = loss(rollout)
        (losses["loss_actor"] + losses["loss_value"]).backward()
        loss.adapt_horizon(losses["stiffness"])

    Args:
        actor_network: the policy that flew the rollout, whose action is a TanhNormal or an IndependentNormal.
        horizon: control steps of the first rollout.
        min_horizon: the shortest horizon; None for a quarter of the first.
        max_horizon: the longest horizon; None for twice the first.
        max_stiffness: the bound on the stiffness, above which the horizon gets shorter; 1.5 to 5 are usual.
        horizon_lr: the share by which the horizon, or ``lr_factor``, may change in an iteration.
        min_lr_factor: the least ``lr_factor``; 1 never lowers the learning rate.
        gradient_lmbda: at 1 actions follow the gradient of J, below 1 each that of its own lambda-return, with the
            critic's value after every step, as in Dreamer (Hafner et al. 2020, arXiv:1912.01603). The rewards of
            1 / (1 - lmbda) steps count, and the critic accounts for what jumps, such as a target. 0.98 is usual.
        **kwargs: as for :class:`SHACLoss`.
    """

    measured_of_actions = ["stiffness"]

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule | list[TensorDictModule],
        *,
        horizon: Horizon = 32,
        min_horizon: Horizon | None = None,
        max_horizon: Horizon | None = None,
        max_stiffness: Annotated[float, Field(gt=1, le=1e30)] = 2.0,
        horizon_lr: Below1 = 0.1,
        min_lr_factor: Share = 1.0,
        gradient_lmbda: Share = 1.0,
        num_value_nets: Copies = 2,
        **kwargs: Any,
    ) -> None:
        low = max(horizon // 4, 1) if min_horizon is None else min_horizon
        high = 2 * horizon if max_horizon is None else max_horizon
        if not low <= horizon <= high:
            raise UserValueError(f"horizon={horizon} must lie between min_horizon={low} and max_horizon={high}.")
        options = with_fixed(self, kwargs, target_bootstrap=False, delay_value=False)
        super().__init__(actor_network, value_network, num_value_nets=num_value_nets, **options)
        if gradient_lmbda < 1.0 and not self.terminal_gradient:
            raise UserValueError(
                f"gradient_lmbda={gradient_lmbda} takes the critic's gradient after every step, which "
                "terminal_gradient=False cuts: leave one of them out."
            )
        self.min_horizon, self.max_horizon, self.min_lr_factor = low, high, min_lr_factor
        self.max_stiffness, self.horizon_lr, self.gradient_lmbda = max_stiffness, horizon_lr, gradient_lmbda
        number = {"device": self._default_device, "dtype": torch.float64}
        self.register_buffer("length", torch.tensor(horizon, **number))
        self.register_buffer("multiplier", torch.zeros((), **number))

    @property
    def horizon(self) -> int:
        """Control steps of the next rollout; a checkpoint of the loss holds it."""
        return max(round(self.length.item()), self.min_horizon)

    @property
    def lr_factor(self) -> float:
        """The factor for the actor's learning rate, 1 unless the shortest horizon is too stiff."""
        return min(self.length.item() / self.min_horizon, 1.0)

    @torch.no_grad()
    def adapt_horizon(self, stiffness: Tensor) -> None:
        """Shorten the horizon, or lower ``lr_factor``, if the stiffness is above its bound; raise them if it is below.

        The stiffness is a scalar, as ``loss_actor`` measured it, of several processes their mean. Infinity, for a
        gradient that is not finite, shortens the horizon; NaN, for no gradient at all, changes nothing.
        """
        if stiffness.isnan():
            return
        excess = (stiffness.to(self.length) / self.max_stiffness - 1.0).clamp(-1.0, 1.0)
        self.multiplier.lerp_(excess, SMOOTHING)
        least = self.min_lr_factor * self.min_horizon
        self.length.mul_((-self.horizon_lr * self.multiplier).exp()).clamp_(least, self.max_horizon)

    def _action_gradient(self, tensordict: TensorDictBase, objective: Tensor) -> Tensor:
        if self.gradient_lmbda == 1.0:
            return super()._action_gradient(tensordict, objective)
        grad = self._own_gradient(tensordict, self.gradient_lmbda)
        return grad / tensordict.shape[-1] if self.average_over_horizon else grad

    def _measure(self, grad: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        length = grad.norm(dim=-1)
        counts = length > 0  # the last actions move nothing within the horizon
        stiffness = (length.square().sum() / counts.sum()).sqrt() / median_length(length)
        stiffness = torch.where(length.isfinite().all(), stiffness, math.inf)
        grad, measured = super()._measure(grad)
        return grad, {"stiffness": stiffness, **measured}
