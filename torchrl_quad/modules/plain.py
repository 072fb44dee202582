"""Networks as pure functions of tensors: tanh-Gaussian policies that fly in the compiled step."""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor
from tensordict.nn.utils import biased_softplus
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.func import vjp
from torchrl.modules import MLP

from torchrl_quad.data.unwrap import leaf
from torchrl_quad.errors import UserValueError, WrongState

MEMORY = "recurrent_state"
NEAREST = 0.3  # [m]; closer depths are clamped
Pair = tuple[Tensor, Tensor]


class GaussianHead(NormalParamExtractor):
    """The normal distribution of an action, from what a network returns and, if rho > 0, the noise of the step before.

    With noise e_t = rho e_(t-1) + sqrt(1 - rho^2) xi_t the action mu + sigma e_t, of ``size`` k, has mean
    mu + rho sigma e_(t-1) and standard deviation sigma sqrt(1 - rho^2). Each e_t is standard normal, times ``share``:
    the noise is as large as without correlation. ``max_loc`` bounds mu: beyond 7.25 tanh is clipped, and an action no
    longer determines what was drawn, so that its log-probability falls without bound.
    """

    def __init__(self, size: int, scale_mapping: str, max_loc: float = math.inf, rho: float = 0.0) -> None:
        super().__init__(scale_mapping=scale_mapping)
        self.size, self.max_loc = size, max_loc
        self.rho, self.rest = rho, math.sqrt(1.0 - rho**2)
        self.share = 1.0  # of the noise that is drawn

    def draw(self, x: Tensor, is_random: bool | None) -> Tensor:
        """Fill zeros (*, k) with the new part of the noise; where nothing is random they stay zeros."""
        return x.normal_(std=self.share) if is_random else x

    def forward(self, raw: Tensor, *before: Tensor) -> tuple[Tensor, Tensor]:  # pyrefly: ignore[bad-override]  # 1 input
        """loc and scale (*, k), from both (*, 2k), or from loc alone (*, k): the scale stays what it starts as."""
        loc, scale = super().forward(raw if raw.shape[-1] > self.size else torch.cat((raw, torch.zeros_like(raw)), -1))
        loc = loc if self.max_loc == math.inf else loc.clamp(-self.max_loc, self.max_loc)
        return (loc + self.rho * scale * before[0], self.rest * scale) if before else (loc, scale)

    def next(self, before: Tensor, xi: Tensor) -> Tensor:
        """The noise of this step, from that of the step before and its new part xi."""
        return self.rho * before + self.rest * xi

    def innovation(self, before: Tensor, noise: Tensor) -> Tensor:
        """The new part of the noise of this step."""
        return (noise - self.rho * before) / self.rest


def tanh_gaussian(
    loc: Tensor, scale: Tensor, noise: Tensor, bounds: tuple[Tensor, Tensor] | None, log_prob_key: NestedKey | None
) -> dict[NestedKey, Tensor]:
    """loc, scale, the action (*, k) that noise makes of them, and its log-probability (*) if wanted."""
    x = loc + scale * noise
    limit = 1.0 - torch.finfo(x.dtype).resolution
    squashed = torch.tanh(x)
    # Clipped as in TorchRL's TanhNormal, which keeps the derivative where it clips.
    squashed = squashed + (squashed.clamp(-limit, limit) - squashed).detach()
    action = squashed
    if bounds is not None:
        low, high = bounds
        action = (high + low) / 2 + (high - low) / 2 * squashed
    written: dict[NestedKey, Tensor] = {"loc": loc, "scale": scale, "action": action}
    if log_prob_key is not None:
        written[log_prob_key] = log_density(x + (torch.atanh(squashed) - x).detach(), loc, scale, bounds)
    return written


def log_density(x: Tensor, loc: Tensor, scale: Tensor, bounds: tuple[Tensor, Tensor] | None) -> Tensor:
    """The log-probability (*) of the action that the tanh makes of x (*, k), which is normal with loc and scale."""
    density = -((x - loc) ** 2) / (2 * scale**2) - scale.log() - 0.5 * math.log(2 * math.pi)
    slope = 2.0 * (math.log(2.0) - x - nn.functional.softplus(-2.0 * x))
    if bounds is not None:
        slope = slope + ((bounds[1] - bounds[0]) / 2).log()
    return (density - slope).sum(-1)


