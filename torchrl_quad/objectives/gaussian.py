"""Any policy that draws its action from a normal distribution, as losses let it act again in a rollout."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Normal
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.module import register_module_forward_hook, register_module_forward_pre_hook
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, TanhNormal, set_recurrent_mode

from torchrl_quad.data.unwrap import leaf, memory_keys
from torchrl_quad.errors import Unsupported


class GaussianPolicy:
    """A policy whose action is a TanhNormal or an IndependentNormal of TorchRL, whatever network stands before that.

    It is to losses what ``PlainTanhGaussian`` is for the policies of ``make_actor``. The network is called once for
    all states of a rollout (*, horizon), or for samples (n), with gradients in its weights alone; a memory is built up
    again from that at the start of the rollout.

    Raises:
        NotImplementedError: its action comes from something else, or its network draws random numbers or uses the
            statistics of a batch, so that it does not write the same again.
    """

    rho = 0.0

    def __init__(self, actor: TensorDictModuleBase, tensordict: TensorDictBase) -> None:
        sampler = sampler_of(actor)
        if sampler is None:
            raise Unsupported(f"{_NEEDED}; {type(actor).__name__} has no distribution. {_INSTEAD}")
        self.actor, self.sampler, self.action_key = actor, sampler, sampler.dist_sample_keys[0]
        parts = list(actor.named_modules())
        for name, part in parts[[part for _, part in parts].index(sampler) + 1 :]:
            if isinstance(part, TensorDictModuleBase) and self.action_key in part.out_keys:
                raise Unsupported(
                    f"{_NEEDED}, and here {type(part).__name__} ({name}) changes the action afterwards. "
                    "Let the distribution write the action that is flown."
                )
        self.flown = self._distribution(tensordict.select(*sampler.in_keys).detach())
        self.squashes = isinstance(self.flown, TanhNormal)
        self.transforms: list[Any] = self.flown.transforms if self.squashes else []
        self.size = leaf(tensordict, self.action_key).shape[-1]

    def recorded(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """loc and scale (*, k), before the tanh, with which the rollout was flown."""
        return _normal(self.flown)

    def drawn_again(self, tensordict: TensorDictBase) -> Tensor:
        """What was drawn for the actions of the rollout (*), as rows (n, k)."""
        x, (loc, scale) = leaf(tensordict, self.action_key).detach(), _normal(self.flown)
        for transform in reversed(self.transforms):
            x = transform.inv(x)
        return ((x - loc) / scale).flatten(0, -2)

    def squash(self, loc: Tensor, scale: Tensor, xi: Tensor) -> dict[NestedKey, Tensor]:
        """The action (*, k) that noise makes of loc and scale, and its log-probability (*) if the policy writes it."""
        x = before = loc + scale * xi
        slope = torch.zeros_like(x)
        for transform in self.transforms:
            x, last = transform(x), x
            slope = slope + transform.log_abs_det_jacobian(last, x)
        written: dict[NestedKey, Tensor] = {"action": x, self.action_key: x}
        if self.sampler.return_log_prob:
            written[self.sampler.log_prob_key] = (Normal(loc, scale).log_prob(before) - slope).sum(-1)
        return written

    def distribution(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """loc and scale (*, k), before the tanh, in the states of the rollout, with gradients in the weights alone."""
        states, shape = tensordict.select(*self.actor.in_keys).detach(), tensordict.shape
        has_memory = bool(memory_keys(self.actor))
        has_time = has_memory and (tensordict.ndim > 1 or tensordict.names[-1] == "time")
        states = cast(TensorDictBase, states if has_memory else states.reshape(-1))  # as it was flown
        with set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(has_time):
            loc, scale = _normal(self._distribution(self._call(states)))
        return loc.reshape(*shape, -1), scale.reshape(*shape, -1)

    def replay(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """What it writes in the states of a rollout (*, horizon), with the noise of the rollout."""
        noise = self.drawn_again(tensordict).view(*tensordict.shape, -1)
        return self.squash(*self.distribution(tensordict), noise)

    def _distribution(self, tensordict: TensorDictBase) -> Any:
        dist = self.sampler.get_dist(tensordict)
        if not isinstance(dist, TanhNormal | IndependentNormal):
            raise Unsupported(f"{_NEEDED}; this one has {type(dist).__name__}. {_INSTEAD}")
        return dist

    def _call(self, states: TensorDictBase) -> TensorDictBase:
        """What the policy writes in states; an error for a layer that would not write the same again."""
        names, before = {part: name for name, part in self.actor.named_modules()}, {}
        for part in names:
            if isinstance(part, ProbabilisticTensorDictModule) and part is not self.sampler:
                raise _changing(part, names[part], "draws random numbers")
            if isinstance(part, _BatchNorm) and (part.training or part.running_mean is None):
                raise _changing(part, names[part], "uses the statistics of its batch")
        if torch.compiler.is_compiling():
            return self.actor(states)

        def leave(part: nn.Module, *_: Any) -> None:  # the innermost part returns first
            for does, now in _changeable(part).items():
                if now != before[part][does]:
                    raise _changing(part, names.get(part, ""), does)

        enter = register_module_forward_pre_hook(lambda part, _: before.update({part: _changeable(part)}))
        with enter, register_module_forward_hook(leave):
            return self.actor(states)


def sampler_of(actor: TensorDictModuleBase) -> ProbabilisticTensorDictModule | None:
    """The part of a policy that samples from a distribution; the last one of several."""
    found = [part for part in actor.modules() if isinstance(part, ProbabilisticTensorDictModule)]
    return found[-1] if found else None


_NEEDED = "Gradients of single actions need a policy whose action is a TanhNormal or an IndependentNormal"
_INSTEAD = (
    "Build it by make_actor, or as TorchRL's ProbabilisticActor with distribution_class=TanhNormal; or leave "
    "clip_action_gradient=None with a loss other than AHACLoss and HybridLoss."
)


def _normal(dist: Any) -> tuple[Tensor, Tensor]:
    """loc and scale of the normal distribution under the tanh."""
    base = dist.root_dist if isinstance(dist, TanhNormal) else dist.base_dist
    return base.loc, base.scale


def _changeable(part: nn.Module) -> dict[str, list[Any]]:
    """Where torch's generators stand, and how often a part's statistics were changed in place; by what moves it."""
    devices = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    random = torch.get_rng_state(), *(torch.cuda.get_rng_state(i) for i in devices)
    statistics = (x for x in part._buffers.values() if x is not None and x.is_floating_point())
    return {
        "draws random numbers": [x.numpy().tobytes() for x in random],
        "changes its statistics": [x._version for x in statistics],
    }


def _changing(part: nn.Module, name: str, does: str) -> Unsupported:
    return Unsupported(
        "Gradients of single actions let the policy act again in the same states, and its layer "
        f"{type(part).__name__}{f' ({name})' * bool(name)} {does}, so that it writes something else. Call actor.eval() "
        "before the flight, or build the policy without that layer."
    )
