"""Gradients in the single actions of a rollout, and how a policy learns from them."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.autograd.graph import GradientEdge
from torch.func import vjp

from torchrl_quad.errors import Unsupported, UserValueError
from torchrl_quad.objectives.calls import act


def action_gradient(objective: Tensor, action: Tensor) -> Tensor:
    """The gradient of a scalar in each action of a rollout, by all that follows from it, the policy included.

    ``action`` is ``rollout["action"]`` (*, horizon, k) as it was flown, no copy or part, with its graph, which is kept.
    """
    node: Any = action.grad_fn
    steps = sources_of_steps(action)
    if isinstance(steps, Tensor):
        node.learns = False  # the weights of a policy inside the compiled horizon get no gradient here
        try:
            (grad,) = torch.autograd.grad(objective, steps, retain_graph=True)
        finally:
            node.learns = True
        return vjp(node.applied, action.detach())[1](grad.movedim(0, -2))[0]
    dim = None if steps is None else node._saved_dim  # of the stack; -2 is kept without its sign
    if steps is None or len(steps) != action.shape[-2] or dim not in (action.ndim - 2, 2**64 - 2):
        raise UserValueError(
            "The gradient of each action needs one rollout as differentiable_rollout returned it, whole and with its "
            "graph; this one was copied, reshaped or cut. Give the rollout itself to the loss."
        )
    grads = torch.autograd.grad(objective, steps, retain_graph=True, allow_unused=True)
    return torch.stack([torch.zeros_like(action[..., 0, :]) if g is None else g for g in grads], -2)


def sources_of_steps(entry: Tensor) -> Tensor | list[GradientEdge] | None:
    """What the rewards of a rollout depend on instead of one of its entries, which was stacked afterwards.

    A compiled horizon holds the actions of all steps in one tensor (horizon, num_envs, k). Otherwise each step that has
    a graph has its own place in it. None: the entry is no stack.
    """
    node: Any = entry.grad_fn
    if hasattr(node, "actions"):  # a compiled horizon, a node of its own
        return node.actions
    if node is None or node.name() != "StackBackward0":
        return None
    return [GradientEdge(step, index) for step, index in node.next_functions if step is not None]


def act_again(actor: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
    """What a policy of ``make_actor`` or ``make_visual_actor`` writes in a rollout's states, with the rollout's noise.

    The values are those of the rollout as long as the policy has not changed. The gradients reach the policy's
    parameters alone, neither earlier states nor the noise. A memory is built up again from that at the start.
    Actions within 1e-6 of a bound count as if they were that far from it.
    """
    with params.to_module(actor):
        plain = plain_of(actor)
        if hasattr(plain, "replay"):
            return plain.replay(tensordict)
        return act(plain, tensordict.select(*plain.in_keys).detach(), plain.drawn_again(tensordict))


def distribution_again(
    actor: TensorDictModule, params: TensorDictParams, tensordict: TensorDictBase
) -> tuple[Tensor, Tensor]:
    """loc and scale, before the tanh, in a rollout's states, (*, k); otherwise as :func:`act_again`."""
    with params.to_module(actor):
        return plain_of(actor).distribution(tensordict)


def plain_of(actor: TensorDictModule) -> Any:
    """A policy whose noise follows from its actions, as functions of tensors: a ``PlainTanhGaussian``."""
    make = getattr(actor, "replayed", None) or getattr(actor, "plain", lambda: None)
    plain = make()
    if not hasattr(plain, "drawn_again"):
        raise Unsupported(
            "Gradients of single actions need a policy of make_actor or make_visual_actor, whose noise follows from "
            "its actions, and RANDOM or DETERMINISTIC exploration. Build it so, without hooks or changed parts, or "
            "leave clip_action_gradient=None with a loss other than AHACLoss and HybridLoss."
        )
    return plain


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
