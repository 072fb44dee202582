"""Short-horizon actor-critic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_quad.errors import UserValueError
from torchrl_quad.objectives.critic import PathwiseCriticLoss
from torchrl_quad.options import Copies


class SHACLoss(PathwiseCriticLoss):
    """Short-horizon actor-critic (Xu et al. 2022, arXiv:2204.07137).

    The objective of a segment is its discounted rewards plus gamma^n V(s_n). The terminal value keeps its gradient in
    the state and has none in the critic, which regresses to TD(lambda) targets of a target network. Xu et al. take V
    from the target critic and divide by the number of steps: ``target_bootstrap=True, average_over_horizon=True``.

    .. code-block:: python

        from torchrl_quad import HoveringEnv, SHACLoss, differentiable_rollout, make_actor, make_value

        env = HoveringEnv(num_envs=8)
        actor = make_actor(env)
        loss = SHACLoss(actor, make_value(env))
        rollout, carry = differentiable_rollout(env, actor, None, 16)
        losses = loss(rollout)
        (losses["loss_actor"] + losses["loss_value"]).backward()

    Args:
        actor_network: the policy that flew the rollout.
        value_network: the critic V(s), which writes ``state_value`` (see ``set_keys``); or a list of such critics, of
            the same layers.
        terminal_gradient: whether the terminal value keeps its gradient in the state. False cuts it, as the code
            published with the paper does: the actor then climbs the rewards of the horizon alone.
        target_bootstrap: whether the terminal value is the target critic's. False takes it from the critic itself.
        average_over_horizon: whether the objective is divided by the number of steps of the rollout. The entropy bonus
            is a mean over steps either way.
        num_value_nets: the critics made from ``value_network``, whose smallest value counts. Several are each
            initialised independently; a single one is taken as it is.
        delay_value: whether the critic has a target network, to be updated with :class:`torchrl.objectives.SoftUpdate`.
        **kwargs: as for :class:`~torchrl_quad.objectives.PathwiseCriticLoss`.
    """

    @dataclass
    class _AcceptedKeys(PathwiseCriticLoss._AcceptedKeys):
        value: NestedKey = "state_value"

    default_keys = _AcceptedKeys
    critic_name = "value_network"
    critic_loss_key = "loss_value"
    prediction_key = "value"
    out_keys = ["loss_actor", "loss_value", "n_step_return", "pred_value", "target_value", "explained_variance"]

    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule | list[TensorDictModule],
        *,
        terminal_gradient: bool = True,
        target_bootstrap: bool = False,
        average_over_horizon: bool = False,
        num_value_nets: Copies = 1,
        delay_value: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(actor_network, **kwargs)
        if target_bootstrap and not terminal_gradient:
            raise UserValueError(
                "target_bootstrap says whose value ends the horizon, and terminal_gradient=False cuts its gradient, so "
                "that it would change nothing. Leave one of them out."
            )
        self.terminal_gradient, self.target_bootstrap = terminal_gradient, target_bootstrap
        self.average_over_horizon = average_over_horizon
        self._add_critics(value_network, None if num_value_nets == 1 else num_value_nets, "num_value_nets", delay_value)
        critic, keys = self.value_network, self.tensor_keys
        if keys.action in critic.in_keys and getattr(keys, self.prediction_key) in critic.out_keys:
            raise UserValueError(f"{type(self).__name__} needs a V(s), which reads no action: make_value builds one.")

    def loss_value(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The critic's loss (paper, equation 16) and its metadata, of a rollout, or of samples (n) with targets."""
        return self._critic_loss(tensordict)

    def objective_parts(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The terms whose sum is J, each (*,): discounted ``rewards`` of the segments, and their ``terminal_value``."""
        steps = tensordict.shape[-1] if self.average_over_horizon else 1
        return {name: part / steps for name, part in super().objective_parts(tensordict).items()}

    def _terminal_value(self, tensordict: TensorDictBase) -> Tensor:
        value = super()._terminal_value(tensordict)
        return value if self.terminal_gradient else value.detach()
