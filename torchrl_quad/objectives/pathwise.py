"""What the first-order losses share: segments of a horizon, the terminal bootstrap, the critic's targets, entropy."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase, composite_lp_aggregate, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import ValueEstimators, dispatch_value_estimator
from torchrl.objectives.value import ValueEstimatorBase


def segments(done: Tensor) -> tuple[Tensor, Tensor]:
    """Where segments start and where they end, bool (*, horizon, 1). The horizon's last step ends one, too."""
    end = done.clone()
    end[..., -1, :] = True
    return end.roll(1, -2), end


def discounts(done: Tensor, gamma: Tensor) -> Tensor:
    """gamma^t, where t counts the steps of each segment from 0: (*, horizon, 1)."""
    start, _ = segments(done)
    index = torch.arange(done.shape[-2], device=done.device).unsqueeze(-1).expand(done.shape)
    return gamma ** (index - torch.where(start, index, 0).cummax(-2).values)


class PathwiseLoss(LossModule):
    """Base of the losses that differentiate the return of a rollout through the environment's own dynamics.

    A rollout is a tensordict of batch size (*, horizon) that still carries its graph. Where an episode ends inside the
    horizon, the horizon falls into segments: each has its own discounted return, starting from discount 1. The
    objective J of a rollout sums over its segments; the loss is -J, averaged over environments.

    Args:
        actor_network: the policy that has made the rollout.
        alpha: coefficient of the entropy bonus alpha * mean over the steps of -log pi(a|s): 0 for none, a positive
            number for a fixed one, "auto" to hold the entropy at ``target_entropy``. Needs the log-probability in the
            rollout (an actor built with ``return_log_prob=True``), since a tanh-Gaussian has no closed entropy.
        target_entropy: with ``alpha="auto"``; "auto" stands for minus the number of action entries.
        alpha_init: with ``alpha="auto"``, the coefficient to start from.
        reduction: "mean" or "sum" over environments (over samples for a critic), or "none".

    Raises:
        TypeError: a network is not a TensorDictModule.
        ValueError: alpha or reduction is none of the allowed values; (in use) the rollout has no time dimension, lacks
            an entry, or is on another device.
        RuntimeError: (in use) the rollout has lost its graph, or lacks the log-probability that the bonus needs.
    """

    @dataclass
    class _AcceptedKeys:
        """The tensordict keys that ``set_keys`` can change; reward, done and terminated are read under "next"."""

        action: NestedKey = "action"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        sample_log_prob: NestedKey | None = None

        def __post_init__(self) -> None:
            if self.sample_log_prob is None:
                aggregated = composite_lp_aggregate(nowarn=True)
                self.sample_log_prob = "sample_log_prob" if aggregated else "action_log_prob"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    # Only its discount is used here: a return over the whole segment is the TD(1) return.
    default_value_estimator = ValueEstimators.TD1
    supported_value_estimators: tuple[ValueEstimators, ...] = (ValueEstimators.TD1,)

    out_keys = ["loss_actor", "n_step_return"]
    value_part: str | None = None  # of the parts of the objective, the one that only a critic knows

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        alpha: float | str = 0.0,
        target_entropy: float | str = "auto",
        alpha_init: float = 1e-2,
        reduction: str = "mean",
    ) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction must be 'mean', 'sum' or 'none', got {reduction!r}.")
        if alpha != "auto" and not (isinstance(alpha, int | float) and alpha >= 0):
            raise ValueError(f"alpha must be 'auto' or a number that is not negative, got {alpha!r}.")
        if alpha_init <= 0:
            raise ValueError(f"alpha_init must be positive, got {alpha_init}; set alpha to 0 for no entropy bonus.")
        self._in_keys = None
        self.reduction = reduction
        self.convert_to_functional(actor_network, "actor_network")
        self.target_entropy = target_entropy
        self.automatic_alpha = alpha == "auto"
        if self.automatic_alpha:
            start = torch.tensor(float(alpha_init), device=self._default_device)
            self.log_alpha = torch.nn.Parameter(start.log())
        else:
            self.register_coeff_buffer("fixed_alpha", float(alpha), device=self._default_device)
        self.has_entropy_bonus = alpha == "auto" or alpha > 0
        entropy_keys = ["entropy", "alpha"] if self.has_entropy_bonus else []
        self.out_keys = [*self.out_keys, *entropy_keys, *(["loss_alpha"] if self.automatic_alpha else [])]

    def convert_to_functional(self, module: TensorDictModule, module_name: str, *args: Any, **kwargs: Any) -> None:
        """As TorchRL's, of a TensorDictModule alone."""
        if not isinstance(module, TensorDictModuleBase):
            raise TypeError(
                f"{module_name} must be a TensorDictModule, got {type(module).__name__}. Wrap a plain module: "
                'TensorDictModule(module, in_keys=["observation"], out_keys=[...]).'
            )
        super().convert_to_functional(module, module_name, *args, **kwargs)

    # -- keys and parameters -------------------------------------------------------------------------------------------

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys of a rollout that :meth:`forward` may be given; more do no harm."""
        if self._in_keys is None:
            keys = self.tensor_keys
            names = {keys.action, *self._network_in_keys()}
            names |= {("next", key) for key in (keys.reward, keys.done, keys.terminated)}
            if self.has_entropy_bonus:
                names.add(keys.sample_log_prob)
            self._in_keys = sorted((unravel_key(name) for name in names), key=str)
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def alpha(self) -> Tensor:
        """The present entropy coefficient, without gradient."""
        return self.log_alpha.detach().exp() if self.automatic_alpha else self.fixed_alpha

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> PathwiseLoss:
        """Choose the return estimator and its parameters, such as ``gamma`` and ``lmbda``.

        The loop form of TD(lambda) is used: the vectorised one is wrong under torch.compile and slower on many
        environments (torchrl 0.14).
        """
        value_type = self.default_value_estimator if value_type is None else value_type
        if isinstance(value_type, ValueEstimatorBase | type):
            return super().make_value_estimator(value_type, **hyperparams)
        if value_type is ValueEstimators.TDLambda:
            hyperparams.setdefault("vectorized", False)
        dispatch_value_estimator(
            self, value_type, supported=self.supported_value_estimators, value_network=None, **hyperparams
        )
        self._forward_value_estimator_keys()
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # The estimator is made when it is first needed, and a checkpoint may hold one already.
        if self._value_estimator is None and any(key.startswith(f"{prefix}_value_estimator.") for key in state_dict):
            self.make_value_estimator()
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        self._in_keys = None
        if self._value_estimator is not None:
            keys = self.tensor_keys
            self._value_estimator.set_keys(reward=keys.reward, done=keys.done, terminated=keys.terminated)

    def _network_in_keys(self) -> set[NestedKey]:
        return set(self.actor_network.in_keys)

    # -- the loss ------------------------------------------------------------------------------------------------------

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All parts of the loss, and what is worth logging, of a rollout that carries its graph."""
        loss, metadata = self.loss_actor(tensordict)
        return TensorDict({"loss_actor": loss, **metadata}, [])

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """-J of the rollout, minus the entropy bonus; and with an automatic alpha, its own loss in the metadata.

        Args:
            tensordict: a rollout (*, horizon) that carries its graph.

        Returns:
            the loss, and a dictionary of what is worth logging.
        """
        objective, metadata = self._objective(tensordict)
        if self.has_entropy_bonus:
            entropy = self._entropy(tensordict)
            objective = objective + self.alpha * entropy
            metadata |= {"entropy": entropy.detach().mean(), "alpha": self.alpha.clone()}
            if self.automatic_alpha:
                gap = entropy.detach() - self._target_entropy(tensordict)
                metadata["loss_alpha"] = self._reduce_loss(self.log_alpha * gap)
        return self._reduce_loss(-objective), metadata

    def objective_parts(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """What J is the sum of: ``rewards``, those of each segment, discounted; the entropy bonus is not in it.

        Args:
            tensordict: a rollout (*, horizon) that carries its graph.

        Returns:
            the parts by name, each (*,), with their graphs.
        """
        self._require_rollout(tensordict)
        reward = tensordict.get(("next", self.tensor_keys.reward))
        self._require_graph(reward, ("next", self.tensor_keys.reward))
        return {"rewards": (self._discounts(tensordict) * reward).sum((-2, -1))}

    def _objective(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """J of each environment, (*), and what is worth logging of it."""
        objective = sum(self.objective_parts(tensordict).values())
        return objective, {"n_step_return": objective.detach().mean()}

    def _discounts(self, tensordict: TensorDictBase) -> Tensor:
        """The discount of each step in its segment: (*, horizon, 1)."""
        gamma = self.value_estimator.gamma.to(tensordict.get(("next", self.tensor_keys.reward)).dtype)
        return discounts(tensordict.get(("next", self.tensor_keys.done)), gamma)

    def _entropy(self, tensordict: TensorDictBase) -> Tensor:
        """Minus the log-probability of the actions taken, averaged over the steps: (*)."""
        log_prob = tensordict.get(self.tensor_keys.sample_log_prob, None)
        if log_prob is None:
            raise RuntimeError(
                f"The entropy bonus of {type(self).__name__} reads {self.tensor_keys.sample_log_prob!r}, which is "
                "not in the rollout. Build the actor with return_log_prob=True, or set the loss's alpha to 0."
            )
        horizon = tensordict.shape[-1]
        return -log_prob.reshape(*tensordict.shape[:-1], horizon).mean(-1)

    def _target_entropy(self, tensordict: TensorDictBase) -> float:
        if self.target_entropy == "auto":
            return -float(tensordict.get(self.tensor_keys.action).shape[-1])
        return float(self.target_entropy)

    def _require_rollout(self, tensordict: TensorDictBase) -> None:
        name, shape = type(self).__name__, tuple(tensordict.batch_size)
        names = tensordict.names
        # Without names nothing tells a single flight from a single step.
        has_time = names[-1] == "time" if "time" in names else len(shape) > 1
        if not has_time or shape[-1] == 0:
            raise ValueError(
                f"{name} needs a rollout of batch size (*, horizon), whose last dimension is time; got {shape}. Give "
                'it what differentiable_rollout returns, unflattened; name a single flight: rollout.names = ["time"].'
            )
        missing = [key for key in self.in_keys if key not in tensordict and key != self.tensor_keys.sample_log_prob]
        if missing:
            raise ValueError(
                f"{name} reads {missing[0]!r}, which is not in the rollout. If it has another name there, tell the "
                f"loss by set_keys, which takes {', '.join(vars(self.tensor_keys))}."
            )
        device, own = tensordict.get(("next", self.tensor_keys.reward)).device, self._default_device
        if own not in (None, device):
            raise ValueError(f"{name} is on {own}, and the rollout on {device}: loss.to({str(device)!r}) moves it.")

    def _require_graph(self, value: Tensor, key: NestedKey) -> None:
        if torch.is_grad_enabled() and not value.requires_grad:
            raise RuntimeError(
                f"{type(self).__name__} differentiates through the rollout, but {key!r} carries no gradient. "
                "Collectors, ParallelEnv, replay buffers, .detach() and torch.no_grad() cut it. Use "
                "differentiable_rollout(env, actor, carry, horizon), or env.rollout(horizon, actor, "
                "break_when_any_done=False) with gradients enabled, on an environment that is differentiable."
            )


class PathwiseCriticLoss(PathwiseLoss):
    """A pathwise loss with a critic: bootstraps at the end of segments, and TD(lambda) targets from a target network.

    A subclass says what its critic predicts, and where its network stands.
    """

    @dataclass
    class _AcceptedKeys(PathwiseLoss._AcceptedKeys):
        """As for every pathwise loss, and the key under which targets are kept."""

        value_target: NestedKey = "value_target"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TDLambda
    supported_value_estimators = (ValueEstimators.TD0, ValueEstimators.TDLambda)

    critic_name: str  # the attribute under which the critic network stands
    critic_loss_key: str
    prediction_key: str  # the name, among the tensor keys, of what the critic writes
    value_part = "terminal_value"
    target_bootstrap = False  # whether the terminal value comes from the target network

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All parts of the loss, and what is worth logging, of a rollout that carries its graph."""
        loss_actor, metadata = self.loss_actor(tensordict)
        loss_critic, critic_metadata = self._critic_loss(tensordict)
        losses = {"loss_actor": loss_actor, self.critic_loss_key: loss_critic}
        return TensorDict({**losses, **metadata, **critic_metadata}, [])

    def objective_parts(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """What J is the sum of: the discounted ``rewards`` of each segment, and its ``terminal_value``, gamma^n V(s_n).

        Args:
            tensordict: a rollout (*, horizon) that carries its graph.

        Returns:
            the parts by name, each (*,), with their graphs.
        """
        return {**super().objective_parts(tensordict), "terminal_value": self._terminal_value(tensordict)}

    def write_value_target(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the TD(lambda) target of each step (paper, equations 17 and 18) into a rollout, and return it.

        Each step's next value comes from the target network; a truncated step bootstraps, a terminated one does not,
        and the horizon's last step bootstraps unless it terminated. The critic's loss uses the entry when it finds it,
        so that several critic steps share one set of targets; it computes it otherwise.
        """
        self._require_rollout(tensordict)
        data = tensordict.detach()
        with torch.no_grad():
            next_value = self._value(data.get("next"), self._critic_params(target=True))
            terminated = data.get(("next", self.tensor_keys.terminated))
            next_value = torch.where(terminated, 0.0, next_value)  # also where the last state was not finite
            target = self.value_estimator.value_estimate(data, next_value=next_value)
        tensordict.set(self.tensor_keys.value_target, target)
        return tensordict

    @abc.abstractmethod
    def _critics(self, tensordict: TensorDictBase, params: TensorDictBase) -> Tensor:
        """What each critic predicts: (critics, *, 1)."""

    def _value(self, tensordict: TensorDictBase, params: TensorDictBase) -> Tensor:
        """The value (*, 1) of a state: the least of the critics' predictions."""
        return self._critics(tensordict, params).amin(0)

    def _critic_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        data = tensordict.detach()
        target = data.get(self.tensor_keys.value_target, None)
        if target is None:
            target = self.write_value_target(data.copy()).get(self.tensor_keys.value_target)
        prediction = self._critics(data, getattr(self, f"{self.critic_name}_params"))
        error = (prediction - target).square().sum(0)
        with torch.no_grad():
            residual = (target - prediction).var(correction=0) / target.var(correction=0).clamp_min(1e-12)
        return self._reduce_loss(error, tensordict), {
            "pred_value": prediction.detach().mean(),
            "target_value": target.mean(),
            "explained_variance": 1.0 - residual,
        }

    def _critic_params(self, *, target: bool) -> TensorDictBase:
        """The critic's parameters, cut off from the graph."""
        prefix = "target_" if target else ""
        return getattr(self, f"{prefix}{self.critic_name}_params").detach()

    def _terminal_value(self, tensordict: TensorDictBase) -> Tensor:
        """gamma^n V(s_n) of each segment that did not terminate, summed over the segments: (*)."""
        _, end = segments(tensordict.get(("next", self.tensor_keys.done)))
        where = end & ~tensordict.get(("next", self.tensor_keys.terminated))
        next_state = tensordict.get("next").select(*self._critic_inputs(), strict=False)[where.squeeze(-1)]
        value = self._value(next_state, self._critic_params(target=self.target_bootstrap))
        discount = self.value_estimator.gamma * self._discounts(tensordict)
        return (discount * torch.zeros_like(discount).masked_scatter(where, value.to(discount.dtype))).sum((-2, -1))

    def _critic_inputs(self) -> set[NestedKey]:
        """What the critic, and the actor before it, read of a state."""
        names = set(self.actor_network.in_keys) | set(getattr(self, self.critic_name).in_keys)
        return names - {self.tensor_keys.action}

    def _require_rollout(self, tensordict: TensorDictBase) -> None:
        critic, key = getattr(self, self.critic_name), getattr(self.tensor_keys, self.prediction_key)
        if key not in critic.out_keys:
            raise ValueError(
                f"{type(self).__name__} reads {key!r} of its {self.critic_name}, which writes "
                f"{', '.join(map(str, critic.out_keys))}. Give another network, or set_keys({self.prediction_key}=...)."
            )
        super()._require_rollout(tensordict)

    def _network_in_keys(self) -> set[NestedKey]:
        inputs = self._critic_inputs()
        return inputs | {unravel_key(("next", key)) for key in inputs}
