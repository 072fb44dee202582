"""Networks as pure functions of tensors: policies that environments fly in their compiled step, and critics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.nn.utils import biased_softplus
from torch import Tensor, nn
from torch.func import vjp
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_quad.errors import UserValueError
from torchrl_quad.modules.heads import CorrelatedHead, GaussianHead, tanh_gaussian


class Network(nn.Module):
    """A multi-layer perceptron on the concatenation of its inputs, each multiplied by a constant of its own.

    Args:
        mlp: the perceptron.
        scales: the constants.
        widths: the sizes of the inputs.
    """

    def __init__(self, mlp: MLP, scales: Sequence[float], widths: Sequence[int]) -> None:
        super().__init__()
        self.mlp, self.scales, self.widths, self.head = mlp, tuple(scales), tuple(widths), nn.Identity()

    def forward(self, *inputs: Tensor) -> Any:
        """The head's output for inputs (*, k_i); the head receives (*, out_features), and the further inputs."""
        own = len(self.scales)
        _require_widths(inputs[:own], self.widths)
        return self.head(self.mlp(_concatenated(inputs[:own], self.scales)), *inputs[own:])


class Critic(ValueOperator):
    """What :func:`~torchrl_quad.make_value` and :func:`~torchrl_quad.make_qvalue` build.

    Losses call it as a pure function, which computes the same.
    """

    def plain(self) -> Callable[[Mapping[str, Tensor], Sequence[Tensor]], Tensor] | None:
        """The prediction (*, 1) as a function of the parameters, by name, and the inputs, each (*, k).

        None if somebody has changed its parts, or hooks it.
        """
        network = self.module
        is_known = type(self) is Critic and type(network) is Network and type(network.mlp) is MLP
        if not is_known or type(network.head) is not nn.Identity or is_hooked(self):
            return None
        layers = {f"module.mlp.{name}": layer for name, layer in network.mlp.named_children()}
        known = (nn.Linear, nn.LayerNorm)
        if len(layers) < len(network.mlp) or not all(
            type(layer) in known or is_pointwise(layer) for layer in layers.values()
        ):
            return None

        def predict(params: Mapping[str, Tensor], inputs: Sequence[Tensor]) -> Tensor:
            _require_widths(inputs, network.widths)
            x = _concatenated(inputs, network.scales)
            for name, layer in layers.items():
                own = params.get(f"{name}.weight"), params.get(f"{name}.bias")
                if type(layer) is nn.Linear:
                    x = nn.functional.linear(x, *own)
                elif type(layer) is nn.LayerNorm:
                    x = nn.functional.layer_norm(x, layer.normalized_shape, *own, layer.eps)
                else:
                    x = layer(x)
            return x

        return predict


class TanhGaussianActor(ProbabilisticActor):
    """What :func:`~torchrl_quad.make_actor` builds: a tanh-Gaussian policy that environments can fly as pure functions.

    It computes the same either way.
    """

    def plain(self) -> PlainTanhGaussian | None:
        """The policy as pure functions of its present weights; None if somebody has changed its parts, or hooks it."""
        is_random = samples(self)
        network = getattr(self[0], "module", None)
        is_known = is_random is not None and type(self) in (TanhGaussianActor, CorrelatedActor)
        if not is_known or type(network) is not Network or is_hooked(self) or len(self.module) != 2:
            return None
        if len(set(map(str, self[0].in_keys))) < len(self[0].in_keys):
            return None
        mapping = getattr(network.head, "scale_mapping", None)
        parts = (mapping, biased_softplus), (network.mlp, MLP)
        if type(network.head) not in (GaussianHead, CorrelatedHead):
            return None
        if any(type(x) is not cls for x, cls in parts) or self[1].distribution_class is not TanhNormal:
            return None
        layers, activations = list(network.mlp)[::2], list(network.mlp)[1::2]
        if any(type(layer) is not nn.Linear or layer.bias is None for layer in layers):
            return None
        if len(activations) != len(layers) - 1 or not all(map(is_pointwise, activations)):
            return None
        return PlainTanhGaussian(self, layers, activations, is_random)


class CorrelatedActor(TanhGaussianActor):
    """A tanh-Gaussian policy whose noise is correlated in time.

    ``noise`` is that of the step, and ``noise_before`` that of the step before. A flight hands ``noise`` on from step
    to step. Where there is none yet it is drawn. A deterministic flight has none.
    """

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        """Write loc, scale, action, noise and noise_before, and the log-probability if wanted."""
        return explore(self, self[0].module, super().forward, tensordict, **kwargs)


