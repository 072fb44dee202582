"""Observations normalised by running statistics, in a way that gradients survive."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, ObservationNorm


class ObservationNormalizer(ObservationNorm):
    """Subtracts the mean and divides by the standard deviation of all observations seen, fixed within a horizon.

    TorchRL's VecNorm changes its statistics in place at every step, which breaks backward through a rollout. Here
    :meth:`update` changes them between horizons, and a graph that is still to be differentiated keeps the values that
    it was made with. The statistics are buffers and therefore part of ``state_dict``.

    .. code-block:: python

        normalizer = ObservationNormalizer(env)
        env = TransformedEnv(env, normalizer)
        actor = make_actor(env, input_scale=1.0)  # the normalizer scales already
        rollout, carry = differentiable_rollout(env, actor, env.reset(), 64)
        normalizer.update(rollout)
        carry = env.reset(carry.select("state"), set_state=True)  # observe anew, with the new statistics

    Args:
        env: the environment to wrap, for size, device and floating-point type of the observation.
        key: the entry (*, k) to normalise, which is overwritten.
        min_scale: the least standard deviation to divide by, in the observation's unit.

    Raises:
        ValueError: the environment does not observe the key, or min_scale is not positive.
    """

    def __init__(self, env: EnvBase, key: NestedKey = "observation", *, min_scale: float = 0.01) -> None:
        if key not in env.observation_spec.keys(True, True):
            raise ValueError(
                f"The environment does not observe {key!r}. Choose from: "
                f"{', '.join(map(str, env.observation_spec.keys(True, True)))}."
            )
        if not min_scale > 0:
            raise ValueError(f"min_scale must be positive, since the normalizer divides by it; got {min_scale}.")
        spec = env.observation_spec[key]
        loc = torch.zeros(spec.shape[-1], device=spec.device, dtype=spec.dtype)
        super().__init__(loc, torch.ones_like(loc), in_keys=[key], standard_normal=True)
        self.min_scale = min_scale
        self.register_buffer("variance", torch.zeros_like(loc))
        self.register_buffer("count", torch.zeros_like(loc[0], dtype=torch.float64))

    @torch.no_grad()
    def update(self, rollout: TensorDictBase) -> None:
        """Add the next observations of a rollout (any batch size), as this transform wrote them, to the statistics.

        Observations that are not finite are left out. Those written before, such as a carry's, do not change; reset to
        their state to observe them anew.
        """
        written = rollout.get(("next", self.out_keys[0])).reshape(-1, self.loc.shape[-1])
        seen = written[written.isfinite().all(-1)] * self.scale + self.loc
        if len(seen) == 0:
            return
        count = self.count + len(seen)
        share = (len(seen) / count).to(seen.dtype)
        gap = seen.mean(0) - self.loc
        spread = torch.lerp(self.variance, seen.var(0, correction=0), share) + share * (1.0 - share) * gap.square()
        # New tensors: those of before may belong to a graph.
        self.count, self.loc, self.variance = count, self.loc + share * gap, spread
        self.scale = spread.sqrt().clamp_min(self.min_scale)
