"""What a policy makes of the numbers that its network returns: a tanh-Gaussian action, and its noise."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict.nn import NormalParamExtractor
from torch import Tensor, nn


class GaussianHead(NormalParamExtractor):
    """The normal distribution of an action of ``size`` entries, from what a network returns.

    Args:
        size: of the action, k.
        scale_mapping: as for NormalParamExtractor.
        max_loc: the largest mean, by its absolute value. Beyond 7.25 tanh is clipped, and an action no
            longer determines what was drawn: its log-probability falls without bound.
    """

    def __init__(self, size: int, scale_mapping: str, max_loc: float = math.inf) -> None:
        super().__init__(scale_mapping=scale_mapping)
        self.size, self.max_loc = size, max_loc

    def forward(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """loc and scale (*, k), from both (*, 2k), or from loc alone (*, k): the scale stays what it starts as."""
        loc, scale = super().forward(raw if raw.shape[-1] > self.size else torch.cat((raw, torch.zeros_like(raw)), -1))
        return loc if self.max_loc == math.inf else loc.clamp(-self.max_loc, self.max_loc), scale


class CorrelatedHead(GaussianHead):
    """The normal distribution of an action whose noise e is correlated in time, given the noise of the step before.

    With e_t = rho e_(t-1) + sqrt(1 - rho^2) xi_t the action mu + sigma e_t has mean mu + rho sigma e_(t-1) and standard
    deviation sigma sqrt(1 - rho^2). Every e_t for itself is standard normal, so the noise is as large as without
    correlation.

    Args:
        rho: the correlation of the noise of two steps that follow each other.
        size, scale_mapping, max_loc: as for GaussianHead.
    """

    def __init__(self, rho: float, size: int, scale_mapping: str, max_loc: float = math.inf) -> None:
        super().__init__(size, scale_mapping, max_loc)
        self.rho, self.rest = rho, math.sqrt(1.0 - rho**2)

    def forward(self, raw: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """loc and scale (*, k) from what the network returns, and the noise of the step before (*, k)."""
        loc, scale = super().forward(raw)
        return loc + self.rho * scale * before, self.rest * scale

    def next(self, before: Tensor, xi: Tensor) -> Tensor:
        """The noise of this step, from that of the step before and what is new in it."""
        return self.rho * before + self.rest * xi

    def innovation(self, before: Tensor, noise: Tensor) -> Tensor:
        """What is new in the noise of this step."""
        return (noise - self.rho * before) / self.rest


def tanh_gaussian(
    loc: Tensor, scale: Tensor, noise: Tensor, low: Tensor | None, high: Tensor | None, log_prob_key: Any
) -> dict[Any, Tensor]:
    """loc, scale, the action (*, k) that standard normal noise makes of them, and its log-probability (*) if wanted."""
    x = loc + scale * noise
    limit = 1.0 - torch.finfo(x.dtype).resolution
    squashed = torch.tanh(x)
    # Clipped as in TorchRL's TanhNormal, which keeps the derivative where it clips.
    squashed = squashed + (squashed.clamp(-limit, limit) - squashed).detach()
    action = squashed if low is None else (high + low) / 2 + (high - low) / 2 * squashed
    written = {"loc": loc, "scale": scale, "action": action}
    if log_prob_key is not None:
        x = x + (torch.atanh(squashed) - x).detach()
        density = -((x - loc) ** 2) / (2 * scale**2) - scale.log() - 0.5 * math.log(2 * math.pi)
        slope = 2.0 * (math.log(2.0) - x - nn.functional.softplus(-2.0 * x))
        if low is not None:
            slope = slope + ((high - low) / 2).log()
        written[log_prob_key] = (density - slope).sum(-1)
    return written