def explore(
    actor: ProbabilisticActor, network: Network, act: Callable[..., Any], tensordict: TensorDictBase, **kwargs: Any
) -> TensorDictBase:
    """Let a policy act with noise that is correlated in time; see :class:`CorrelatedActor`.

    Args:
        actor: the policy.
        network: its last one, whose head is a :class:`CorrelatedHead`.
        act: what it does under an exploration type that is neither RANDOM nor DETERMINISTIC.
        tensordict: the states (*), which it writes into.
        kwargs: of ``act``.
    """
    is_random, head = samples(actor), network.head
    shape, before = (*tensordict.batch_size, head.size), tensordict.get("noise", None)
    if before is None or not is_random:
        before = _first_noise(network.mlp[-1].weight.new_zeros(shape), is_random)
    tensordict.set("noise_before", before)
    if is_random is None:
        return act(tensordict, **kwargs).set("noise", before)
    loc, scale = (actor[0](tensordict).get(key) for key in ("loc", "scale"))
    xi = _first_noise(torch.zeros_like(loc.detach()), is_random)
    log_prob_key = actor[1].log_prob_key if actor[1].return_log_prob else None
    written = tanh_gaussian(loc, scale, xi, *bounds_of(actor), log_prob_key)
    return tensordict.update(written).set("noise", head.next(before, xi))


