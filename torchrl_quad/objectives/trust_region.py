"""A bound on how far one update may move a policy."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from torchrl_quad.data.unwrap import leaf
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.options import NonNegative, Positive, checked


@checked
class TrustRegion:
    """Shortens an update that would move a Gaussian policy beyond a bound on the Kullback-Leibler divergence.

    The divergence KL(before || after) is summed over the entries of the action and averaged over the states of a
    rollout. It grows with the square of the step, so a step that is too long is shortened by the root of its excess
    until it keeps the bound. An update to numbers that are not finite is undone.

    .. code-block:: python

        trust_region = TrustRegion(actor, max_kl=0.05)
        with trust_region.around(rollout):
            optimizer.step()

    Args:
        actor: a policy of :func:`~torchrl_quad.make_actor`; the bound is on its normal distributions before the tanh.
        max_kl: the largest divergence of an update, 0.01 to 0.1 are usual; None for no bound, which measures nothing.
        min_scale: the least standard deviation that the divergence is computed with. A policy whose noise the gradient
            has taken away could otherwise not move at all within a bound.
        average: of a scalar over the processes that train together, if there are several.

    Attributes:
        metrics: ``kl``, the divergence of the last update before it was shortened; empty without a bound.
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        max_kl: Positive | None,
        *,
        min_scale: NonNegative = 0.1,
        average: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        if not hasattr(actor, "get_dist_params"):
            raise UserTypeError(f"actor must be a policy as make_actor builds it; got {type(actor).__name__}.")
        self.actor, self.max_kl, self.min_scale, self.average = actor, max_kl, min_scale, average
        self.metrics: dict[str, Tensor] = {}

    @contextlib.contextmanager
    def around(self, rollout: TensorDictBase) -> Iterator[None]:
        """Bound what the block does to the policy that flew the rollout, and wrote its ``loc`` and ``scale``."""
        if self.max_kl is None:
            yield
            return
        if not isinstance(rollout, TensorDictBase) or "loc" not in rollout or "scale" not in rollout:
            raise UserValueError("TrustRegion reads loc and scale, which are not in the rollout. Give what was flown.")
        parameters: list[Tensor] = list(self.actor.parameters())
        before = [x.detach().clone() for x in parameters]
        yield
        with torch.no_grad():
            for attempt in range(21):
                kl = self.divergence(rollout)
                kl = kl if self.average is None else self.average(kl)
                if attempt == 0:
                    self.metrics = {"kl": kl}
                if kl <= self.max_kl:
                    return
                if not kl.isfinite():
                    break
                torch._foreach_lerp_(parameters, before, 1.0 - (self.max_kl / float(kl)) ** 0.5)
            torch._foreach_copy_(parameters, before)

    def divergence(self, rollout: TensorDictBase) -> Tensor:
        """KL(policy that flew the rollout || policy as it is now), a scalar."""
        now = cast(TensorDictBase, self.actor.get_dist_params(rollout.select(*self.actor.in_keys).detach()))
        old, new = (
            Normal(leaf(td, "loc").detach(), leaf(td, "scale").detach().clamp_min(self.min_scale))
            for td in (rollout, now)
        )
        return kl_divergence(old, new).sum(-1).mean()
