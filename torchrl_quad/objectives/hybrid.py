"""The hybrid loss: the pathwise gradient where it explains what actions do, and the score function for the rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Normal, kl_divergence
from torch.distributions.transforms import TanhTransform
from torchrl.objectives.utils import ValueEstimators

from torchrl_quad.errors import UserValueError, WrongState
from torchrl_quad.objectives.action_gradients import action_gradient, distribution_again, location_gradient
from torchrl_quad.objectives.calls import require_function, require_tensordict, takes_rollout
from torchrl_quad.objectives.segments import discounts, segments
from torchrl_quad.objectives.shac import SHACLoss
from torchrl_quad.options import Below1, Coefficient, Field, Positive, Share


class HybridLoss(SHACLoss):
    r"""PPO with the derivative of the simulator as a control variate: each gradient where it is good.

    The simulator's derivative gives p_t, the gradient of an action's own lambda-return in the mean of that action.
    The flight itself gives A_t, the advantage of the same action. If p_t is right, then A_t is p_t . (u_t - loc_t) plus
    what does not depend on this action, where u_t is the action before the tanh. The loss therefore regresses A on
    p . (u - loc). The slope is the ``pathwise_weight`` b: near 1 where the critic's advantage and the derivative agree.
    Both read the same critic, so b does not show where that critic is wrong. It is a running mean over rollouts,
    clamped to [0, 1]. The pathwise term of the loss is

        - b mean_t p_t . loc(s_t)

    and the clipped surrogate of PPO takes the rest of the advantage, A'_t = A_t - b p_t . (u_t - loc_t). What the
    pathwise term adds in expectation is what the surrogate loses, whatever b is, as long as p_t does not depend on the
    noise of its own step. This is the control variate of Q-Prop (Gu et al. 2017), with the derivative of a simulated
    flight in place of a critic's.

    With ``entropy_coeff`` the surrogate gets that multiple of the policy's entropy in each state, as PPO has it.

    The lambda-return of p_t bootstraps with V at every step, and each p_t is not discounted from the start of the
    horizon. With noise that is correlated in time, an action's noise goes on in later actions, and
    p_t + c p_(t+1) + c^2 p_(t+2) + ... takes the place of p_t, as it does in A_t: c = rho gamma lambda,
    with the lambda of the advantage.

    One rollout serves several epochs of minibatches: :meth:`write_targets` reads the graph once.

    .. code-block:: python

        rollout, carry = differentiable_rollout(env, actor, carry, 32)
        data = loss.write_targets(rollout)
        for batch in minibatches(data):
            losses = loss(batch)
            (losses["loss_actor"] + losses["loss_value"]).backward()

    Args:
        actor_network: the policy that flew the rollout, as ``make_actor`` builds it.
        value_network: the critic V(s).
        gradient_lmbda: the lambda of the return that the pathwise gradient differentiates; 0.9 is usual. That of the
            advantage and of the critic's targets is ``make_value_estimator(lmbda=...)``.
        clip_epsilon: how far the ratio of probabilities may move from 1; 0.2 is usual.
        entropy_coeff: the weight of the entropy bonus, next to advantages of standard deviation 1; 0 for none.
        clip_action_gradient: the longest gradient in one action, in running medians of their lengths; null for no
            bound.
        decay: the share of the running weight that a rollout leaves as it is.
        average: of a scalar over the processes that train together, if there are several.
        reduction: mean, sum or none, over samples.

    Raises:
        ValueError: an option has the wrong type or is out of its range; (in use) as for every pathwise loss.
        NotImplementedError: (in use) the policy is another one than ``make_actor`` builds.
    """

    @dataclass
    class _AcceptedKeys(SHACLoss._AcceptedKeys):
        """As for SHAC, and the keys under which :meth:`HybridLoss.write_targets` writes.

        ``advantage`` is A' and ``location_gradient`` b p, both divided by the standard deviation of A; ``latent`` is
        the action before the tanh.
        """

        advantage: NestedKey = "advantage"
        location_gradient: NestedKey = "location_gradient"
        latent: NestedKey = "latent"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = [
        *("loss_actor", "loss_value", "pathwise_weight", "kl"),
        *("pred_value", "target_value", "explained_variance"),
    ]

    supported_value_estimators = (ValueEstimators.TDLambda,)
    pathwise_weight: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        gradient_lmbda: Share = 0.9,
        clip_epsilon: Annotated[float, Field(gt=0, lt=1)] = 0.2,
        entropy_coeff: Coefficient = 0.0,
        clip_action_gradient: Positive | None = 2.0,
        decay: Below1 = 0.9,
        average: Callable[[Tensor], Tensor] | None = None,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        require_function("average", average)
        options = {"clip_action_gradient": clip_action_gradient, "reduction": reduction}
        super().__init__(actor_network, value_network, delay_value=False, **options)
        self.gradient_lmbda, self.clip_epsilon, self.entropy_coeff = gradient_lmbda, clip_epsilon, entropy_coeff
        self.decay, self.average = decay, average
        self.out_keys = [name for name in self.out_keys if name != "clipped"]  # minibatches clip no gradient
        self.out_keys += ["entropy"] * (entropy_coeff > 0)
        weight = torch.full((), math.nan, device=self._default_device, dtype=self._precision)
        self.register_buffer("pathwise_weight", weight)

    def _network_in_keys(self) -> set[NestedKey]:
        noise = set(self.actor_network.out_keys) & {"noise", "noise_before"}
        return {*super()._network_in_keys(), "loc", "scale", *noise}

    @takes_rollout
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The losses and their metadata, the ``out_keys``.

        Args:
            tensordict: samples (*) of what :meth:`write_targets` returned, or a rollout (*, horizon) with its graph.
        """
        return super().forward(self._with_targets(tensordict))

    def write_targets(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Differentiate a rollout (*, horizon), update the weight, and write what the minibatches read.

        Returns:
            the rollout without its graph, and with ``advantage``, ``location_gradient``, ``latent`` and
            ``value_target``, each under its tensor key.
        """
        self._require_rollout(tensordict)
        if not torch.is_grad_enabled():
            raise WrongState("write_targets differentiates the rollout: call it with gradients enabled.")
        keys = self.tensor_keys
        grad = self._own_gradient(tensordict)
        data = self.write_value_target(tensordict.detach())
        done, discount = data.get(("next", keys.done)), self.value_estimator.gamma * self.value_estimator.lmbda
        grad, latent = location_gradient(self.actor_network, self.actor_network_params, data, grad, done, discount)
        with torch.no_grad():
            advantage = data.get(keys.value_target) - self._value(data, target=False)
            deviation = advantage.std().clamp_min(1e-12)
            advantage, grad = (advantage - advantage.mean()) / deviation, grad / deviation
            predicted = (grad * (latent - data.get("loc"))).sum(-1, keepdim=True)
            weight = self._regress(advantage, predicted)
        data.set(keys.advantage, advantage - weight * (predicted - predicted.mean()))
        data.set(keys.location_gradient, weight * grad)
        data.set(keys.latent, latent)
        return data

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss, and its metadata: the weight, KL(policy that flew || policy), and the entropy if it counts.

        Args:
            tensordict: as for :meth:`forward`.
        """
        keys, tensordict = self.tensor_keys, self._with_targets(tensordict)
        new, old = self._distributions(tensordict)
        advantage = tensordict.get(keys.advantage)
        ratio = self._ratio(new, old, tensordict)
        clipped = ratio.clamp(1.0 - self.clip_epsilon, 1.0 + self.clip_epsilon)
        score = torch.minimum(ratio * advantage, clipped * advantage).squeeze(-1)
        pathwise = (tensordict.get(keys.location_gradient) * (new.loc - old.loc)).sum(-1)
        kl = kl_divergence(old, new).sum(-1).mean().detach()
        objective, metadata = score + pathwise, {"pathwise_weight": self.pathwise_weight.clamp(0.0, 1.0), "kl": kl}
        if self.entropy_coeff:
            entropy = self._policy_entropy(new)
            objective = objective + self.entropy_coeff * entropy
            metadata["entropy"] = entropy.detach().mean()
        return self._reduce_loss(-objective), metadata

    def _with_targets(self, tensordict: TensorDictBase) -> TensorDictBase:
        require_tensordict(type(self).__name__, tensordict)
        keys = self.tensor_keys
        lost = [key for key in (keys.advantage, keys.location_gradient, keys.latent) if key not in tensordict]
        if lost and not {keys.location_gradient, keys.latent} <= set(lost):  # an advantage alone is somebody else's
            raise UserValueError(
                f"HybridLoss reads {lost[0]!r}, which write_targets writes and these samples have lost. Give samples "
                "of all that it returned."
            )
        return self.write_targets(tensordict) if lost else tensordict

    def _own_gradient(self, tensordict: TensorDictBase) -> Tensor:
        """The gradient of each action's own lambda-return in that action: (*, horizon, k)."""
        keys, estimator = self.tensor_keys, self.value_estimator
        done, terminated = (tensordict.get(("next", key)) for key in (keys.done, keys.terminated))
        reward = tensordict.get(("next", keys.reward))
        self._require_graph(reward, ("next", keys.reward))
        gamma = estimator.gamma.to(reward.dtype)
        self._require_precision(gamma.item() * self.gradient_lmbda, reward)
        goes_on = tensordict.get("next").select(*self._critic_inputs())[~terminated.squeeze(-1)]
        value = self._value(goes_on, target=False).to(reward.dtype)
        _, end = segments(done)
        bootstrap = torch.where(end, 1.0, 1.0 - self.gradient_lmbda).to(reward.dtype)
        bootstrap = bootstrap * torch.zeros_like(reward).masked_scatter(~terminated, value)
        discount = discounts(done, gamma * self.gradient_lmbda)
        objective = (discount * (reward + gamma * bootstrap)).sum()
        grad = action_gradient(objective, tensordict.get(keys.action)) / discount
        return grad if self.clip is None else self.clip(grad)[0]

    def _require_precision(self, discount: float, reward: Tensor) -> None:
        """Refuse a horizon at whose end the discount is too small to divide by."""
        least = 1e6 * torch.finfo(reward.dtype).tiny
        longest = 1 + int(math.log(least) / math.log(discount)) if 0 < discount < 1 else 1
        if discount < 1 and reward.shape[-2] > longest:
            raise UserValueError(
                f"gamma * gradient_lmbda = {discount:.3g} is too small for a horizon of {reward.shape[-2]} steps: "
                f"{reward.dtype} cannot divide by its power. Fly at most {longest} steps, or raise gradient_lmbda."
            )

    def _regress(self, advantage: Tensor, predicted: Tensor) -> Tensor:
        """Update the weight with the slope of the advantages over what was predicted, each (*, horizon, 1).

        Both are centred in each step of the horizon, and over the steps of a single flight: before the critic knows
        anything, an advantage says first of all how many steps are left.
        """
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

    def _distributions(self, tensordict: TensorDictBase) -> tuple[Normal, Normal]:
        """The normal distribution of the policy as it is, and as it flew."""
        new = distribution_again(self.actor_network, self.actor_network_params, tensordict)
        old = tensordict.get("loc"), tensordict.get("scale")
        return Normal(*new), Normal(*old)

    def _policy_entropy(self, policy: Normal) -> Tensor:
        """The entropy of tanh(u), estimated by one u of a policy in each state: (*)."""
        latent = policy.rsample()
        return (policy.entropy() + TanhTransform().log_abs_det_jacobian(latent, None)).sum(-1)

    def _ratio(self, new: Normal, old: Normal, tensordict: TensorDictBase) -> Tensor:
        """The ratio of the probabilities of the action that was flown: (*, 1)."""
        latent = tensordict.get(self.tensor_keys.latent)
        return (new.log_prob(latent) - old.log_prob(latent)).sum(-1, keepdim=True).exp()