class Network(nn.Module):
    """A multi-layer perceptron on the concatenation of its inputs of ``widths``, each times one of ``scales``."""

    def __init__(self, mlp: MLP, scales: Sequence[float], widths: Sequence[int]) -> None:
        super().__init__()
        self.mlp, self.scales, self.widths = mlp, tuple(scales), tuple(widths)
        self.head: nn.Module = nn.Identity()
        self.is_plain = all(isinstance(x, nn.Linear | nn.LayerNorm) or is_pointwise(x) for x in mlp)

    def forward(self, *inputs: Tensor) -> Any:
        """The head's output for inputs (*, k_i); the head receives (*, out_features), and the further inputs."""
        own = len(self.scales)
        return self.head(self.mlp(self.joined(inputs[:own])), *inputs[own:])

    def joined(self, inputs: Sequence[Tensor]) -> Tensor:
        """What the first layer reads; a UserValueError for inputs that the network was not built for."""
        found = tuple(x.shape[-1] for x in inputs)
        if found != self.widths:
            raise UserValueError(
                f"This network was built for entries of {', '.join(map(str, self.widths))} numbers, and reads some of "
                f"{', '.join(map(str, found))}: those of another environment, or of other options. Build one for this."
            )
        return concatenated(inputs, self.scales)


class PlainTanhGaussian:
    """A tanh-Gaussian policy on plain tensors, with eyes, memory, both or neither; see the engine's ``PlainPolicy``.

    It has convolutions, if it sees, and layers; a memory, if it has one, reads what the first layer returns, and the
    second layer reads both. The image has no gradient where ``without_gradient`` names it.
    """

    without_gradient: frozenset[NestedKey] = frozenset()
    squashes = True  # the action is a tanh
    nearest = NEAREST

    def __init__(
        self,
        actor: Any,
        in_keys: Sequence[NestedKey],
        reader: Network,
        layers: Sequence[nn.Module],
        convolutions: Sequence[nn.Module] = (),
        gru: Any = None,
    ) -> None:
        self.is_random, self.scales, self.widths = actor.is_random, reader.scales, reader.widths
        self.sees, self.lenses, self.activations = bool(convolutions), [*convolutions[1::2]], [*layers[1::2]]
        self.memory = {MEMORY: (1, gru.hidden_size)} if gru else {}
        self.in_keys, self.out_keys = [*map(unravel_key, in_keys), *self.memory], list(actor.out_keys)
        pairs = [(x.weight, x.bias) for x in cast(Any, [*convolutions[::2], *layers[::2]])]
        gates = [(gru.weight_ih_l0, gru.bias_ih_l0), (gru.weight_hh_l0, gru.bias_hh_l0)] if gru else []
        first = 1 + len(self.lenses)
        self.weights = tuple(x for pair in (*pairs[:first], *gates, *pairs[first:]) for x in pair)
        self._take_head(actor)

    @functools.cached_property
    def signature(self) -> Hashable:
        """What it computes; a compiler of a loss need not describe it."""
        mapping, parts = cast(biased_softplus, self.head.scale_mapping), (self.lenses, self.activations)
        return (
            *map(str, (self.in_keys, self.out_keys, self.scales, self.low, self.high, *parts)),
            *(tuple(x.shape) for x in self.weights),
            (self.head.scale_lb, mapping.bias, mapping.min_val, self.rho, self.head.max_loc),
        )

    def _take_head(self, actor: Any) -> None:
        self.head = cast(GaussianHead, actor.last.head)
        self.size, self.rho, self.log_prob_key = self.head.size, self.head.rho, actor.log_prob_entry
        self.low, self.high = (x.tolist() for x in actor.bounds) if actor.bounds else (None, None)

    def fits(self, inputs: Sequence[Tensor]) -> bool:
        """Whether the network can read inputs of this width, precision and device."""
        like, vectors = self.weights[0], self._vectors(inputs)
        fits = [x.shape[-1] for x in vectors] == list(self.widths[self.sees :])
        read = torch.cat([x[:1] for x in vectors], -1), *inputs[: self.sees], *inputs[self.sees + len(vectors) :]
        return fits and all((x.dtype, x.device) == (like.dtype, like.device) for x in read)

    def drawn(self, steps: int, n: int, before: Mapping[NestedKey, Tensor]) -> Tensor:
        """The noise, as the policy would draw it step by step; zeros for the mode.

        Noise that is correlated in time comes with that of the step before, (steps, n, 2 size).
        """
        noise = self.weights[0].new_zeros((steps, n, self.size))
        if not self.rho:
            for x in noise:
                self.head.draw(x, self.is_random)
            return noise
        last = before.get("noise") if self.is_random else None
        last = self.head.draw(torch.zeros_like(noise[0]), self.is_random) if last is None else last
        earlier = []
        for x in noise:
            earlier.append(last)
            last = self.head.next(last, self.head.draw(x, self.is_random))
        return torch.cat((noise, torch.stack(earlier)), -1)

    def drawn_again(self, tensordict: TensorDictBase) -> Tensor:
        """What was drawn for the actions of a rollout (*), as rows (n, k); see :meth:`drawn` for correlated noise."""
        if self.rho:
            noise, before = (leaf(tensordict, key).detach() for key in ("noise", "noise_before"))
            return torch.cat((self.head.innovation(before, noise), before), -1).flatten(0, -2)
        action, loc, scale = (leaf(tensordict, key).detach() for key in ("action", "loc", "scale"))
        return ((self._latent(action) - loc) / scale).flatten(0, -2)

    def log_prob(self, loc: Tensor, scale: Tensor, action: Tensor) -> Tensor:
        """The log-probability (*) of actions (*, k)."""
        return log_density(self._latent(action), loc, scale, self._bounds(loc))

    def _latent(self, action: Tensor) -> Tensor:
        """Actions (*, k) before the tanh; within 1e-6 of a bound they count as if they were that far from it."""
        if self.low is not None:
            low, high = (action.new_tensor(x) for x in (self.low, self.high))
            action = (2.0 * action - (high + low)) / (high - low)
        limit = 1.0 - torch.finfo(action.dtype).resolution
        return torch.atanh(action.clamp(-limit, limit))

    def recorded(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """loc and scale (*, k), before the tanh, with which a rollout was flown."""
        return leaf(tensordict, "loc"), leaf(tensordict, "scale")

    def distribution(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """loc and scale (*, k) in the states of a rollout (*), with gradients in the weights alone.

        A memory is built up again over the last dimension, if that is time.
        """
        has_time = tensordict.ndim > 1 or tensordict.names[-1] == "time"
        keys = [*self.in_keys, *(["is_init"] if self.memory else []), *(["noise_before"] if self.rho else [])]
        read = {key: leaf(tensordict, key).detach().flatten(0, tensordict.ndim - 1) for key in keys}
        lasts = ~read["is_init"].view(-1, tensordict.shape[-1] if has_time else 1, 1) if self.memory else None
        raw = self.layers(self.weights, [read[key] for key in self.in_keys], lasts)[-1]
        loc, scale = self.head(raw, *(read[key] for key in keys if key == "noise_before"))
        return loc.view(*tensordict.shape, -1), scale.view(*tensordict.shape, -1)

    def replay(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """What it writes in the states of a rollout (*), with the noise of the rollout."""
        noise = self.drawn_again(tensordict)[:, : self.size].view_as(leaf(tensordict, "action"))
        return self.squash(*self.distribution(tensordict), noise, self.log_prob_key)

    def forward(
        self, weights: Sequence[Tensor], inputs: Sequence[Tensor], drawn: Tensor
    ) -> tuple[list[Tensor], dict[NestedKey, Tensor]]:
        """What the layers return, as ``adjoint`` reads it, and all that the policy writes."""
        kept = self.layers(weights, inputs)
        written = self._sample(kept[-1], drawn)
        if self.memory:
            written["next", MEMORY] = kept.pop(self.sees + 4).unsqueeze(-2)
        return kept, {key: written[key] for key in self.out_keys}

    def adjoint(
        self,
        weights: Sequence[Tensor],
        inputs: Sequence[Tensor],
        kept: Sequence[Tensor],
        drawn: Tensor,
        grads: dict[NestedKey, Tensor],
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """What each layer read, and the gradient of what it returned; the gradients of inputs and noise."""
        (layers, gru), seen, kept = self._after_eyes(weights), kept[: self.sees], kept[self.sees :]
        own = {key: grads[key] for key in self.out_keys if key != ("next", MEMORY)}
        grad, grad_drawn = vjp(self._sample, kept[-1], drawn)[1](own)
        remembered = kept[1:4] if self.memory else []
        sums = [*kept[:1], *kept[1 + len(remembered) :]]
        activated = [vjp(activation, x)[:2] for activation, x in zip(self.activations, sums, strict=False)]
        read, of_memory = [self._joined(inputs, seen), *(x for x, _ in activated)], []
        of_kept, of_x = [grad], grad @ layers[-1][0]
        for i, (_, pull) in reversed([*enumerate(activated)]):
            if self.memory and i == 0:
                h, (gates, new, own_new) = inputs[-1].squeeze(-2), remembered
                of_x, of_recalled = of_x.split([read[1].shape[1], h.shape[1]], 1)
                of_recalled = of_recalled + grads["next", MEMORY].squeeze(-2)
                of_gates, of_own_new, of_h = gradient_before(of_recalled, h, gates, new, own_new, gru[1][0])
                read = [*read[:2], h, recalled_by(gates, new, h), *read[2:]]
                of_kept, of_memory = [of_gates, of_own_new, *of_kept], [of_h.unsqueeze(-2)]
                of_x = of_x + of_gates @ gru[0][0]
            (grad,) = pull(of_x)
            of_kept, of_x = [grad, *of_kept], grad @ layers[i][0]
        parts = zip(of_x.split(list(self.widths), 1), self.scales, strict=True)
        of_read = [g if scale == 1.0 else g * scale for g, scale in parts]
        if not self.sees:
            return [*read, *of_kept], [*of_read, *of_memory], grad_drawn
        image, of_seen = inputs[0], of_read[0]
        of_read[0] = torch.zeros_like(image)
        if self.in_keys[0] not in self.without_gradient:
            (of_read[0],) = vjp(lambda image: self._see(weights, [image])[0], image)[1](of_seen)
        return [image, of_seen, *read, *of_kept], [*of_read, *of_memory], grad_drawn

    def weight_gradient(self, weights: Sequence[Tensor], traces: Sequence[Tensor]) -> list[Tensor]:
        """The gradients of weight and bias of each layer, over a batch."""
        seen: tuple[Tensor, ...] = ()
        if self.sees:
            (image, of_seen, *traces), count = traces, 2 * len(self.lenses)
            seen = vjp(lambda *own: self._see(own, [image])[0], *weights[:count])[1](of_seen)
        count = len(traces) // 2
        pairs = zip(traces[:count], traces[count:], strict=True)
        found = [g for x, grad in pairs for g in (grad.t() @ x, grad.sum(0))]
        if self.memory:  # whose own layer has the first gradients of the other's; the second layer reads x as well
            (x, h), (of_gates, _, grad) = traces[1:3], traces[count + 1 : count + 4]
            size, (of_bias, own, own_bias, second) = 2 * h.shape[1], found[3:7]
            own = torch.cat((of_gates[:, :size].t() @ h, own))
            found[4:7] = own, torch.cat((of_bias[:size], own_bias)), torch.cat((grad.t() @ x, second), 1)
        return [*seen, *found]

    def layers(self, weights: Sequence[Tensor], inputs: Sequence[Tensor], lasts: Tensor | None = None) -> list[Tensor]:
        """What the eyes return, and each layer before its activation; after the first one, what the memory recalls.

        Inputs are (n, ...). Where they are states of flights, one after another, ``lasts``, bool (flights, horizon, 1),
        says where a memory is kept from the step before; otherwise each state comes with its memory, whose gates are
        also returned.
        """
        kept, (layers, gru) = self._see(weights, inputs), self._after_eyes(weights)
        x = self._joined(inputs, kept)
        for i, (weight, bias) in enumerate(layers):
            kept.append(torch.addmm(bias, x, weight.t()))
            if i == len(self.activations):
                break
            x = self.activations[i](kept[-1])
            if self.memory and i == 0:
                h, (weight, bias), own = inputs[-1].squeeze(-2), *gru
                read = torch.addmm(bias, x, weight.t())
                if lasts is None:
                    gates, new, own_new = gates_of(read, h, *own)
                    kept += [gates, new, own_new, recalled_by(gates, new, h)]
                else:
                    read, h = (y.unflatten(0, lasts.shape[:2]).transpose(0, 1) for y in (read, h))
                    recalled = Recall.apply(read, h[0], lasts.to(read).transpose(0, 1), *own)
                    kept.append(cast(Tensor, recalled).transpose(0, 1).flatten(0, 1))
                x = torch.cat((x, kept[-1]), 1)
        return kept

    def _after_eyes(self, weights: Sequence[Tensor]) -> tuple[list[Pair], list[Pair]]:
        """Weight and bias of each layer after the convolutions, and of the two of a memory."""
        own = weights[2 * len(self.lenses) :]
        pairs = list(zip(own[::2], own[1::2], strict=True))
        return ([pairs[0], *pairs[3:]], pairs[1:3]) if self.memory else (pairs, [])

    def _see(self, weights: Sequence[Tensor], inputs: Sequence[Tensor]) -> list[Tensor]:
        """What the convolutions return of a depth image (n, channels, height, width) [m], (n, k); nothing if blind."""
        if not self.sees:
            return []
        x = inputs[0].clamp_min(self.nearest).reciprocal()
        for weight, bias, activation in zip(weights[::2], weights[1::2], self.lenses, strict=False):
            x = activation(nn.functional.conv2d(x, weight, bias, stride=2, padding=1))
        return [x.flatten(1)]

    def _vectors(self, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
        """The inputs that are neither the image nor the memory."""
        return inputs[self.sees : len(inputs) - len(self.memory)]

    def _joined(self, inputs: Sequence[Tensor], seen: Sequence[Tensor]) -> Tensor:
        """What the first layer after the convolutions reads."""
        return concatenated([*seen, *self._vectors(inputs)], self.scales)

    def squash(
        self, loc: Tensor, scale: Tensor, xi: Tensor, log_prob_key: NestedKey | None = None
    ) -> dict[NestedKey, Tensor]:
        """What :func:`tanh_gaussian` writes, within the bounds of the action."""
        return tanh_gaussian(loc, scale, xi, self._bounds(loc), log_prob_key)

    def _bounds(self, like: Tensor) -> tuple[Tensor, Tensor] | None:
        return None if self.low is None else (like.new_tensor(self.low), like.new_tensor(self.high))

    def _sample(self, raw: Tensor, drawn: Tensor) -> dict[NestedKey, Tensor]:
        xi, *before = drawn.split(self.size, -1)
        loc, scale = self.head(raw, *before)
        written = self.squash(loc, scale, xi, self.log_prob_key)
        if before:
            written |= {"noise_before": before[0], "noise": self.head.next(before[0], xi)}
        return {key: written[key] for key in self.out_keys if key in written}


def concatenated(inputs: Sequence[Tensor], scales: Sequence[float]) -> Tensor:
    """Vectors (*, k_i), each times its scale, as one."""
    return torch.cat([x if scale == 1.0 else x * scale for x, scale in zip(inputs, scales, strict=True)], -1)


def layout(network: nn.Module) -> list[Any]:
    """The types of a network's parts, their weights and hooks, which show a change of any part but an activation."""
    found: list[Any] = []
    for part in network.modules():
        hooks = part._forward_hooks or part._forward_pre_hooks or part._backward_hooks or part._backward_pre_hooks
        found += [is_pointwise(part) or type(part), bool(hooks), *(x is None for x in part._parameters.values())]
    return found


def is_pointwise(part: nn.Module) -> bool:
    """Whether a part is a function of its input alone: an activation of torch without parameters or random numbers."""
    if type(part).__module__ != "torch.nn.modules.activation" or isinstance(part, nn.RReLU):
        return False
    return not getattr(part, "inplace", False) and not part._parameters


def gates_of(read: Tensor, h: Tensor, own_weight: Tensor, own_bias: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The two gates of a GRU, for resets and to keep (n, 2k), the new memory, and the memory's share in it (n, k).

    As in TorchRL's GRUModule, from what its first layer returns of the input (n, 3k), and the memory h (n, k).
    """
    size = 2 * h.shape[1]
    own = torch.addmm(own_bias[:size], h, own_weight[:size].t())
    own_new = torch.addmm(own_bias[size:], h, own_weight[size:].t())
    gates, new = read.split([size, size // 2], 1)
    gates = (gates + own).sigmoid()
    return gates, (new + gates[:, : size // 2] * own_new).tanh(), own_new


def recalled_by(gates: Tensor, new: Tensor, h: Tensor) -> Tensor:
    """What a GRU recalls (n, k)."""
    return new + gates[:, h.shape[1] :] * (h - new)


def gradient_before(
    of_recalled: Tensor, h: Tensor, gates: Tensor, new: Tensor, own_new: Tensor, own_weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """From the gradient of what a GRU recalls (n, k) those of ``read`` and ``own_new`` of gates_of, and of h."""
    reset, keep = gates.chunk(2, 1)
    of_new = (of_recalled - of_recalled * keep) * (1.0 - new * new)
    of_both = torch.cat((of_new * own_new, of_recalled * (h - new)), 1) * ((1.0 - gates) * gates)
    of_own_new = of_new * reset
    of_h = of_recalled * keep + torch.cat((of_both, of_own_new), 1) @ own_weight
    return torch.cat((of_both, of_new), 1), of_own_new, of_h


class Recall(torch.autograd.Function):
    """What a GRU recalls (horizon, n, k), from what its first layer returns of its inputs (horizon, n, 3k).

    It starts from a memory (n, k), and forgets where ``lasts`` (horizon, n, 1) is 0. A loop over autograd takes three
    times as long.
    """

    @staticmethod
    def forward(ctx: Any, read: Tensor, h: Tensor, lasts: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Keep each step's memory and gates."""
        recalled, kept = [], []
        for x, last in zip(read, lasts, strict=True):
            h = h * last
            gates, new, own_new = gates_of(x, h, weight, bias)
            kept += [h, gates, new, own_new]
            h = recalled_by(gates, new, h)
            recalled.append(h)
        ctx.save_for_backward(lasts, weight, *kept)
        return torch.stack(recalled)

    @staticmethod
    def backward(ctx: Any, of_recalled: Tensor) -> tuple[Tensor | None, ...]:  # pyrefly: ignore[bad-override]  # 1 output
        """The gradients of ``read``, of the memory's weight and bias."""
        if torch.is_grad_enabled():  # so it is only under create_graph=True
            raise WrongState(
                "The loss of a policy with memory has first derivatives only. For second ones (create_graph=True) "
                "build the policy without a memory."
            )
        lasts, weight, *kept = ctx.saved_tensors
        of_h, of_read, of_own = torch.zeros_like(of_recalled[0]), [], []
        for i in reversed(range(len(lasts))):
            h, gates, new, own_new = kept[4 * i : 4 * i + 4]
            of_gates, of_own_new, of_h = gradient_before(of_recalled[i] + of_h, h, gates, new, own_new, weight)
            of_h = of_h * lasts[i]
            of_read.append(of_gates)
            of_own.append(of_own_new)
        of_x, before = torch.stack(of_read[::-1]), torch.cat(kept[::4])
        own = torch.cat((of_x[..., : 2 * before.shape[1]], torch.stack(of_own[::-1])), -1).flatten(0, 1)
        return of_x, None, None, own.t() @ before, own.sum(0)
