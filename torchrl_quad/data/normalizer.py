"""Observations normalised by running statistics that gradients can pass."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, ObservationNorm

from torchrl_quad.data.unwrap import check_env, leaf, observed, state_keys
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.options import Entry, Positive, checked


@checked
class ObservationNormalizer(ObservationNorm):
    """Subtracts the mean and divides by the standard deviation of all observations seen, fixed within a horizon.

    TorchRL's VecNorm changes its statistics in place at every step, which breaks backward through a rollout. Here
    :meth:`update` changes them between horizons, and a graph that is not differentiated yet keeps its values.

    .. code-block:: python

        normalizer = ObservationNormalizer(env)
        env = TransformedEnv(env, normalizer)
        actor = make_actor(env, input_scale=1.0)  # the normalizer scales already
        rollout, carry = differentiable_rollout(env, actor, env.reset(), 64)
        normalizer.update(rollout)
        carry = env.reset(carry.select("state"), set_state=True)  # observe with the new statistics

    Args:
        env: the environment to wrap, for size, device and floating-point type of the observation.
        key: the entry (*, k) to normalise, which is overwritten.
        min_scale: the least standard deviation to divide by, in the observation's unit.
    """

    def __init__(self, env: EnvBase, key: Entry = "observation", *, min_scale: Positive = 0.01) -> None:
        check_env(env)
        specs = dict(observed(env).items(True, True))
        if key not in specs:
            raise UserValueError(
                f"The environment does not observe {key!r}. Choose from: {', '.join(map(str, specs))}."
            )
        if key in state_keys(env):
            raise UserValueError(
                f"{key!r} is part of the state from which the next step starts, and cannot be overwritten. Copy it: "
                f'CatTensors([{key!r}], "features", del_keys=False), and normalise "features".'
            )
        spec = specs[key]
        loc = torch.zeros(spec.shape[-1], device=spec.device, dtype=spec.dtype)
        super().__init__(loc, torch.ones_like(loc), in_keys=[key], standard_normal=True)
        self.min_scale = min_scale
        self.register_buffer("variance", torch.zeros_like(loc))
        self.register_buffer("count", torch.zeros_like(loc[0], dtype=torch.float64))

    def normalize(self, observation: Tensor) -> Tensor:
        """The observation (*, k) as the policy reads it."""
        return (observation - self.loc) / self.scale

    def undo(self, observation: Tensor) -> Tensor:
        """The reverse of :meth:`normalize`, with the present statistics."""
        return observation * self.scale + self.loc

    @torch.no_grad()
    def update(self, rollout: TensorDictBase) -> None:
        """Add the next observations of a rollout (any batch size), as this transform wrote them, to the statistics.

        Observations that are not finite are left out. Those written before, such as a carry's, do not change: reset to
        their state to observe them again.
        """
        entry = ("next", self.out_keys[0])
        if not isinstance(rollout, TensorDictBase) or entry not in rollout:
            raise UserTypeError(
                f"The normalizer reads {entry!r} of a rollout, the tensordict that differentiable_rollout returns."
            )
        written = leaf(rollout, entry).reshape(-1, self.loc.shape[-1]).to(self.loc)
        raw = self.undo(written[written.isfinite().all(-1)])
        if len(raw) == 0:
            return
        count = cast(Tensor, self.count) + len(raw)
        share = (len(raw) / count).to(raw.dtype)
        gap = raw.mean(0) - self.loc
        variance = cast(Tensor, self.variance)
        spread = torch.lerp(variance, raw.var(0, correction=0), share) + share * (1.0 - share) * gap.square()
        # New tensors: those of before may belong to a graph.
        self.count, self.loc, self.variance = count, self.loc + share * gap, spread
        self.scale = spread.sqrt().clamp_min(self.min_scale)
