"""What losses share: calls of networks, gradients in single actions, and the segments of a horizon."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.autograd.graph import GradientEdge
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad.data.unwrap import check_tensordict, leaf
from torchrl_quad.errors import Unsupported, UserTypeError, UserValueError
from torchrl_quad.objectives.gaussian import GaussianPolicy


@contextlib.contextmanager
def holding(params: TensorDictParams, module: nn.Module) -> Iterator[None]:
    """A module with other parameters, given back also where an exception leaves, or a key stops the program.

    TensorDict's own context keeps them after an exception, and turns a KeyboardInterrupt into an error of its own.
    """
    held = params.to_module(module)
    held.__enter__()
    try:
        yield
    finally:
        held.__exit__(None, None, None)


def sample_action(actor: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase) -> TensorDictBase:
    """The states (*) with what a policy writes in them, sampled, with gradients in its parameters and in the states."""
    tensordict = tensordict.copy()
    with set_exploration_type(ExplorationType.RANDOM), holding(params, actor):
        # A policy with memory or eyes is called.
        plain = actor.plain() if hasattr(actor, "plain") and not hasattr(actor, "replayed") else None
        if plain is None:
            return actor(tensordict)
        inputs = [leaf(tensordict, key) for key in plain.in_keys]
        _check_precision(actor, plain.in_keys, inputs, params)
        drawn = plain.drawn(1, tensordict.numel(), {})[0]
        _, written = plain.forward(plain.weights, [x.reshape(-1, x.shape[-1]) for x in inputs], drawn)
    return tensordict.update({key: x.view(*tensordict.shape, *x.shape[1:]) for key, x in written.items()})


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
            with holding(own, critic):
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


def picked(tensordict: TensorDictBase, keys: Iterable[NestedKey], where: Tensor) -> TensorDict:
    """Some entries of a rollout (*, horizon) where bool (*, horizon, 1) says so: (n)."""
    rows = where.squeeze(-1).nonzero(as_tuple=True)  # once for all entries: to a compiler each mask has a count anew
    found = {key: leaf(tensordict, key)[rows] for key in keys if key in tensordict}
    return TensorDict(cast(Any, found), rows[0].shape, tensordict.device)


def with_fixed(loss: Any, given: Mapping[str, Any], **fixed: Any) -> dict[str, Any]:
    """Options for SHACLoss, with those that a loss sets itself: a UserTypeError if one of these is given, too."""
    for name in sorted(set(given) & set(fixed)):
        raise UserTypeError(f"{type(loss).__name__} sets {name} itself: leave it out, or take SHACLoss.")
    return {**given, **fixed}


def total(parts: Iterable[Tensor]) -> Tensor:
    """The sum of some tensors, at least one."""
    return cast(Tensor, sum(parts))


def segments(done: Tensor) -> tuple[Tensor, Tensor]:
    """The first and the last step of each segment, between ends of episodes and of the horizon: bool, as ``done``."""
    end = done.clone()
    end[..., -1, :] = True
    return end.roll(1, -2), end


def mean_over_steps(x: Tensor, counts: Tensor | None) -> Tensor:
    """The mean of x (*, horizon) over the steps that count, bool (*, horizon, 1), all of them for None: (*)."""
    if counts is None:
        return x.mean(-1)
    counts = counts.squeeze(-1)
    return torch.where(counts, x, 0.0).sum(-1) / counts.sum(-1).clamp(min=1)


def step_in_segment(done: Tensor) -> Tensor:
    """The steps of each segment, counted from 0."""
    start, _ = segments(done)
    index = torch.arange(done.shape[-2], device=done.device).unsqueeze(-1).expand(done.shape)
    return index - torch.where(start, index, 0).cummax(-2).values


def discounts(done: Tensor, gamma: Tensor) -> Tensor:
    """gamma^t, for a scalar gamma, where t counts the steps of each segment from 0."""
    return gamma ** step_in_segment(done)


def td_lambda(reward: Tensor, done: Tensor, next_value: Tensor, gamma: Tensor, lmbda: Tensor) -> Tensor:
    """TD(lambda) targets, each (*, horizon, 1), as one product: a compiler would unroll a loop over time."""
    index, apart = step_in_segment(done), torch.arange(done.shape[-2], device=done.device)
    apart = apart - apart.unsqueeze(-1)
    later = (apart >= 0) & (index.mT - index == apart)  # in the same segment
    gains = reward + gamma * torch.where(segments(done)[1], 1.0, 1.0 - lmbda) * next_value
    return torch.where(later, (gamma * lmbda).to(reward.dtype) ** apart.clamp_min(0), 0.0) @ gains


# -- gradients in single actions, and how a policy learns from them ----------------------------------------------------


def action_gradient(objective: Tensor, action: Tensor, *, create_graph: bool = False) -> Tensor:
    """The gradient of a scalar in each action of a rollout, by all that follows from it, the policy included.

    ``action`` is ``rollout["action"]`` (*, horizon, k) as it was flown, no copy or part, with its graph, which is kept.
    With ``create_graph`` the gradient can be differentiated again, which a compiled flight refuses.
    """
    steps, node = sources_of_steps(action), cast(Any, action.grad_fn)
    if isinstance(steps, Tensor):
        node.learns = False  # the weights of a policy inside the compiled horizon get no gradient here
        try:
            (grad,) = torch.autograd.grad(objective, steps, retain_graph=True, create_graph=create_graph)
        finally:
            node.learns = True
        return grad.movedim(0, -2)
    dim = None if steps is None else node._saved_dim  # of the stack; -2 without its sign
    if steps is None or len(steps) != action.shape[-2] or dim not in (action.ndim - 2, 2**64 - 2):
        raise UserValueError(
            "The gradient of each action needs one rollout as differentiable_rollout returned it, whole and with its "
            "graph; this one was copied, reshaped or cut. Give the rollout itself to the loss."
        )
    grads = torch.autograd.grad(objective, steps, retain_graph=True, create_graph=create_graph, allow_unused=True)
    return torch.stack([torch.zeros_like(action[..., 0, :]) if g is None else g for g in grads], -2)


def sources_of_steps(entry: Tensor) -> Tensor | list[GradientEdge] | None:
    """What the rewards of a rollout depend on instead of one of its entries, if that was stacked afterwards."""
    node: Any = entry.grad_fn
    if hasattr(node, "actions"):  # of a compiled horizon, a node of its own: (horizon, num_envs, k)
        return node.actions
    if node is None or node.name() != "StackBackward0":
        return None
    return [GradientEdge(step, index) for step, index in node.next_functions if step is not None]


def act_again(actor: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
    """What a policy writes in a rollout's states, with the rollout's noise.

    The gradients reach the policy's parameters alone, neither earlier states nor the noise. A memory is built up again
    from that at the start. Actions within 1e-6 of a bound count as if they were that far from it.
    """
    with holding(params, actor):
        return plain_of(actor, tensordict).replay(tensordict)


def plain_of(actor: TensorDictModule, tensordict: TensorDictBase) -> Any:
    """A policy whose noise follows from the actions of a rollout: a ``PlainTanhGaussian``, or a GaussianPolicy."""
    make = getattr(actor, "replayed", None) or getattr(actor, "plain", lambda: None)
    plain = make()
    if hasattr(plain, "drawn_again"):
        return plain
    if "noise_before" in actor.out_keys:
        raise Unsupported(
            "Gradients of single actions need a policy with noise_correlation as make_actor builds it, without hooks "
            "or changed parts, and RANDOM or DETERMINISTIC exploration. Build it so, or without noise_correlation."
        )
    return GaussianPolicy(actor, tensordict)


def median_length(length: Tensor) -> Tensor:
    """The median of the lengths that are not zero: a scalar, NaN if all are."""
    return torch.where(length > 0, length, torch.nan).nanmedian()


class MedianClip(nn.Module):
    """Shortens gradients (*, k) that are longer than ``factor`` times the running median of their lengths.

    One that is not finite becomes zero, and counts as shortened. ``decay`` is that of the running median in each call.
    """

    def __init__(self, factor: float, decay: float = 0.9) -> None:
        super().__init__()
        self.factor, self.decay = factor, decay
        self.register_buffer("median", torch.zeros(()))
        self.median: Tensor

    @torch.no_grad()
    def forward(self, grad: Tensor) -> tuple[Tensor, Tensor]:
        """The gradients, and the fraction that was shortened of those that are not zero."""
        length = grad.norm(dim=-1, keepdim=True)
        finite, counts = length.isfinite(), length != 0
        median = median_length(torch.where(finite, length, 0.0))
        running = torch.where(self.median > 0, torch.lerp(median, self.median.to(median), self.decay), median)
        self.median = torch.where(median.isnan(), self.median.to(median), running)
        factor = torch.where(finite, self.factor * self.median / length.clamp_min(1e-30), 0.0).clamp_max(1.0)
        clipped = (counts & (factor < 1)).sum() / counts.sum().clamp_min(1)
        return torch.where(finite, grad, 0.0) * factor, clipped