class PlainTanhGaussian:
    """A tanh-Gaussian policy on plain tensors; see the engine's ``PlainPolicy``."""

    def __init__(
        self, actor: TanhGaussianActor, layers: list[nn.Linear], activations: list[nn.Module], is_random: bool
    ) -> None:
        network, sample = actor[0].module, actor[1]
        self.scales, self.widths = network.scales, network.widths
        self.in_keys, self.out_keys = list(actor[0].in_keys)[: len(self.scales)], list(actor.out_keys)
        self.rho = network.head.rho if type(network.head) is CorrelatedHead else None
        self.head, self.activations, self.is_random = network.head, activations, is_random
        self.log_prob_key = sample.log_prob_key if sample.return_log_prob else None
        self.weights = tuple(x for layer in layers for x in (layer.weight, layer.bias))
        self.size = self.head.size
        self.low, self.high = (x if x is None else x.tolist() for x in bounds_of(actor))
        mapping = self.head.scale_mapping
        self.signature = (
            *map(str, (self.in_keys, self.out_keys, self.scales, self.activations, self.low, self.high)),
            *(tuple(x.shape) for x in self.weights),
            (self.head.scale_lb, mapping.bias, mapping.min_val, self.rho, self.head.max_loc),
        )

    def normalize(self, key: Any, loc: Tensor, scale: Tensor) -> None:
        """Subtract ``loc`` (k) from the input ``key``, and divide it by ``scale`` (k); the first layer can do both."""
        at = self.in_keys.index(key)
        weight, bias, *others = self.weights
        before, own, after = weight.split([sum(self.widths[:at]), len(loc), sum(self.widths[at + 1 :])], 1)
        own = own / scale
        self.weights = (torch.cat((before, own, after), 1), bias - own @ (loc * self.scales[at]), *others)

    def fits(self, inputs: Sequence[Tensor]) -> bool:
        """Whether the first layer can read inputs of this width, precision and device."""
        x, weight = torch.cat([x[:1] for x in inputs], -1), self.weights[0]
        return (x.shape[-1], x.dtype, x.device) == (weight.shape[1], weight.dtype, weight.device)

    def drawn(self, steps: int, n: int, before: Mapping[Any, Tensor]) -> Tensor:
        """Standard normal noise, as the distribution would draw it step by step; zeros for the mode.

        Noise that is correlated in time comes with that of the step before, (steps, n, 2 size).
        """
        like = self.weights[0]
        noise = like.new_zeros((steps, n, self.size))
        if self.rho is None:
            for x in noise if self.is_random else ():
                x.normal_()
            return noise
        last = before.get("noise") if self.is_random else None
        last = _first_noise(torch.zeros_like(noise[0]), self.is_random) if last is None else last
        earlier = []
        for x in noise:
            earlier.append(last)
            last = self.head.next(last, x.normal_() if self.is_random else x)
        return torch.cat((noise, torch.stack(earlier)), -1)

    def drawn_again(self, tensordict: TensorDictBase) -> Tensor:
        """What was drawn for the actions of a rollout (*), as rows (n, k); see :meth:`drawn` for correlated noise."""
        if self.rho is not None:
            noise, before = (tensordict[key].detach() for key in ("noise", "noise_before"))
            return torch.cat((self.head.innovation(before, noise), before), -1).flatten(0, -2)
        action, loc, scale = (tensordict[key].detach() for key in ("action", "loc", "scale"))
        if self.low is not None:
            low, high = (action.new_tensor(x) for x in (self.low, self.high))
            action = (2.0 * action - (high + low)) / (high - low)
        limit = 1.0 - torch.finfo(action.dtype).resolution
        return ((torch.atanh(action.clamp(-limit, limit)) - loc) / scale).flatten(0, -2)

    def distribution(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """loc and scale (*, k) in the states of a rollout (*), with gradients in the weights alone."""
        keys = [*self.in_keys, *([] if self.rho is None else ["noise_before"])]
        read = [tensordict[key].detach().flatten(0, -2) for key in keys]
        own = len(self.in_keys)
        loc, scale = self.head(self._layers(self.weights, read[:own])[-1], *read[own:])
        return loc.view(*tensordict.shape, -1), scale.view(*tensordict.shape, -1)

    def forward(
        self, weights: Sequence[Tensor], inputs: Sequence[Tensor], drawn: Tensor
    ) -> tuple[list[Tensor], dict[Any, Tensor]]:
        """What each layer returns before its activation, and loc, scale, action, and log-probability if wanted."""
        kept = self._layers(weights, inputs)
        return kept, self._sample(kept[-1], drawn)

    def adjoint(
        self,
        weights: Sequence[Tensor],
        inputs: Sequence[Tensor],
        kept: Sequence[Tensor],
        drawn: Tensor,
        grads: dict[Any, Tensor],
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """What each layer read, and the gradient of what it returned; the gradients of inputs and noise."""
        _, pull = vjp(self._sample, kept[-1], drawn)
        grad, grad_drawn = pull(grads)
        read, grads_kept = [], [grad]
        for weight, activation, x in zip(weights[-2:0:-2], self.activations[::-1], kept[-2::-1], strict=True):
            activated, pull = vjp(activation, x)
            (grad,) = pull(grad @ weight)
            read.append(activated)
            grads_kept.append(grad)
        read.append(_concatenated(inputs, self.scales))
        grads = (grad @ weights[0]).split([x.shape[-1] for x in inputs], -1)
        grads = [g if scale == 1.0 else g * scale for g, scale in zip(grads, self.scales, strict=True)]
        return [*read[::-1], *grads_kept[::-1]], grads, grad_drawn

    def weight_gradient(self, traces: Sequence[Tensor]) -> list[Tensor]:
        """The gradients of weight and bias of each layer, over a batch."""
        count = len(traces) // 2
        pairs = zip(traces[:count], traces[count:], strict=True)
        return [g for x, grad in pairs for g in (grad.t() @ x, grad.sum(0))]

    def action(self, loc: Tensor, scale: Tensor, xi: Tensor) -> Tensor:
        """The action (*, k) of a normal distribution and the noise in it, each (*, k)."""
        return self._squash(loc, scale, xi, None)["action"]

    def _layers(self, weights: Sequence[Tensor], inputs: Sequence[Tensor]) -> list[Tensor]:
        """What each layer returns before its activation, for inputs (n, k_i)."""
        x, kept = _concatenated(inputs, self.scales), []
        for weight, bias, activation in zip(weights[::2], weights[1::2], [*self.activations, None], strict=True):
            kept.append(torch.addmm(bias, x, weight.t()))
            x = kept[-1] if activation is None else activation(kept[-1])
        return kept

    def _squash(self, loc: Tensor, scale: Tensor, xi: Tensor, log_prob_key: Any) -> dict[Any, Tensor]:
        low, high = (None if bound is None else loc.new_tensor(bound) for bound in (self.low, self.high))
        return tanh_gaussian(loc, scale, xi, low, high, log_prob_key)

    def _sample(self, raw: Tensor, drawn: Tensor) -> dict[Any, Tensor]:
        xi, *before = drawn.split(self.size, -1)
        loc, scale = self.head(raw, *before)
        written = self._squash(loc, scale, xi, self.log_prob_key)
        if before:
            written |= {"noise_before": before[0], "noise": self.head.next(before[0], xi)}
        return {key: written[key] for key in self.out_keys}


def samples(actor: ProbabilisticActor) -> bool | None:
    """Whether it samples, or takes the mode; None where it is asked for something else."""
    kind = exploration_type() or actor[1].default_interaction_type
    return {ExplorationType.RANDOM: True, ExplorationType.DETERMINISTIC: False}.get(kind)


def bounds_of(actor: ProbabilisticActor) -> tuple[Tensor | None, Tensor | None]:
    """The least and the greatest action, each (k); None for -1 and 1."""
    bounds = actor[1].distribution_kwargs
    return (bounds["low"], bounds["high"]) if bounds else (None, None)


def _first_noise(x: Tensor, is_random: bool | None) -> Tensor:
    """Standard normal numbers into zeros (*, k), or the zeros where nothing is random."""
    return x.normal_() if is_random else x


def _require_widths(inputs: Sequence[Tensor], widths: Sequence[int]) -> None:
    found = tuple(x.shape[-1] for x in inputs)
    if found != tuple(widths):
        raise UserValueError(
            f"This network was built for entries of {', '.join(map(str, widths))} numbers, and reads some of "
            f"{', '.join(map(str, found))}: those of another environment, or of other options. Build one for this."
        )


def _concatenated(inputs: Sequence[Tensor], scales: Sequence[float]) -> Tensor:
    return torch.cat([x if scale == 1.0 else x * scale for x, scale in zip(inputs, scales, strict=True)], -1)


def is_hooked(module: nn.Module) -> bool:
    """Whether somebody watches or changes what a module or one of its parts reads or returns."""
    hooks = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
    return any(getattr(part, name) for part in module.modules() for name in hooks)


def is_pointwise(activation: nn.Module) -> bool:
    """Whether an activation is a function of its input alone: one of torch's without parameters or random numbers."""
    known = type(activation).__module__ == "torch.nn.modules.activation" and not isinstance(activation, nn.RReLU)
    return known and not getattr(activation, "inplace", False) and not list(activation.parameters())
