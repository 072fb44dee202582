"""Calls of networks inside the losses: on plain tensors where a network allows it, and on tensordicts elsewhere."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, stack
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad.errors import UserTypeError, UserValueError


def sample_action(actor: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase) -> TensorDictBase:
    """Let a policy act anew, with gradients in its parameters and its inputs.

    Args:
        actor: the policy; its method ``plain()``, where it has one, gives it as pure functions of tensors.
        params: its parameters.
        tensordict: the states (*) to act in; it is not modified.

    Returns:
        the states with what the policy writes.
    """
    tensordict = tensordict.copy()
    with set_exploration_type(ExplorationType.RANDOM), params.to_module(actor):
        plain = actor.plain() if hasattr(actor, "plain") else None
        if plain is None:
            return actor(tensordict)
        _require_precision(actor, plain.in_keys, [tensordict[key] for key in plain.in_keys], params)
        written = act(plain, tensordict, plain.drawn(1, tensordict.numel(), {})[0])
    return tensordict.update(written)


def predict(
    critic: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase, key: NestedKey, *, learning: bool
) -> Tensor:
    """What critics predict that share a module and have parameters of their own.

    Args:
        critic: the module; its method ``plain()``, where it has one, gives it as a function of tensors.
        params: the parameters of one critic, or of several, stacked: (critics).
        tensordict: what they read, (*); it is not modified.
        key: under which they write.
        learning: keep the gradient in the parameters and cut that in the inputs; otherwise the other way round.

    Returns:
        their predictions, (critics, *, k).
    """
    plain = critic.plain() if hasattr(critic, "plain") else None
    if plain is None:
        inputs = tensordict.select(*critic.in_keys)
        inputs, params = (inputs.detach(), params) if learning else (inputs, params.detach())
        predictions = []
        for own in params.unbind(0) if params.batch_dims else [params]:
            with own.to_module(critic):
                predictions.append(critic(inputs.copy()).get(key))
        return stack(predictions)
    inputs = [tensordict[name] for name in critic.in_keys]
    _require_precision(critic, critic.in_keys, inputs, params)
    weights = {".".join(name): x for name, x in params.items(True, True)}
    if learning:
        inputs = [x.detach() for x in inputs]
    else:
        weights = {name: x.detach() for name, x in weights.items()}
    copies = zip(*(x.unbind(0) for x in weights.values()), strict=True) if params.batch_dims else [weights.values()]
    return stack([plain(dict(zip(weights, own, strict=True)), inputs) for own in copies])


def _require_precision(
    network: TensorDictModule, keys: Sequence[NestedKey], inputs: Sequence[Tensor], params: TensorDictParams
) -> None:
    """Refuse what a network reads in another precision or on another device than its own."""
    own = next(x for x in params.values(True, True) if x.is_floating_point())
    for key, x in zip(keys, inputs, strict=True):
        if x.device != own.device or (x.dtype != own.dtype and x.is_floating_point()):
            raise UserValueError(
                f"{type(network).__name__} computes in {own.dtype} on {own.device}, and {key!r} is {x.dtype} on "
                f"{x.device}. Build both with the same dtype and device, or convert the rollout."
            )


def takes_rollout(forward: Callable[..., Any]) -> Callable[..., Any]:
    """As tensordict's ``dispatch``, for a method of a rollout or of its entries, and refuse anything else."""
    dispatched = dispatch(forward)

    @functools.wraps(dispatched)
    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        for x in (*args, *kwargs.values()):
            if not isinstance(x, TensorDictBase | Tensor):
                require_tensordict(type(self).__name__, x)
        return dispatched(self, *args, **kwargs)

    return method


def require_tensordict(name: str, rollout: Any) -> None:
    """Refuse what is no tensordict.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(rollout, TensorDictBase):
        raise UserTypeError(
            f"{name} needs a rollout, the tensordict that differentiable_rollout returns; got {type(rollout).__name__}."
        )


def refuse_fixed(loss: Any, given: Sequence[str], fixed: Sequence[str]) -> None:
    """Refuse options of its base that a loss sets itself.

    Raises:
        TypeError: one of them is given.
    """
    for name in sorted(set(given) & set(fixed)):
        raise UserTypeError(f"{type(loss).__name__} sets {name} itself: leave it out, or take SHACLoss.")


def require_function(name: str, value: Any) -> None:
    """Refuse what is neither None nor can be called."""
    if not (value is None or callable(value)):
        raise UserTypeError(f"{name} must be a function, or None; got {type(value).__name__}.")


def act(plain: Any, tensordict: TensorDictBase, drawn: Tensor) -> dict[NestedKey, Tensor]:
    """What a plain policy writes in states (*), from what was drawn for each of them, (n, k)."""
    inputs = [tensordict[key].reshape(-1, tensordict[key].shape[-1]) for key in plain.in_keys]
    _, written = plain.forward(plain.weights, inputs, drawn)
    return {key: x.view(*tensordict.shape, *x.shape[1:]) for key, x in written.items()}
