"""Gradients in the actions of a rollout, step by step, and how a policy learns from them."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.autograd.graph import GradientEdge

from torchrl_quad.errors import Unsupported, UserValueError
from torchrl_quad.objectives.calls import act


def action_gradient(objective: Tensor, action: Tensor) -> Tensor:
    """The gradient of an objective in each action of a rollout, with all that follows from it, the policy included.

    Args:
        objective: a scalar.
        action: ``rollout["action"]`` (*, horizon, k) as it was flown, with its graph, which is kept.

    Raises:
        ValueError: the action is a copy or a part of the rollout's, whose steps cannot be told apart.
    """
    node, steps = action.grad_fn, sources_of_steps(action)
    if isinstance(steps, Tensor):
        node.learns = False
        try:
            (grad,) = torch.autograd.grad(objective, steps, retain_graph=True)
        finally:
            node.learns = True
        return grad.movedim(0, -2)
    if steps is None or len(steps) != action.shape[-2] or not _is_along_time(action):
        raise UserValueError(
            "The gradient of each action needs one rollout as differentiable_rollout returned it, whole and with its "
            "graph; this one was copied, reshaped or cut. Give the rollout itself to the loss."
        )
    grads = torch.autograd.grad(objective, steps, retain_graph=True, allow_unused=True)
    return torch.stack([torch.zeros_like(action[..., 0, :]) if g is None else g for g in grads], -2)


def sources_of_steps(entry: Tensor) -> Tensor | list[GradientEdge] | None:
    """What the rewards of a rollout depend on in place of one of its entries, which was stacked afterwards.

    A compiled horizon holds the actions of all steps in one tensor (horizon, num_envs, k). Otherwise each step has its
    own place in the graph, but for those without one, such as the first observation. None: the entry is no stack.
    """
    node = entry.grad_fn
    if hasattr(node, "actions"):  # a compiled horizon, a node of its own
        return node.actions
    if node is None or node.name() != "StackBackward0":
        return None
    return [GradientEdge(step, index) for step, index in node.next_functions if step is not None]


def act_again(actor: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
    """What a policy of ``make_actor`` or ``make_visual_actor`` writes in a rollout's states, with the rollout's noise.

    A memory comes about anew in these states, from that at the start of the rollout. The values are those of the
    rollout as long as the policy has not changed. The gradients reach the policy's parameters alone: neither do earlier
    states move with them, nor does the noise.

    Args:
        actor: the policy that flew the rollout.
        params: its parameters.
        tensordict: the rollout (*), with all that the policy wrote. The noise of an action follows from it, but for
            actions within 1e-6 of a bound: they count as if they were that far from it.

    Raises:
        NotImplementedError: the policy is another one than these build, whose noise is not known.
    """
    with params.to_module(actor):
        plain = _plain(actor)
        if hasattr(plain, "replay"):
            return plain.replay(tensordict)
        return act(plain, tensordict.select(*plain.in_keys).detach(), plain.drawn_again(tensordict))


def distribution_again(
    actor: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase
) -> tuple[Tensor, Tensor]:
    """The mean and standard deviation of the normal distribution, before the tanh, in a rollout's states: (*, k).

    The arguments, the gradients and the errors are those of :func:`act_again`.
    """
    with params.to_module(actor):
        return _plain(actor).distribution(tensordict)


def location_gradient(
    actor: TensorDictModule,
    params: TensorDictParams,
    tensordict: TensorDictBase,
    grad: Tensor,
    done: Tensor,
    discount: Tensor,
) -> tuple[Tensor, Tensor]:
    """The gradient in the mean of each action's normal distribution, before the tanh, from that in the action.

    The noise of an action goes on in later ones if it is correlated in time. The gradient then takes these in, up to
    the end of the episode: it is that in what is new in the noise, divided by its scale.

    Args:
        actor: the policy that flew the rollout.
        params: its parameters.
        tensordict: the rollout (*, horizon), with all that the policy wrote.
        grad: the gradient in its actions, (*, horizon, k).
        done: where episodes end, (*, horizon, 1).
        discount: of the gradient in the next action, for each step; a scalar.

    Returns:
        the gradient, and the action before the tanh, both (*, horizon, k).

    Raises:
        NotImplementedError: as for :func:`act_again`.
    """
    with params.to_module(actor):
        plain = _plain(actor)
        xi = plain.drawn_again(tensordict)[:, : plain.size].view_as(grad)
        scale = tensordict["scale"].detach()
        loc = tensordict["loc"].detach().requires_grad_()
        with torch.enable_grad():
            (grad,) = torch.autograd.grad((plain.action(loc, scale, xi) * grad).sum(), loc)
    if plain.rho is not None:
        in_noise, steps = torch.zeros_like(grad[..., 0, :]), []
        for g, s, end in zip(*(x.unbind(-2)[::-1] for x in (grad, scale, done)), strict=True):
            in_noise = g * s + plain.rho * discount * torch.where(end, 0.0, in_noise)
            steps.append(in_noise / s)
        grad = torch.stack(steps[::-1], -2)
    return grad, (loc + scale * xi).detach()


def _plain(actor: TensorDictModule) -> Any:
    make = getattr(actor, "replayed", None) or getattr(actor, "plain", lambda: None)
    plain = make()
    if not hasattr(plain, "drawn_again"):
        raise Unsupported(
            "Gradients of single actions need a policy of make_actor or make_visual_actor, whose noise follows from "
            "its actions, and RANDOM or DETERMINISTIC exploration. Build it so, without hooks or changed parts, or "
            "leave clip_action_gradient=None with another loss than AHACLoss and HybridLoss."
        )
    return plain


def median_length(length: Tensor) -> Tensor:
    """The median of lengths, of those that are not zero: a scalar, NaN where all are."""
    return torch.where(length > 0, length, torch.nan).nanmedian()


class MedianClip(nn.Module):
    """Shortens gradients (*, k) that are longer than ``factor`` times the running median of their lengths.

    One drone that tumbles has gradients many times as long as those of all others, and would be all of their mean. A
    gradient that is not finite would be all of it, too: it becomes zero, and counts as shortened.

    Args:
        factor: of the median; 1 to 5 are usual.
        decay: of the running median, for each call.
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


def _is_along_time(stack: Tensor) -> bool:
    """Whether the steps were stacked along the dimension before the last."""
    dim = stack.grad_fn._saved_dim
    dim = dim if dim < 2**63 else dim - 2**64  # it is kept without its sign
    return dim % stack.ndim == stack.ndim - 2
