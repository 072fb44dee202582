"""Calls of networks inside the losses: on plain tensors where a network allows it, and on tensordicts elsewhere."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, stack
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad.errors import UserTypeError


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
    weights = {".".join(name): x for name, x in params.items(True, True)}
    if learning:
        inputs = [x.detach() for x in inputs]
    else:
        weights = {name: x.detach() for name, x in weights.items()}
    copies = zip(*(x.unbind(0) for x in weights.values()), strict=True) if params.batch_dims else [weights.values()]
    return stack([plain(dict(zip(weights, own, strict=True)), inputs) for own in copies])


def require_function(name: str, value: Any) -> None:
    """Refuse what is neither None nor can be called."""
    if not (value is None or callable(value)):
        raise UserTypeError(f"{name} must be a function, or None; got {type(value).__name__}.")


def act(plain: Any, tensordict: TensorDictBase, drawn: Tensor) -> dict[NestedKey, Tensor]:
    """What a plain policy writes in states (*), from what was drawn for each of them, (n, k)."""
    inputs = [tensordict[key].reshape(-1, tensordict[key].shape[-1]) for key in plain.in_keys]
    _, written = plain.forward(plain.weights, inputs, drawn)
    return {key: x.view(*tensordict.shape, *x.shape[1:]) for key, x in written.items()}
