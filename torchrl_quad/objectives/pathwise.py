"""What all first-order losses share: the rewards of a horizon's segments, the entropy bonus, and the critic, if any."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Self, cast

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase, composite_lp_aggregate
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import ValueEstimators, default_value_kwargs, dispatch_value_estimator

from torchrl_quad.data.unwrap import check_tensordict, leaf
from torchrl_quad.errors import Unsupported, UserTypeError, UserValueError, WrongState, shown
from torchrl_quad.objectives.calls import (
    MedianClip,
    act_again,
    action_gradient,
    discounts,
    mean_over_steps,
    median_length,
    takes_rollout,
    total,
)
from torchrl_quad.objectives.gaussian import sampler_of
from torchrl_quad.options import Coefficient, Entry, Fraction, Positive, Scale, between, check_value, checked


@checked
class PathwiseLoss(LossModule):
    """Base of the losses that differentiate the return of a rollout through the environment's own dynamics.

    An episode that ends inside the horizon splits a rollout (*, horizon) into segments, whose discounts start at 1. The
    objective J sums over the segments, and the loss is -J, averaged over environments.
    ``make_value_estimator(gamma=...)`` sets the discount, 0.99 by default.

    Args:
        actor_network: the policy that flew the rollout.
        alpha: the coefficient of the entropy bonus: a number, 0 for none, or auto to hold the entropy at its target.
            The bonus is alpha * mean over the steps of -log pi(a|s), from an actor with ``return_log_prob=True``. With
            a fixed noise the entropy may never reach its target, and "auto" keeps growing.
        target_entropy: where alpha=auto holds the entropy: a number, or auto for minus the number of action entries.
        alpha_init: what alpha=auto starts from.
        clip_action_gradient: the longest gradient in one action, in running medians of their lengths; None for no
            bound. 1 to 5 keep tumbling drones from outweighing all others. Needs a policy whose action is TorchRL's
            TanhNormal or IndependentNormal, without dropout. An entropy bonus then counts at fixed states.
        reduction: mean or sum over environments (over samples for a critic), or none; None is mean, as in TorchRL.

    Steps that a collector's ``("collector", "mask")``, bool (*, horizon), marks as False do not count: such a step has
    no reward, ends its segment, and is no target of a critic.

    Raises:
        ValueError: (in use) the rollout has no time dimension, lacks an entry, or is on another device.
        RuntimeError: (in use) the rollout has lost its graph, or lacks the log-probability that the bonus needs.
    """

    @dataclass
    class _AcceptedKeys:  # pyrefly: ignore[bad-override]  # as in every loss of TorchRL
        """The tensordict keys that ``set_keys`` can change; reward, done and terminated are read under "next"."""

        action: NestedKey = "action"
        action_target: NestedKey = "action_target"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        sample_log_prob: NestedKey = field(
            default_factory=lambda: "sample_log_prob" if composite_lp_aggregate(nowarn=True) else "action_log_prob"
        )

    tensor_keys: Any  # each loss has its own
    default_keys = _AcceptedKeys
    # Only its discount is used here: a return over the whole segment is the TD(1) return.
    default_value_estimator = ValueEstimators.TD1
    supported_value_estimators: tuple[ValueEstimators, ...] = (ValueEstimators.TD1,)

    out_keys = ["loss_actor", "n_step_return"]  # pyrefly: ignore[bad-override-mutable-attribute]  # as in TorchRL
    value_part: str | None = None  # the part of the objective that comes from a critic
    has_entropy_bonus = False
    _schedulable_buffers = frozenset({"fixed_alpha"})
    # What is measured of the gradients in single actions; if anything is, the policy learns from these.
    measured_of_actions: list[str] = []

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            checked(cls)
        if "out_keys" not in vars(cls):  # tensordict would take its parent's for those of its objects
            cls.out_keys = list(cls.out_keys if isinstance(cls.out_keys, list) else cls._out_keys)

    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        alpha: Coefficient | Literal["auto"] = 0.0,
        target_entropy: Annotated[float, between(-1e6, 1e6)] | Literal["auto"] = "auto",
        alpha_init: Scale = 1e-2,
        clip_action_gradient: Positive | None = None,
        reduction: Literal["mean", "sum", "none"] | None = "mean",
    ) -> None:
        super().__init__()
        self.reduction = reduction or "mean"
        self.convert_to_functional(actor_network, "actor_network")
        number = {"device": self._default_device, "dtype": self._precision}
        self.clip = None if clip_action_gradient is None else MedianClip(clip_action_gradient).to(**number)
        self.target_entropy = target_entropy
        self.automatic_alpha = alpha == "auto"
        if self.automatic_alpha:
            self.log_alpha = torch.nn.Parameter(torch.tensor(float(alpha_init), **number).log())
        else:
            self.register_coeff_buffer("fixed_alpha", float(alpha), **number)
        self.measured_of_actions = self.measured_of_actions + ["clipped"] * (self.clip is not None)
        self.out_keys = [*self.out_keys, *self.measured_of_actions]
        if alpha == "auto" or alpha > 0:
            self._add_entropy_bonus()

    def convert_to_functional(self, module: Any, module_name: str, *args: Any, **kwargs: Any) -> None:
        """As TorchRL's, for a TensorDictModule, or for a list of networks that differ in their weights alone."""
        networks: list[Any] = list(module) if isinstance(module, list | tuple) else [module]
        for network in networks:
            if not isinstance(network, TensorDictModuleBase):
                raise UserTypeError(
                    f"{module_name} must be a TensorDictModule, got {type(network).__name__}. Wrap a plain module: "
                    'TensorDictModule(module, in_keys=["observation"], out_keys=[...]).'
                )
        if len({re.sub(" at 0x[0-9a-f]+", "", str((x, x.in_keys))) for x in networks}) != 1:
            raise UserValueError(f"{module_name} must list networks that differ in their weights alone, at least one.")
        super().convert_to_functional(module, module_name, *args, **kwargs)

    def _make_vmap(self) -> None:
        """Nothing: critics are called one after the other, and each draws random numbers of its own."""

    def __repr__(self) -> str:
        names = [name for name in ("actor_network", "value_network", "qvalue_network") if hasattr(self, name)]
        networks = ", ".join(f"{name}={type(getattr(self, name)).__name__}" for name in names)
        return f"{type(self).__name__}({networks}, reduction={self.reduction!r})"

    @property
    def in_keys(self) -> list[NestedKey]:  # pyrefly: ignore[bad-override]  # without its setter
        """The keys of a rollout that :meth:`forward` reads; others do no harm."""
        keys = self.tensor_keys
        names = {keys.action, *self._network_in_keys()}
        names |= {("next", key) for key in (keys.reward, keys.done, keys.terminated)}
        if self.has_entropy_bonus:
            names.add(keys.sample_log_prob)
        if self.measured_of_actions:
            names |= self._drawn_keys
        return sorted((unravel_key(name) for name in names), key=str)

    @property
    def _drawn_keys(self) -> set[NestedKey]:
        """The entries of a rollout that say what the policy drew."""
        actor = self.actor_network
        sampler = sampler_of(actor)
        parameters = ["loc", "scale"] if sampler is None else sampler.dist_params_keys
        return {*parameters, *(set(actor.out_keys) & {"noise", "noise_before"})}

    @property
    def alpha(self) -> Tensor:
        """The present entropy coefficient, without gradient; a number may be assigned, as in a schedule."""
        return self.log_alpha.detach().exp() if self.automatic_alpha else cast(Tensor, self.fixed_alpha)

    @alpha.setter
    def alpha(self, value: float) -> None:
        if self.automatic_alpha:
            self.log_alpha.data.fill_(math.log(check_value("alpha", value, Scale)))
        else:
            self.fixed_alpha = check_value("alpha", value, Coefficient)

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "fixed_alpha":
            if self.automatic_alpha:
                raise UserValueError("fixed_alpha is not in use with alpha=auto: write loss.alpha = ... instead.")
            value = value if isinstance(value, Tensor) else check_value("alpha", value, Coefficient)
            if value > 0 and not self.has_entropy_bonus:
                self._add_entropy_bonus()
        super().__setattr__(name, value)

    def _add_entropy_bonus(self) -> None:
        self.has_entropy_bonus = True
        self.out_keys = [*self.out_keys, "entropy", "alpha", *["loss_alpha"] * self.automatic_alpha]

    @property
    def _precision(self) -> torch.dtype:
        """The floating-point type of the actor, and so of the rollouts that it flies."""
        types = (x.dtype for x in self.actor_network_params.values(True, True) if x.is_floating_point())
        return next(types, torch.get_default_dtype())

    @checked
    def make_value_estimator(
        self, value_type: Any = None, *, gamma: Fraction | None = None, lmbda: Fraction | None = None, **more: Any
    ) -> Self:
        """Choose the return estimator and its parameters.

        TD(lambda) runs in its loop form: the vectorised one is wrong under torch.compile, and slower on many
        environments (torchrl 0.14).

        Args:
            value_type: one of ``supported_value_estimators``; by default that of the loss.
            gamma: the discount of future rewards per control step; 0.99 is usual.
            lmbda: the lambda of the TD(lambda) targets, which no other estimator takes; 0.95 is usual.
            **more: as for TorchRL's estimator.
        """
        value_type = self.default_value_estimator if value_type is None else value_type
        supported = {x.name.lower(): x for x in self.supported_value_estimators}
        chosen = supported.get(value_type.lower()) if isinstance(value_type, str) else value_type
        if not isinstance(chosen, ValueEstimators) or chosen not in self.supported_value_estimators:
            raise Unsupported(
                f"{shown(value_type)} is not implemented for loss {type(self).__name__}. Choose from: "
                f"{', '.join(supported)}."
            )
        given: dict[str, Any] = {name: x for name, x in (("gamma", gamma), ("lmbda", lmbda)) if x is not None}
        more = {"vectorized": False, **more} if chosen is ValueEstimators.TDLambda else more
        try:
            estimator = dispatch_value_estimator(self, chosen, supported=[chosen], value_network=None, **given, **more)
        except TypeError as error:
            raise UserTypeError(f"{type(self).__name__} estimates its returns by {chosen.name}: {error}.") from None
        given = {**default_value_kwargs(self.value_type), **given}
        for name in {"gamma", "lmbda"} & given.keys():  # TorchRL makes them float32 whatever the rollout is
            device = getattr(estimator, name).device
            setattr(estimator, name, torch.as_tensor(given[name], device=device, dtype=self._precision))
        self._forward_value_estimator_keys()
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        # The estimator is made when it is first needed, and a checkpoint may hold one already.
        kept = f"{prefix}_value_estimator."
        if self._value_estimator is None and f"{kept}gamma" in state_dict:
            has_default = f"{kept}lmbda" in state_dict or self.default_value_estimator is ValueEstimators.TD1
            self.make_value_estimator(None if has_default else ValueEstimators.TD0)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def set_keys(self, **keys: NestedKey | None) -> None:
        """Read entries of a rollout under other names; None means the name that TorchRL uses."""
        known = vars(self.tensor_keys)
        for name in keys:
            if name not in known:
                raise UserValueError(f"{type(self).__name__} reads no {name!r}. Choose from: {', '.join(known)}.")
        super().set_keys(**{name: check_value(name, key, Entry | None) for name, key in keys.items()})

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        if self._value_estimator is not None:
            keys = self.tensor_keys
            self._value_estimator.set_keys(reward=keys.reward, done=keys.done, terminated=keys.terminated)

    def _network_in_keys(self) -> set[NestedKey]:
        return set(self.actor_network.in_keys)

    @takes_rollout
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss and its metadata, the ``out_keys``, of a rollout that carries its graph."""
        compute = self._loss_of_actions if self.measured_of_actions else self.loss_actor
        loss, metadata = compute(tensordict)
        return TensorDict({"loss_actor": loss, **metadata}, [])

    @torch.compiler.disable(reason="gradients of single actions are read off the graph of the flight")
    def _loss_of_actions(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        return self.loss_actor(tensordict)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss of a rollout (*, horizon) with its graph, -J minus the entropy bonus, and its metadata."""
        objective, metadata = self._objective(tensordict)
        if self.measured_of_actions and not torch.is_grad_enabled():
            metadata |= dict.fromkeys(self.measured_of_actions, torch.full_like(self.alpha, math.nan))
        elif self.measured_of_actions:
            grad, measured = self._measure(self._action_gradient(tensordict, objective))
            written = act_again(self.actor_network, self.actor_network_params, tensordict)
            learned = (grad * written[self.tensor_keys.action]).sum((-2, -1)) + self._beside_actions(tensordict)
            # The value is J's; the gradient that of ``learned``.
            objective = objective.detach() + learned - learned.detach()
            tensordict, metadata = tensordict.copy().update(written), metadata | measured
        if self.has_entropy_bonus:
            entropy = self._surprise(tensordict).mean((-2, -1))
            objective = objective + self._entropy_bonus(tensordict)
            metadata |= {"entropy": entropy.detach().mean(), "alpha": self.alpha.clone()}
            if self.automatic_alpha:
                gap = entropy.detach() - self._target_entropy(tensordict)
                metadata["loss_alpha"] = self._reduce_loss(self.log_alpha * gap)
        return self._reduce_loss(-objective), metadata

    def better_actions(self, tensordict: TensorDictBase, step: float = 0.1) -> tuple[Tensor, dict[str, Tensor]]:
        """Actions (*, horizon, k) that raise J, to fit the policy to (Mora et al. 2021), and the metadata.

        Each action of the rollout, which carries its graph, moves along the gradient that the loss climbs in it; the
        median of these changes has the length ``step``, in units of the action. :meth:`loss_fit` is the distance from
        them. What J has beside the flown actions, as ABPT has, does not count, and an entropy bonus is refused.
        """
        if self.has_entropy_bonus:
            raise Unsupported(f"better_actions of {type(self).__name__} leaves out its entropy bonus: set alpha to 0.")
        step = check_value("step", step, Positive)
        objective, metadata = self._objective(tensordict)
        grad, measured = self._measure(self._action_gradient(tensordict, objective))
        change = grad * (step / median_length(grad.norm(dim=-1)))
        action = leaf(tensordict, self.tensor_keys.action).detach()
        return action + change.nan_to_num(0.0, 0.0, 0.0), metadata | measured

    def loss_fit(self, tensordict: TensorDictBase) -> Tensor:
        """Half the squared distance of the policy's actions from ``action_target`` in a rollout (*, horizon), whose
        other entries may be detached, and which several steps of an optimiser may share; a mean over those that count.
        """
        if (key := self.tensor_keys.action_target) not in tensordict:
            raise UserValueError(
                f"loss_fit reads {key!r}, which is not in the rollout. Write it there while the rollout carries its "
                f"graph: rollout.set({key!r}, loss.better_actions(rollout)[0])."
            )
        target, counts = leaf(tensordict, key), self._counts(tensordict)
        action = act_again(self.actor_network, self.actor_network_params, tensordict)[self.tensor_keys.action]
        if counts is not None:  # a step that does not may hold anything
            target = torch.where(counts, target, action.detach())
        distance = 0.5 * (action - target).square().sum(-1)
        return self._reduce_loss(mean_over_steps(distance, counts))

    def objective_parts(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The terms whose sum is J, without the entropy bonus, each (*,) with its graph: the discounted ``rewards``."""
        self._check_rollout(tensordict)
        return {"rewards": (self._discounts(tensordict) * self._reward(tensordict)).sum((-2, -1))}

    def _objective(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        objective = total(self.objective_parts(tensordict).values())
        return objective, {"n_step_return": objective.detach().mean()}

    def _action_gradient(self, tensordict: TensorDictBase, objective: Tensor) -> Tensor:
        """The gradient to climb in each action that was flown, (*, horizon, k): that of J."""
        return action_gradient(objective.sum(), leaf(tensordict, self.tensor_keys.action))

    def _beside_actions(self, tensordict: TensorDictBase) -> Tensor | float:
        """What of J depends on the policy at fixed states, apart from the actions that were flown: (*)."""
        return 0.0

    def _next(self, tensordict: TensorDictBase, name: str) -> Tensor:
        """Reward, done or terminated of each step: (*, horizon, 1)."""
        x, counts = leaf(tensordict, ("next", getattr(self.tensor_keys, name))), self._counts(tensordict)
        if counts is None:
            return x
        return torch.where(counts, x, 0.0) if name == "reward" else x | ~counts

    def _counts(self, tensordict: TensorDictBase) -> Tensor | None:
        """Which steps count, bool (*, horizon, 1), if a collector says so; see TorchRL's ``loss_mask_key``."""
        masks = (tensordict.get(key, None) for key in self._loss_mask_keys())
        given = [mask.reshape(*tensordict.shape, 1) for mask in masks if mask is not None]
        return torch.stack(given).all(0) if given else None

    def _reward(self, tensordict: TensorDictBase) -> Tensor:
        reward = self._next(tensordict, "reward")
        self._check_graph(reward, ("next", self.tensor_keys.reward))
        return reward

    @property
    def _gamma(self) -> Tensor:
        return self._of_returns("gamma")

    def _of_returns(self, name: str) -> Tensor:
        """gamma or lmbda of the value estimator. A compiler cannot make that one, and takes its defaults."""
        if self._value_estimator is None and torch.compiler.is_compiling():
            number = default_value_kwargs(self.default_value_estimator).get(name, 0.0)
        else:
            number = getattr(self.value_estimator, name, 0.0)
        return torch.as_tensor(number, dtype=self._precision)

    def _discounts(self, tensordict: TensorDictBase) -> Tensor:
        return discounts(self._next(tensordict, "done"), self._gamma.to(self._next(tensordict, "reward").dtype))

    def _measure(self, grad: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """From the gradients in the actions (*, horizon, k) those to learn from, and what is measured of them."""
        if self.clip is None:
            return grad, {}
        grad, clipped = self.clip(grad)
        return grad, {"clipped": clipped}

    def _entropy_bonus(self, tensordict: TensorDictBase) -> Tensor:
        return self.alpha * self._surprise(tensordict).mean((-2, -1))

    def _surprise(self, tensordict: TensorDictBase) -> Tensor:
        """Minus the log-probability of each action taken, a sample of the policy's entropy: (*, horizon, 1)."""
        log_prob = tensordict.get(self.tensor_keys.sample_log_prob, None)
        if log_prob is None:
            raise WrongState(
                f"The entropy bonus of {type(self).__name__} reads {self.tensor_keys.sample_log_prob!r}, which is "
                "not in the rollout. Build the actor with return_log_prob=True, or set the loss's alpha to 0. If it "
                "has another name there, write loss.set_keys(sample_log_prob=...)."
            )
        log_prob, counts = log_prob.reshape(*tensordict.shape, 1), self._counts(tensordict)
        return -log_prob if counts is None else torch.where(counts, -log_prob, 0.0)

    def _target_entropy(self, tensordict: TensorDictBase) -> float:
        if self.target_entropy == "auto":
            return -float(leaf(tensordict, self.tensor_keys.action).shape[-1])
        return float(self.target_entropy)

    def _check_rollout(self, tensordict: TensorDictBase) -> None:
        name = str(type(self).__name__)
        check_tensordict(name, tensordict)
        shape, names = tuple(tensordict.batch_size), tensordict.names
        # Only the names of its dimensions distinguish a single flight from a batch of single steps.
        has_time = names[-1] == "time" if "time" in names else len(shape) > 1
        if not has_time or shape[-1] == 0:
            raise UserValueError(
                f"{name} needs a rollout of batch size (*, horizon), whose last dimension is time; got {shape}. Give "
                'it what differentiable_rollout returns, unflattened; name a single flight: rollout.names = ["time"].'
            )
        missing = [key for key in self.in_keys if key not in tensordict and key != self.tensor_keys.sample_log_prob]
        if missing and missing[0] in self._drawn_keys:
            raise UserValueError(
                f"{name} needs a policy that writes what its distribution is made of, and the rollout has no "
                f"{missing[0]!r}. Build it by make_actor, or keep that entry among the policy's out_keys."
            )
        if missing:
            raise UserValueError(
                f"{name} reads {missing[0]!r}, which is not in the rollout. If it has another name there, write "
                f"loss.set_keys(...), which takes {', '.join(vars(self.tensor_keys))}."
            )
        for what in ("reward", "done", "terminated"):
            key, got = ("next", getattr(self.tensor_keys, what)), tuple(self._next(tensordict, what).shape)
            if got != (*shape, 1):
                raise UserValueError(f"{name} needs {key!r} of shape {(*shape, 1)} in this rollout; got {got}.")
        device, own = self._next(tensordict, "reward").device, self._default_device
        if own not in (None, device):
            raise UserValueError(f"{name} is on {own}, and the rollout on {device}: loss.to({str(device)!r}) moves it.")

    def _check_graph(self, value: Tensor, key: NestedKey) -> None:
        if torch.is_grad_enabled() and not value.requires_grad:
            raise WrongState(
                f"{type(self).__name__} differentiates through the rollout, but {key!r} carries no gradient. "
                "Collectors, ParallelEnv, replay buffers, .detach() and torch.no_grad() cut it. Use "
                "differentiable_rollout(env, actor, carry, horizon), or env.rollout(horizon, actor, "
                "break_when_any_done=False) with gradients enabled, on an environment that is differentiable. "
                "The horizon must be longer than the delay between an action and its effect."
            )
