"""What losses share: calls of networks, on plain tensors if these allow it, checks, and the segments of a horizon."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad.data.unwrap import check_tensordict, leaf
from torchrl_quad.errors import UserTypeError, UserValueError


def sample_action(actor: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase) -> TensorDictBase:
    """The states (*) with what a policy writes in them, sampled, with gradients in its parameters and in the states."""
    tensordict = tensordict.copy()
    with set_exploration_type(ExplorationType.RANDOM), params.to_module(actor):
        plain = actor.plain() if hasattr(actor, "plain") else None
        if plain is None:
            return actor(tensordict)
        _check_precision(actor, plain.in_keys, [leaf(tensordict, key) for key in plain.in_keys], params)
        written = act(plain, tensordict, plain.drawn(1, tensordict.numel(), {})[0])
    return tensordict.update(written)


def predict(
    critic: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase, key: NestedKey, *, learning: bool
) -> Tensor:
    """What critics predict under ``key`` that share a module and have parameters of their own: (critics, *, k).

    The parameters are those of one critic, or of several, stacked. ``learning`` keeps the gradient in them, and cuts
    that in the inputs (*); otherwise it is the other way round.
    """
    plain = critic.plain() if hasattr(critic, "plain") else None
    if plain is None:
        inputs = tensordict.select(*critic.in_keys)
        inputs, params = (inputs.detach(), params) if learning else (inputs, params.detach())
        predictions = []
        for own in params.unbind(0) if params.batch_dims else [params]:
            with own.to_module(critic):
                predictions.append(critic(inputs.copy()).get(key))
        return torch.stack(predictions)
    tensors = [leaf(tensordict, name) for name in critic.in_keys]
    _check_precision(critic, critic.in_keys, tensors, params)
    tensors = [x.detach() for x in tensors] if learning else tensors
    names = [".".join(cast(tuple[str, ...], name)) for name in params.keys(True, True)]
    weights = [x if learning else x.detach() for x in params.values(True, True)]
    copies = zip(*(x.unbind(0) for x in weights), strict=True) if params.batch_dims else [weights]
    return torch.stack([plain(dict(zip(names, own, strict=True)), tensors) for own in copies])


def _check_precision(
    network: TensorDictModule, keys: Sequence[NestedKey], inputs: Sequence[Tensor], params: TensorDictParams
) -> None:
    """Raise a UserValueError if a network reads another precision or device than its own."""
    own = next(x for x in params.values(True, True) if x.is_floating_point())
    for key, x in zip(keys, inputs, strict=True):
        if x.device != own.device or (x.dtype != own.dtype and x.is_floating_point()):
            raise UserValueError(
                f"{type(network).__name__} computes in {own.dtype} on {own.device}, and {key!r} is {x.dtype} on "
                f"{x.device}. Build both with the same dtype and device, or convert the rollout."
            )


def takes_rollout(forward: Callable[..., Any]) -> Callable[..., Any]:
    """As tensordict's ``dispatch``, for a method of a rollout or of its entries; a UserTypeError for anything else."""
    dispatched = dispatch(forward)

    @functools.wraps(dispatched)
    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        for x in (*args, *kwargs.values()):
            if not isinstance(x, TensorDictBase | Tensor):
                check_tensordict(type(self).__name__, x)
        return dispatched(self, *args, **kwargs)

    return method


def with_fixed(loss: Any, given: Mapping[str, Any], **fixed: Any) -> dict[str, Any]:
    """Options for SHACLoss, with those that a loss sets itself: a UserTypeError if one of these is given, too."""
    for name in sorted(set(given) & set(fixed)):
        raise UserTypeError(f"{type(loss).__name__} sets {name} itself: leave it out, or take SHACLoss.")
    return {**given, **fixed}


def total(parts: Iterable[Tensor]) -> Tensor:
    """The sum of some tensors, at least one."""
    return cast(Tensor, sum(parts))


def act(plain: Any, tensordict: TensorDictBase, drawn: Tensor) -> dict[NestedKey, Tensor]:
    """What a plain policy writes in states (*), from what was drawn for each of them, (n, k)."""
    inputs = [x.reshape(-1, x.shape[-1]) for x in (leaf(tensordict, key) for key in plain.in_keys)]
    _, written = plain.forward(plain.weights, inputs, drawn)
    return {key: x.view(*tensordict.shape, *x.shape[1:]) for key, x in written.items()}


def segments(done: Tensor) -> tuple[Tensor, Tensor]:
    """The first and the last step of each segment, between ends of episodes and of the horizon: bool, as ``done``."""
    end = done.clone()
    end[..., -1, :] = True
    return end.roll(1, -2), end


def step_in_segment(done: Tensor) -> Tensor:
    """The steps of each segment, counted from 0."""
    start, _ = segments(done)
    index = torch.arange(done.shape[-2], device=done.device).unsqueeze(-1).expand(done.shape)
    return index - torch.where(start, index, 0).cummax(-2).values


def discounts(done: Tensor, gamma: Tensor) -> Tensor:
    """gamma^t, for a scalar gamma, where t counts the steps of each segment from 0."""
    return gamma ** step_in_segment(done)
