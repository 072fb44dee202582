"""TorchRL's clipped PPO, with losses and gradients as functions of tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.func import grad_and_value
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss, distance_loss

from torchrl_quad.data.unwrap import group, leaf
from torchrl_quad.objectives.calls import segments


class PlainClipPPOLoss(ClipPPOLoss):
    """ClipPPOLoss that computes each network's loss and gradient in one function of tensors.

    Values and gradients are ClipPPOLoss's. Only ``loss_critic`` and ``loss_actor``, the sum of ``loss_objective`` and
    ``loss_entropy``, have a gradient. An actor with a memory or eyes goes through ClipPPOLoss itself.

    Args:
        actor_network, critic_network: as ``make_actor`` and ``make_value`` build them.
        compile: whether both functions are compiled, for each size of minibatch; see :meth:`warm_up`.
        options: those of ClipPPOLoss that the recipe takes.
    """

    critic_coeff: Tensor  # pyrefly: ignore[bad-override-mutable-attribute]
    entropy_coeff: Tensor  # pyrefly: ignore[bad-override-mutable-attribute]
    max_importance_ratio: Tensor | None  # pyrefly: ignore[bad-override-mutable-attribute]

    def __init__(
        self, actor_network: ProbabilisticActor, critic_network: ValueOperator, *, compile: bool = False, **options: Any
    ) -> None:
        super().__init__(actor_network, critic_network, **options)
        plain: Any = None if hasattr(actor_network, "replayed") else getattr(actor_network, "plain", lambda: None)()
        predict, names = cast("Any", critic_network).plain(), [name for name, _ in critic_network.named_parameters()]

        def actor(weights: list[Tensor], inputs: list[Tensor], drawn: list[Tensor], *flown: Tensor) -> Any:
            loc, scale = plain.head(plain.layers(weights, inputs)[-1], *drawn[1:])
            found = self._surrogate(plain.log_prob(loc, scale, flown[0]), *flown[1:])
            if self.entropy_bonus:  # of a single action, since the tanh-Gaussian has no closed form
                entropy = -plain.squash(loc, scale, drawn[0], "log_prob")["log_prob"].mean()
                found |= {"entropy": entropy, "loss_entropy": -self.entropy_coeff * entropy}
            return found["loss_objective"] + found.get("loss_entropy", 0.0), found

        def values(weights: Sequence[Tensor], inputs: list[Tensor]) -> Tensor:
            return predict(dict(zip(names, weights, strict=True)), inputs)

        def critic(weights: list[Tensor], inputs: list[Tensor], target: Tensor) -> Any:
            value = values(weights, inputs)
            left, whole = (torch.var(x, correction=0, dim=0) for x in (target - value, target))
            loss = distance_loss(target, value, loss_function=self.loss_critic_type).mean()
            return self.critic_coeff * loss, 1.0 - left / (whole + torch.finfo(target.dtype).eps)

        self._plain, self._values, self._critic_weights = plain, values, list(critic_network.parameters())
        both = [grad_and_value(cast("Any", x), has_aux=True) for x in (actor, critic)]
        self._actor, self._critic = (
            [torch.compile(x, fullgraph=True, dynamic=False) for x in both] if compile and plain else both
        )

    @torch.no_grad()
    def write_values(self, rollout: TensorDictBase) -> TensorDictBase:
        """Write the critic's values of a rollout (*, horizon) and of its next states, for GAE, each state once."""
        end, keys = segments(leaf(rollout, ("next", "done")))[1], self.critic_network.in_keys
        value = self._values(self._critic_weights, [leaf(rollout, key) for key in keys])
        last = [leaf(group(rollout, "next"), key)[end.squeeze(-1)] for key in keys]
        following = value.roll(-1, -2).masked_scatter(end, self._values(self._critic_weights, last))
        return rollout.set(self.tensor_keys.value, value).set(("next", self.tensor_keys.value), following)

    def warm_up(self, rollout: TensorDictBase, samples: int) -> None:
        """Compile for minibatches of so many samples, like those of a rollout (*, horizon)."""
        if self._plain is not None:
            data, keys = cast("TensorDict", self.write_values(rollout.copy()).reshape(-1)), self.tensor_keys
            for key in (keys.advantage, keys.value_target):
                data.set(key, leaf(data, keys.value))
            self(data[torch.zeros(samples, dtype=torch.long, device=data.device)])

    # pyrefly: ignore[bad-override-mutable-attribute]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """ClipPPOLoss's entries and ``loss_actor``, of samples (*) with ``advantage`` and ``value_target``."""
        plain, keys = self._plain, self.tensor_keys
        if plain is None:
            losses = cast("Any", super().forward)(tensordict)
            return losses.set("loss_actor", losses["loss_objective"] + losses.get("loss_entropy", 0.0))
        inputs = [leaf(tensordict, key) for key in plain.in_keys]
        flown = [leaf(tensordict, key) for key in ("action", cast("str", keys.sample_log_prob), keys.advantage)]
        drawn = [torch.empty_like(flown[0]).normal_()] if self.entropy_bonus else flown[:1]
        drawn += [leaf(tensordict, "noise_before")] if plain.rho else []
        loss, found = _differentiated(self._actor, plain.weights, inputs, drawn, *flown)
        loss_critic, _, explained = self.loss_critic(tensordict)
        return TensorDict({**found, "loss_actor": loss, "loss_critic": loss_critic, "explained_variance": explained})

    def loss_critic(self, tensordict: TensorDictBase) -> tuple[Any, ...]:
        """The critic's mean loss of samples, nothing, and the share of the variance that it explains."""
        inputs = [leaf(tensordict, key) for key in self.critic_network.in_keys]
        target = leaf(tensordict, self.tensor_keys.value_target)
        loss, explained = _differentiated(self._critic, self._critic_weights, inputs, target)
        return loss, None, explained

    def _surrogate(self, log_prob: Tensor, before: Tensor, advantage: Tensor) -> dict[str, Tensor]:
        """The clipped objective, and what TorchRL measures of the ratios of probabilities."""
        log_ratio, advantage = log_prob - before, advantage.squeeze(-1)
        if self.normalize_advantage:
            advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
        # An action beyond the largest ratio keeps a gradient, which is scaled to that ratio.
        ratio, excess = log_ratio.detach(), torch.zeros_like(advantage)
        if self.max_importance_ratio is not None:
            excess = (self.max_importance_ratio.log() - ratio).clamp_max(0.0)
        clipped, capped = log_ratio.clamp(*self._clip_bounds), ratio + excess
        gain = torch.minimum((log_ratio + excess).exp() * advantage, (clipped + excess).exp() * advantage)
        return {
            "loss_objective": -gain.mean(),
            "clip_fraction": (clipped != log_ratio).to(ratio.dtype).mean(),
            "kl_approx": -ratio.mean(),
            "ESS": (2 * capped.logsumexp(0) - (2 * capped).logsumexp(0)).exp() / len(capped),
            "max_ratio": capped.exp().max(),
            "mean_ratio": capped.exp().mean(),
        }


class _Known(torch.autograd.Function):
    """A loss whose gradients in the weights are known already."""

    @staticmethod
    def forward(ctx: Any, loss: Tensor, grads: Sequence[Tensor], *weights: Tensor) -> Tensor:
        ctx.grads = grads
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:  # pyrefly: ignore[bad-override]
        return None, None, *(grad * x for x in ctx.grads)


def _differentiated(function: Any, weights: Sequence[Tensor], *inputs: Any) -> tuple[Tensor, Any]:
    """A function's loss, which backward can follow to the weights, and what else it returns."""
    with torch.no_grad():
        grads, (loss, more) = function(list(weights), *inputs)
    return cast("Tensor", _Known.apply(loss, grads, *weights)), more
