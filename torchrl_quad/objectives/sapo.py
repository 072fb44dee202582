"""Soft analytic policy optimization."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_quad.data.unwrap import leaf
from torchrl_quad.objectives.calls import with_fixed
from torchrl_quad.objectives.shac import SHACLoss
from torchrl_quad.options import Copies, Scale, between


class SAPOLoss(SHACLoss):
    """Soft analytic policy optimization (Xing et al. 2025, arXiv:2412.12089): short-horizon actor-critic with entropy.

    The objective of a segment is sum_t gamma^t (r_t + alpha H_t) + gamma^n V(s_n), and the critics learn the same soft
    return. H_t = (h_t + |h*|) / (2 |h*|) measures the entropy h_t = -log pi(a_t|s_t) against its target h* < 0: it is 0
    at h*, and 1 at -h*, for any number of action entries. The critics have no target networks. Their targets take the
    least of them, and the actor climbs their mean. Xing et al. average over the horizon.

    .. code-block:: python

        from torchrl_quad import HoveringEnv, SAPOLoss, differentiable_rollout, make_actor, make_value

        env = HoveringEnv(num_envs=8)
        actor = make_actor(env, return_log_prob=True)
        loss = SAPOLoss(actor, make_value(env))
        rollout, carry = differentiable_rollout(env, actor, None, 16)
        losses = loss(rollout)
        (losses["loss_actor"] + losses["loss_value"] + losses["loss_alpha"]).backward()

    Args:
        actor_network: the policy that flew the rollout, with log-probabilities (``return_log_prob=True``).
        alpha: the coefficient of the entropy: a positive number, or auto to hold the entropy at its target; without
            entropy take SHACLoss.
        alpha_init: what alpha=auto starts from.
        target_entropy: where alpha=auto holds the entropy: a negative number, or auto for minus half the number of
            action entries. The entropy is measured in its size.
        **kwargs: as for :class:`SHACLoss`.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule | list[TensorDictModule],
        *,
        num_value_nets: Copies = 2,
        alpha: Scale | Literal["auto"] = "auto",
        alpha_init: Scale = 1.0,
        target_entropy: Annotated[float, between(-1e6, -1e-3)] | Literal["auto"] = "auto",
        **kwargs: Any,
    ) -> None:
        own: dict[str, Any] = {"alpha": alpha, "alpha_init": alpha_init, "target_entropy": target_entropy}
        own |= with_fixed(self, kwargs, target_bootstrap=False, delay_value=False)
        super().__init__(actor_network, value_network, num_value_nets=num_value_nets, **own)

    def write_value_target(self, tensordict: TensorDictBase) -> TensorDictBase:
        """As :meth:`PathwiseCriticLoss.write_value_target`, with the soft reward r_t + alpha H_t."""
        self._check_rollout(tensordict)
        soft, key = tensordict.detach(), ("next", self.tensor_keys.reward)
        soft.set(key, leaf(soft, key) + self.alpha * self._normalized_entropy(soft))
        target = self.tensor_keys.value_target
        return tensordict.set(target, leaf(super().write_value_target(soft), target))

    def _entropy_bonus(self, tensordict: TensorDictBase) -> Tensor:
        steps = tensordict.shape[-1] if self.average_over_horizon else 1
        entropy = self._discounts(tensordict) * self._normalized_entropy(tensordict)
        return self.alpha * entropy.sum((-2, -1)) / steps

    def _normalized_entropy(self, tensordict: TensorDictBase) -> Tensor:
        """(h + |h*|) / (2 |h*|) of each step: (*, horizon, 1)."""
        size, counts = abs(self._target_entropy(tensordict)), self._counts(tensordict)
        entropy = (self._surprise(tensordict) + size) / (2.0 * size)
        return entropy if counts is None else torch.where(counts, entropy, 0.0)

    def _target_entropy(self, tensordict: TensorDictBase) -> float:
        target = super()._target_entropy(tensordict)
        return 0.5 * target if self.target_entropy == "auto" else target

    def _value(self, tensordict: TensorDictBase, *, target: bool) -> Tensor:
        values = self._critics(tensordict, target=target)
        return values.amin(0) if target else values.mean(0)
