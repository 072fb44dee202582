"""Amended backpropagation through time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_quad.data.unwrap import leaf
from torchrl_quad.errors import UserValueError
from torchrl_quad.objectives.calls import picked, sample_action, segments, step_in_segment, total
from torchrl_quad.objectives.critic import PathwiseCriticLoss
from torchrl_quad.options import Copies, Field


class ABPTLoss(PathwiseCriticLoss):
    """Amended backpropagation through time: the N-step and the 0-step return together (paper, equations 13 to 15).

    For each segment of a rollout, J = (J_N + J_0) / 2 with

    - J_N, the discounted rewards plus gamma^n Q(s_n, a_n), which is exact if the reward is differentiable;
    - J_0 = Q(s_0, a_0), the critic's estimate of the whole reward, differentiable or not.

    Q is the least of the critics, with its gradient in state and action and none in the critics' parameters. a_n, and
    the actions in the critics' targets, are sampled from the policy again.

    .. code-block:: python

        from torchrl_quad import ABPTLoss, HoveringEnv, differentiable_rollout, make_actor, make_qvalue

        env = HoveringEnv(num_envs=8)
        actor = make_actor(env)
        loss = ABPTLoss(actor, make_qvalue(env))
        rollout, carry = differentiable_rollout(env, actor, None, 16)
        losses = loss(rollout)
        (losses["loss_actor"] + losses["loss_qvalue"]).backward()

    Args:
        actor_network: the policy that flew the rollout.
        qvalue_network: the critic Q(s, a), which writes ``state_action_value`` (see ``set_keys``); or a list of such
            critics, of the same layers.
        num_qvalue_nets: the critics made from it, each initialised independently, whose smallest value counts.
        n_step_return: whether J includes J_N.
        zero_step_return: whether J includes J_0.
        simulated_steps: simulated control steps in the 0-step return before the critic takes over: J_0 is then
            sum_(t<k) gamma^t r_t + gamma^k V(s_k), with V(s) = Q(s, a) and a sampled. Its gradient in a_0 is the
            simulator's, not the critic's, which may be noise. With an action delay of d steps a_0 moves nothing before
            step d + 1: take 1 + d or more. J_0 ends with its segment at the latest.
        delay_qvalue: whether the critics have target networks, updated with :class:`torchrl.objectives.SoftUpdate`.
        **kwargs: as for :class:`~torchrl_quad.objectives.PathwiseCriticLoss`.
    """

    @dataclass
    class _AcceptedKeys(PathwiseCriticLoss._AcceptedKeys):
        state_action_value: NestedKey = "state_action_value"

    default_keys = _AcceptedKeys
    critic_name = "qvalue_network"
    critic_loss_key = "loss_qvalue"
    prediction_key = "state_action_value"
    value_part = "zero_step_return"
    samples_actions = True
    out_keys = ["loss_actor", "loss_qvalue", "pred_value", "target_value", "explained_variance"]

    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        num_qvalue_nets: Copies = 2,
        n_step_return: bool = True,
        zero_step_return: bool = True,
        simulated_steps: Annotated[int, Field(ge=0, le=100_000)] = 0,
        delay_qvalue: bool = True,
        **kwargs: Any,
    ) -> None:
        if not (n_step_return or zero_step_return):
            raise UserValueError(
                "ABPTLoss needs n_step_return or zero_step_return: with both off there is no objective."
            )
        if simulated_steps and not zero_step_return:
            raise UserValueError("simulated_steps belong to the 0-step return: leave out zero_step_return=False.")
        super().__init__(actor_network, **kwargs)
        self.simulated_steps = simulated_steps
        self.n_step_return, self.zero_step_return = n_step_return, zero_step_return
        self.out_keys = [*self.out_keys, *["n_step_return"] * n_step_return, *["zero_step_return"] * zero_step_return]
        self._add_critics(qvalue_network, num_qvalue_nets, "num_qvalue_nets", delay_qvalue)

    def loss_qvalue(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The critics' loss (paper, equation 16), summed over critics, and its metadata; takes what SHAC's does."""
        return self._critic_loss(tensordict)

    def objective_parts(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The terms whose sum is J, each (*,): half ``n_step_return`` and half ``zero_step_return``, or one of them."""
        self._check_rollout(tensordict)
        parts = {}
        if self.n_step_return:
            parts["n_step_return"] = total(super().objective_parts(tensordict).values())
        if self.zero_step_return:
            parts["zero_step_return"] = self._zero_step_return(tensordict)
        return {name: part / len(parts) for name, part in parts.items()}

    def _objective(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        parts = self.objective_parts(tensordict)
        return total(parts.values()), {name: len(parts) * part.detach().mean() for name, part in parts.items()}

    def _zero_step_return(self, tensordict: TensorDictBase) -> Tensor:
        """Q(s_0, a_0) of each segment, or the return of its first ``simulated_steps``, summed over segments: (*)."""
        if self.simulated_steps:
            is_first, last = self._simulated(tensordict)
            rewards = (self._discounts(tensordict) * self._reward(tensordict) * is_first).sum((-2, -1))
            return rewards + self._discounted_value(tensordict, last)
        self._check_graph(leaf(tensordict, self.tensor_keys.action), self.tensor_keys.action)
        start, counts = segments(self._next(tensordict, "done"))[0], self._counts(tensordict)
        start = start if counts is None else start & counts
        value = self._critics(picked(tensordict, self.qvalue_network.in_keys, start)).amin(0)
        return torch.zeros_like(start, dtype=value.dtype).masked_scatter(start, value).sum((-2, -1))

    def _simulated(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The first ``simulated_steps`` of each segment, and the last of these, bool (*, horizon, 1)."""
        done = self._next(tensordict, "done")
        index, (_, end) = step_in_segment(done), segments(done)
        is_first = index < self.simulated_steps
        return is_first, is_first & (end | (index == self.simulated_steps - 1))

    def _beside_actions(self, tensordict: TensorDictBase) -> Tensor | float:
        fixed, parts = tensordict.detach(), []
        if self.n_step_return:
            parts.append(self._terminal_value(fixed))
        if self.zero_step_return and self.simulated_steps:
            parts.append(self._discounted_value(fixed, self._simulated(fixed)[1]))
        return total(parts) / (self.n_step_return + self.zero_step_return)

    def _value(self, tensordict: TensorDictBase, *, target: bool) -> Tensor:
        states = tensordict.select(*self._critic_inputs())
        return super()._value(sample_action(self.actor_network, self.actor_network_params, states), target=target)
