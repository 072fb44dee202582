"""The hybrid loss: the pathwise gradient where it explains what actions do, and the score function for the rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Normal
from torch.distributions.transforms import TanhTransform
from torchrl.objectives.utils import ValueEstimators

from torchrl_quad.data.unwrap import check_tensordict, leaf
from torchrl_quad.errors import Unsupported, UserValueError, WrongState
from torchrl_quad.objectives.calls import holding, plain_of, takes_rollout
from torchrl_quad.objectives.shac import SHACLoss
from torchrl_quad.options import Below1, Coefficient, Field, Positive, Share


class HybridLoss(SHACLoss):
    r"""PPO with the derivative of the simulator as a control variate, as Q-Prop (Gu et al. 2017) has a critic's.

    p_t is the gradient of an action's own lambda-return in the mean of that action, by the simulator, and A_t the
    advantage of the same action. If p_t is right, A_t is p_t . (u_t - loc_t) plus what does not depend on this action,
    where u_t is the action before the tanh. The slope of A over p . (u - loc), a running mean over rollouts in [0, 1],
    is the ``pathwise_weight`` b. It does not show errors of the critic, which both read. The pathwise term of the loss
    is -b mean_t p_t . loc(s_t), and the clipped surrogate of PPO takes the rest of the advantage,
    A'_t = A_t - b p_t . (u_t - loc_t). In expectation the two add up to the same for every b, as long as p_t does not
    depend on the noise of its own step. p_t bootstraps with V at every step, and is not discounted from the start of
    the horizon. With noise that is correlated in time p_t + c p_(t+1) + c^2 p_(t+2) + ... replaces p_t, with
    c = rho gamma lambda of the advantage.

    One rollout serves several epochs of minibatches: :meth:`write_targets` reads the graph once.

    .. code-block:: python

        from torchrl_quad import HoveringEnv, HybridLoss, differentiable_rollout, make_actor, make_value

        env = HoveringEnv(num_envs=8)
        actor = make_actor(env)
        loss = HybridLoss(actor, make_value(env))
        rollout, carry = differentiable_rollout(env, actor, None, 16)
        for batch in loss.write_targets(rollout).reshape(-1).split(32):  # several times, shuffled
            losses = loss(batch)
            (losses["loss_actor"] + losses["loss_value"]).backward()

    Args:
        actor_network: the policy that flew the rollout, whose action is a TanhNormal or an IndependentNormal.
        value_network: the critic V(s).
        gradient_lmbda: the lambda of the return that the pathwise gradient differentiates; 0.9 is usual. That of the
            advantage and of the critic's targets is ``make_value_estimator(lmbda=...)``.
        clip_epsilon: how far the ratio of probabilities may move from 1; 0.2 is usual.
        entropy_coeff: the weight of the entropy bonus, next to advantages of standard deviation 1; 0 for none.
        clip_action_gradient: the longest gradient in one action, in running medians of their lengths; None for none.
        reduction: mean, sum or none, over samples; None is mean, as in TorchRL.
        loss_function: the distance of the critic from its targets: l2, its square; l1; or smooth_l1.
        decay: the share of the running weight that a rollout leaves as it is.
        average: of a scalar over the processes that train together, if there are several.
    """

    @dataclass
    class _AcceptedKeys(SHACLoss._AcceptedKeys):
        """``advantage`` is A' and ``location_gradient`` b p, both divided by the deviation of A; ``latent`` is u."""

        advantage: NestedKey = "advantage"
        location_gradient: NestedKey = "location_gradient"
        latent: NestedKey = "latent"

    default_keys = _AcceptedKeys
    out_keys = ["loss_actor", "loss_value", "pathwise_weight", "kl", "pred_value", "target_value", "explained_variance"]
    supported_value_estimators = (ValueEstimators.TDLambda,)
    pathwise_weight: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule | list[TensorDictModule],
        *,
        gradient_lmbda: Share = 0.9,
        clip_epsilon: Annotated[float, Field(gt=0, lt=1)] = 0.2,
        entropy_coeff: Coefficient = 0.0,
        clip_action_gradient: Positive | None = 2.0,
        decay: Below1 = 0.9,
        average: Callable[[Tensor], Tensor] | None = None,
        reduction: Literal["mean", "sum", "none"] | None = "mean",
        loss_function: Literal["l2", "l1", "smooth_l1"] = "l2",
    ) -> None:
        own = {"clip_action_gradient": clip_action_gradient, "reduction": reduction, "loss_function": loss_function}
        super().__init__(actor_network, value_network, delay_value=False, **own)
        self.gradient_lmbda, self.clip_epsilon, self.entropy_coeff = gradient_lmbda, clip_epsilon, entropy_coeff
        self.decay, self.average = decay, average
        self.measured_of_actions = []  # minibatches clip no gradient
        self.out_keys = [name for name in self.out_keys if name != "clipped"]
        self.out_keys += ["entropy"] * (entropy_coeff > 0)
        weight = torch.full((), math.nan, device=self._default_device, dtype=self._precision)
        self.register_buffer("pathwise_weight", weight)

    def _add_entropy_bonus(self) -> None:
        raise Unsupported(f"{type(self).__name__} has an entropy bonus of its own: set entropy_coeff, and leave alpha.")

    def _network_in_keys(self) -> set[NestedKey]:
        return super()._network_in_keys() | self._drawn_keys

    @takes_rollout
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The losses and their metadata, the ``out_keys``, of samples (*) with targets or of a rollout (*, horizon)."""
        return super().forward(self._with_targets(tensordict))

    @torch.compiler.disable(reason="gradients of single actions are read off the graph of the flight")
    def write_targets(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Differentiate a rollout (*, horizon), update the weight, and return what the minibatches read.

        This is the rollout without its graph, with ``advantage``, ``location_gradient``, ``latent`` and
        ``value_target`` under their tensor keys.
        """
        self._check_rollout(tensordict)
        if not torch.is_grad_enabled():
            raise WrongState("write_targets differentiates the rollout: call it with gradients enabled.")
        keys, grad = self.tensor_keys, self._own_gradient(tensordict, self.gradient_lmbda)
        grad = grad if self.clip is None else self.clip(grad)[0]
        data = self.write_value_target(tensordict.detach())
        grad, latent, loc = self._in_location(data, grad)
        with torch.no_grad():
            advantage = leaf(data, keys.value_target) - self._value(data, target=False)
            counts = self._counts(data)
            seen = advantage if counts is None else advantage[counts]
            deviation = seen.std().clamp_min(1e-12)
            advantage, grad = (advantage - seen.mean()) / deviation, grad / deviation
            if counts is not None:
                advantage, grad = torch.where(counts, advantage, 0.0), torch.where(counts, grad, 0.0)
            predicted = (grad * (latent - loc)).sum(-1, keepdim=True)
            weight = self._regress(advantage, predicted)
        data.set(keys.advantage, advantage - weight * (predicted - predicted.mean()))
        return data.set(keys.location_gradient, weight * grad).set(keys.latent, latent)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss of what :meth:`forward` takes, and the weight, KL(policy that flew || policy), entropy."""
        keys, tensordict = self.tensor_keys, self._with_targets(tensordict)
        with holding(self.actor_network_params, self.actor_network):
            plain = plain_of(self.actor_network, tensordict)
            new, old = Normal(*plain.distribution(tensordict)), Normal(*plain.recorded(tensordict))
        advantage, latent = leaf(tensordict, keys.advantage), leaf(tensordict, keys.latent)
        ratio = (new.log_prob(latent) - old.log_prob(latent)).sum(-1, keepdim=True).exp()
        clipped = ratio.clamp(1.0 - self.clip_epsilon, 1.0 + self.clip_epsilon)
        score = torch.minimum(ratio * advantage, clipped * advantage).squeeze(-1)
        pathwise = (leaf(tensordict, keys.location_gradient) * (new.loc - old.loc)).sum(-1)
        # Written out, since a compiler cannot trace torch's dispatch.
        ratio, shift = (old.scale / new.scale).square(), ((old.loc - new.loc) / new.scale).square()
        kl = (0.5 * (ratio + shift - 1 - ratio.log())).sum(-1).mean().detach()
        objective, metadata = score + pathwise, {"pathwise_weight": self.pathwise_weight.clamp(0.0, 1.0), "kl": kl}
        if self.entropy_coeff:
            entropy = new.entropy()
            if plain.squashes:  # that of tanh(u) has no closed form: estimated by one u in each state
                entropy = entropy + TanhTransform().log_abs_det_jacobian(new.rsample(), None)
            entropy = entropy.sum(-1)
            objective = objective + self.entropy_coeff * entropy
            metadata["entropy"] = entropy.detach().mean()
        return self._reduce_loss(-objective, tensordict), metadata

    def _with_targets(self, tensordict: TensorDictBase) -> TensorDictBase:
        check_tensordict("HybridLoss", tensordict)
        keys = self.tensor_keys
        lost = [key for key in (keys.advantage, keys.location_gradient, keys.latent) if key not in tensordict]
        # An advantage without the other two comes from another estimator.
        if lost and not {keys.location_gradient, keys.latent} <= set(lost):
            raise UserValueError(
                f"HybridLoss reads {lost[0]!r}, which write_targets writes and these samples have lost. Give samples "
                "of all that it returned."
            )
        return self.write_targets(tensordict) if lost else tensordict

    def _in_location(self, data: TensorDictBase, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """From the gradient in the actions (*, k) that in their means before the tanh; u, and these means."""
        with holding(self.actor_network_params, self.actor_network):
            plain = plain_of(self.actor_network, data)
            xi = plain.drawn_again(data)[:, : plain.size].view_as(grad)
            loc, scale = (x.detach() for x in plain.recorded(data))
            loc.requires_grad_()
            with torch.enable_grad():
                (grad,) = torch.autograd.grad((plain.squash(loc, scale, xi)["action"] * grad).sum(), loc)
        if plain.rho:
            # Noise lasts into later actions of the episode: the gradient is that in its new part, divided by the scale.
            decay = plain.rho * (self._gamma * cast(Tensor, self.value_estimator.lmbda))
            in_noise, steps, done = torch.zeros_like(grad[..., 0, :]), [], self._next(data, "done")
            for g, s, end in zip(*(x.unbind(-2)[::-1] for x in (grad, scale, done)), strict=True):
                in_noise = g * s + decay * torch.where(end, 0.0, in_noise)
                steps.append(in_noise / s)
            grad = torch.stack(steps[::-1], -2)
        return grad, (loc + scale * xi).detach(), loc.detach()

    def _regress(self, advantage: Tensor, predicted: Tensor) -> Tensor:
        """Update the weight with the slope of the advantages over what was predicted, each (*, horizon, 1)."""
        # Centred in each step of the horizon, since an advantage depends on the steps that are left as long as the
        # critic knows little; those of a single flight over its steps.
        batch = tuple(i for i, size in enumerate(advantage.shape[:-2]) if size > 1) or (-2,)
        advantage, predicted = (x - x.mean(batch, keepdim=True) for x in (advantage, predicted))
        covariance, variance = (predicted * advantage).mean(), predicted.square().mean()
        if self.average is not None:
            covariance, variance = self.average(covariance), self.average(variance)
        slope = (covariance / variance.clamp_min(1e-12)).clamp(-1.0, 2.0)
        running = self.pathwise_weight
        slope = torch.where(slope.isfinite(), slope, running)
        running.copy_(torch.where(running.isnan(), slope, torch.lerp(slope, running, self.decay)))
        return running.nan_to_num(0.0).clamp(0.0, 1.0)
