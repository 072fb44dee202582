"""What the losses with a critic share: its targets, its loss, and the value that ends each segment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.utils import ValueEstimators, distance_loss

from torchrl_quad.data.unwrap import check_tensordict, group, leaf
from torchrl_quad.errors import UserValueError
from torchrl_quad.objectives.calls import (
    action_gradient,
    discounts,
    picked,
    predict,
    segments,
    takes_rollout,
    td_lambda,
)
from torchrl_quad.objectives.pathwise import PathwiseLoss


class PathwiseCriticLoss(PathwiseLoss):
    """A pathwise loss with a critic, whose value ends each segment and which learns TD(lambda) targets.

    Args:
        actor_network: the policy that flew the rollout.
        loss_function: the distance of a prediction from its target: l2, its square; l1; or smooth_l1.
        **kwargs: as for :class:`~torchrl_quad.objectives.pathwise.PathwiseLoss`.
    """

    @dataclass
    class _AcceptedKeys(PathwiseLoss._AcceptedKeys):
        value_target: NestedKey = "value_target"

    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TDLambda
    supported_value_estimators = (ValueEstimators.TD0, ValueEstimators.TDLambda)

    critic_name: str  # the attribute that holds the critic network
    critic_loss_key: str
    prediction_key: str  # the tensor key under which the critic writes its prediction
    value_part = "terminal_value"
    target_bootstrap = False  # whether the terminal value comes from the target network
    samples_actions = False  # whether the value of a state is that of an action that the policy samples there

    def __init__(
        self, actor_network: TensorDictModule, *, loss_function: Literal["l2", "l1", "smooth_l1"] = "l2", **kwargs: Any
    ) -> None:
        super().__init__(actor_network, **kwargs)
        self.loss_function = loss_function

    def _add_critics(
        self, networks: TensorDictModule | list[TensorDictModule], count: int | None, option: str, delay: bool
    ) -> None:
        """Take one critic, make ``count`` of it, or take a list of them."""
        if isinstance(networks, list | tuple):
            if count not in (None, len(networks)):
                raise UserValueError(
                    f"{self.critic_name} lists {len(networks)} networks, and {option} is {count}: write "
                    f"{option}={len(networks)}."
                )
            count = len(networks)
        self.convert_to_functional(networks, self.critic_name, expand_dim=count, create_target_params=delay)

    @takes_rollout
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The losses of actor and critic and their metadata, the ``out_keys``, of a rollout that carries its graph."""
        losses = PathwiseLoss.forward(self, tensordict)
        loss_critic, metadata = self._critic_loss(tensordict)
        return losses.update({self.critic_loss_key: loss_critic, **metadata})

    def objective_parts(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The terms whose sum is J, each (*,): discounted ``rewards`` of the segments, and their ``terminal_value``."""
        return {**super().objective_parts(tensordict), "terminal_value": self._terminal_value(tensordict)}

    def write_value_target(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the TD(lambda) target of each step (paper, equations 17 and 18) into a rollout, and return it.

        Each step's next value comes from the target network. A step that terminated does not bootstrap, one that was
        truncated and the horizon's last one do. The critic's loss reads the targets if they are there, so that several
        critic steps share them, and computes them otherwise. They are (*, horizon, 1), without a graph.
        """
        self._check_rollout(tensordict)
        data = tensordict.detach()
        with torch.no_grad():
            next_value = self._value(group(data, "next"), target=True)
            # A terminated state may not be finite, nor its value.
            next_value = torch.where(self._next(data, "terminated"), 0.0, next_value)
            if self._counts(data) is not None:
                for name in ("reward", "done", "terminated"):
                    data.set(("next", getattr(self.tensor_keys, name)), self._next(data, name))
            if torch.compiler.is_compiling() and not getattr(self._value_estimator, "average_rewards", False):
                numbers = self._gamma, self._of_returns("lmbda")
                target = td_lambda(self._next(data, "reward"), self._next(data, "done"), next_value, *numbers)
            else:
                target = self.value_estimator.value_estimate(data, next_value=next_value)
        return tensordict.set(self.tensor_keys.value_target, target)

    def _critics(self, tensordict: TensorDictBase, *, target: bool = False, learning: bool = False) -> Tensor:
        """The prediction of each critic or of its target, (critics, *, 1); for ``learning`` see ``predict``."""
        params = getattr(self, f"{'target_' if target else ''}{self.critic_name}_params")
        key, shape = getattr(self.tensor_keys, self.prediction_key), (*tensordict.shape, 1)
        found = predict(getattr(self, self.critic_name), params, tensordict, key, learning=learning)
        if found.shape[1:] != shape:
            raise UserValueError(
                f"{self.critic_name} must write one number for each state, {key!r} of shape {shape}; got "
                f"{tuple(found.shape[1:])}."
            )
        return found

    def _value(self, tensordict: TensorDictBase, *, target: bool) -> Tensor:
        """The value (*, 1) of states: the least of the predictions of the critics or of their targets."""
        return self._critics(tensordict, target=target).amin(0)

    def _critic_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        check_tensordict(str(type(self).__name__), tensordict)
        key = self.tensor_keys.value_target
        missing = [name for name in getattr(self, self.critic_name).in_keys if name not in tensordict]
        if missing:
            raise UserValueError(f"{self.critic_name} reads {missing[0]!r}, which these samples lack.")
        samples = tensordict if key in tensordict else self.write_value_target(tensordict.copy())
        target, prediction = leaf(samples, key).detach(), self._critics(tensordict, learning=True)
        if target.shape != prediction.shape[1:]:
            raise UserValueError(
                f"{key!r} has shape {tuple(target.shape)}, and the critic's predictions {tuple(prediction.shape[1:])}: "
                "give targets as write_value_target writes them."
            )
        error = distance_loss(prediction, target.expand_as(prediction), self.loss_function).sum(0).squeeze(-1)
        residual = (target - prediction.detach()).var(correction=0) / target.var(correction=0).clamp_min(1e-12)
        return self._reduce_loss(error, tensordict), {
            "pred_value": prediction.detach().mean(),
            "target_value": target.mean(),
            "explained_variance": 1.0 - residual,
        }

    def _terminal_value(self, tensordict: TensorDictBase) -> Tensor:
        """gamma^n V(s_n) of each segment that did not terminate, summed over the segments: (*)."""
        return self._discounted_value(tensordict, segments(self._next(tensordict, "done"))[1])

    def _discounted_value(self, tensordict: TensorDictBase, after: Tensor) -> Tensor:
        """gamma^(t+1) V(s_(t+1)) after steps (*, horizon, 1), but for those that terminated, summed over steps: (*)."""
        discount = self._gamma * self._discounts(tensordict)
        return (discount * self._value_after(tensordict, after & ~self._next(tensordict, "terminated"))).sum((-2, -1))

    def _value_after(self, tensordict: TensorDictBase, where: Tensor) -> Tensor:
        """V(s_(t+1)) after the steps in ``where``, and zero after the others: (*, horizon, 1), with its graph."""
        states, inputs = group(tensordict, "next"), self._critic_inputs()
        zeros = torch.zeros_like(self._next(tensordict, "reward"))
        if torch.compiler.is_compiling() and not self.samples_actions:
            # All states, since a compiler is slow where a mask gives the shape; earlier ones stand in for the others.
            known, stand_in = (td.select(*inputs, strict=False) for td in (states, tensordict.detach()))
            dense = cast(TensorDictBase, known.where(where.squeeze(-1), stand_in).reshape(-1))
            value = self._value(dense, target=self.target_bootstrap).view(where.shape).to(zeros.dtype)
            return torch.where(where, value, 0.0)
        next_state = picked(states, inputs, where)
        if not torch.compiler.is_compiling() and len(next_state) == 0:  # a recurrent policy refuses an empty batch
            return zeros
        value = self._value(next_state, target=self.target_bootstrap)
        return zeros.masked_scatter(where, value.to(zeros.dtype))

    def _own_gradient(self, tensordict: TensorDictBase, lmbda: float) -> Tensor:
        """The gradient of each action's own lambda-return in that action: (*, horizon, k).

        It weighs n steps and the value after them by (1 - lmbda) lmbda^(n-1), with the rest of the weight at the end of
        the segment. It is not discounted from the start of the horizon.
        """
        reward, done = self._reward(tensordict), self._next(tensordict, "done")
        gamma, weight = self._gamma.to(reward.dtype), torch.where(segments(done)[1], 1.0, 1.0 - lmbda).to(reward.dtype)
        bootstrap = weight * self._value_after(tensordict, ~self._next(tensordict, "terminated"))
        discount = discounts(done, gamma * lmbda)
        if discount.min() < 1e6 * torch.finfo(reward.dtype).tiny:
            raise UserValueError(
                f"gamma * gradient_lmbda = {float(gamma * lmbda):.3g} is too small for a horizon of "
                f"{reward.shape[-2]} steps: {reward.dtype} cannot divide by its power. Fly fewer, or raise the lmbda."
            )
        objective = (discount * (reward + gamma * bootstrap)).sum()
        return action_gradient(objective, leaf(tensordict, self.tensor_keys.action)) / discount

    def _critic_inputs(self) -> set[NestedKey]:
        """The entries of a state that the critic, and the actor before it, read."""
        actor = self.actor_network
        names = set(actor.in_keys) - set(actor.out_keys) | set(getattr(self, self.critic_name).in_keys)
        return names - {self.tensor_keys.action}

    def _check_rollout(self, tensordict: TensorDictBase) -> None:
        critic, key = getattr(self, self.critic_name), getattr(self.tensor_keys, self.prediction_key)
        if key not in critic.out_keys:
            raise UserValueError(
                f"{type(self).__name__} reads {key!r} of its {self.critic_name}, which writes "
                f"{', '.join(map(str, critic.out_keys))}. Give another network, or set_keys({self.prediction_key}=...)."
            )
        super()._check_rollout(tensordict)

    def _network_in_keys(self) -> set[NestedKey]:
        inputs = self._critic_inputs()
        return inputs | {unravel_key(("next", key)) for key in inputs}
