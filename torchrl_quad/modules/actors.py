"""Policies: a tanh-Gaussian head on layers, on memory in a GRU, and on convolutions of depth images."""

from __future__ import annotations

import functools
from collections.abc import Hashable, Sequence
from typing import Annotated, Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.func import vjp
from torchrl.data import Unbounded
from torchrl.envs import EnvBase, TensorDictPrimer
from torchrl.modules import MLP, ConvNet, GRUModule, ProbabilisticActor, set_recurrent_mode
from torchrl.modules.tensordict_module.rnn import GRU

from torchrl_quad.data.unwrap import check_env, leaf, observed
from torchrl_quad.errors import UserValueError
from torchrl_quad.modules.networks import OBSERVATION, Activation, Cells, ScaleInit, first_action, network_of, policy_of
from torchrl_quad.modules.plain import (
    Network,
    PlainTanhGaussian,
    Recall,
    TanhGaussianActor,
    concatenated,
    gates_of,
    gradient_before,
    is_pointwise,
    layout,
    recalled_by,
)
from torchrl_quad.options import Below1, Entries, Entry, Field, Scale, Width, checked

MEMORY = "recurrent_state"
NEAREST = 0.3  # [m]; closer depths are clamped


@checked
def make_actor(
    env: EnvBase,
    num_cells: Cells = (64, 64),
    *,
    in_keys: Entries = OBSERVATION,
    activation: Activation = nn.ELU,
    input_scale: Scale | Sequence[Scale] = 1.0,
    action_init: Tensor | None = None,
    scale_init: ScaleInit = 0.1,
    learn_scale: bool = True,
    noise_correlation: Below1 = 0.0,
    return_log_prob: bool = False,
    recurrent: bool = False,
    hidden_size: Width = 64,
) -> ProbabilisticActor:
    """A tanh-Gaussian policy a = tanh(mu(s) + sigma(s) noise), stretched to the bounds of the action.

    The weights of its last layer start near zero: the first actions are close to ``action_init``. It writes ``loc``,
    ``scale`` and ``action``.

    Args:
        env: any TorchRL environment, for the sizes of its entries, the action's bounds, device and floating-point type.
        num_cells: the width of every hidden layer, in a list: [64, 64], or [64] for a single layer.
        in_keys: the entries that are concatenated into the network's input, each (*, k), in a list: ["observation"].
        activation: of the hidden layers; smooth ones give smooth policy gradients.
        input_scale: the input is multiplied by this; a number, or one for each of ``in_keys``. What the tasks observe
            is of one to ten; entries of the state may be far larger.
        action_init: the mean action at the start, (k), strictly between the bounds. By default ``env.neutral_action``
            (see :mod:`torchrl_quad.data`; a drone's is to hover), or the middle of the range.
        scale_init: the standard deviation of the policy's noise at the start, before the tanh, in units of half the
            range. Training brings it down to 0.01 at least, or to a tenth of this.
        learn_scale: whether this noise changes with the state and in training. Otherwise neither a gradient through the
            simulator nor a KL bound takes the exploration away.
        noise_correlation: of the policy's noise in two consecutive steps; 0 is white noise, which averages out; try 0.9
            at 50 Hz. Then loc, scale and the log-probability are those of the action given ``noise_before``, that of
            the step before; ``noise`` is that of the step.
        return_log_prob: whether it also writes the log-probability of the action, which an entropy bonus and PPO need.
            mu then stays between -5 and 5: further out, rounding of the action determines the log-probability.
        recurrent: whether it has a memory: a GRU reads the last hidden layer, and the head reads both. See
            :func:`make_visual_actor` for the entries that this adds.
        hidden_size: numbers in that memory.

    Raises:
        ValueError: the action has no bounds, or more than one dimension; an entry is unknown, or has more than one; or
            the first action is not strictly inside the bounds.
    """
    head = action_init, scale_init, learn_scale, noise_correlation, return_log_prob
    if recurrent:
        if not num_cells:
            raise UserValueError("A memory reads the last hidden layer: give num_cells at least one, such as [64].")
        trunk = network_of(env, in_keys, num_cells[-1], num_cells[:-1], activation, input_scale)
        return _composed(env, "make_actor", Features(None, trunk, activation()), in_keys, hidden_size, *head)
    spec, first = first_action(env, action_init, "make_actor")
    size = 2 * len(first) if learn_scale else len(first)
    net = network_of(env, in_keys, size, num_cells, activation, input_scale)
    options = scale_init, noise_correlation, return_log_prob
    return policy_of(TanhGaussianActor, [], net, in_keys, spec, first, *options)


@checked
def make_visual_actor(
    env: EnvBase,
    num_cells: Annotated[Cells, Field(min_length=1)] = (64,),
    *,
    in_keys: Entries = OBSERVATION,
    image_key: Entry = "depth",
    channels: Annotated[Sequence[Annotated[int, Field(ge=1, le=4096)]], Field(min_length=1, max_length=8)] = (8, 16),
    recurrent: bool = True,
    hidden_size: Width = 64,
    activation: Activation = nn.ELU,
    input_scale: Scale | Sequence[Scale] = 1.0,
    action_init: Tensor | None = None,
    scale_init: ScaleInit = 0.1,
    learn_scale: bool = True,
    noise_correlation: Below1 = 0.0,
    return_log_prob: bool = False,
) -> ProbabilisticActor:
    """A tanh-Gaussian policy of a depth image and vectors, with memory or without.

    TorchRL's ConvNet reads the inverse of the depth, 1 / max(depth, 0.3 m), which weights near depths most. A
    multi-layer perceptron reads its features and the vectors; its output goes to TorchRL's GRUModule, and both outputs
    to the head.

    The policy of a recurrent network also reads ``recurrent_state`` (*, 1, hidden_size) and ``is_init`` (*, 1), and
    writes ``("next", "recurrent_state")``. Environments of this package that fly without transforms hand the memory on,
    with its graph, and clear it at the start of an episode. Others need TorchRL's transforms:

    .. code-block:: python

        env = TransformedEnv(env, Compose(InitTracker(), actor.make_tensordict_primer()))

    Args:
        env: any TorchRL environment with an image, for the sizes of its entries.
        num_cells: the width of every layer between the convolutions and the memory, or the head, in a list: [64].
        in_keys: the vectors that it reads, each (*, k), in a list: ["observation"].
        image_key: the entry of the image, (*, channels, height, width) [m].
        channels: of the convolutions, each 3 x 3, which halve height and width, in a list: [8, 16].
        recurrent: whether it has a memory.
        hidden_size: numbers in that memory.
        activation: of convolutions and hidden layers.
        input_scale: the vectors are multiplied by this; a number, or one for each of ``in_keys``.
        action_init, scale_init, learn_scale, noise_correlation, return_log_prob: as for ``make_actor``.

    Raises:
        ValueError: the environment has no such image; or as for :func:`~torchrl_quad.make_actor`.
    """
    check_env(env)
    known = dict(observed(env).items(True, True))
    if image_key not in known or known[image_key].ndim != env.ndim + 3:
        raise UserValueError(
            f"make_visual_actor reads an image (channels, height, width) from {image_key!r}, and the environment has "
            f'none there. Give it a camera, camera={{"width": 16, "height": 12}}, or choose image_key from: '
            f"{', '.join(map(str, known))}."
        )
    image = known[image_key]
    convolutions = ConvNet(
        in_features=image.shape[-3],
        num_cells=list(channels),
        kernel_sizes=3,
        strides=2,
        paddings=1,
        depth=len(channels),
        activation_class=activation,
        device=env.device,
    ).to(image.dtype)
    seen = convolutions(image.zero()).shape[-1]
    trunk = network_of(env, in_keys, num_cells[-1], num_cells[:-1], activation, input_scale, more=seen)
    features, head = Features(convolutions, trunk, activation()), (action_init, scale_init, learn_scale)
    keys, size = [image_key, *in_keys], hidden_size if recurrent else 0
    return _composed(env, "make_visual_actor", features, keys, size, *head, noise_correlation, return_log_prob)


def _composed(
    env: EnvBase,
    name: str,
    features: Features,
    in_keys: Sequence[NestedKey],
    hidden_size: int,
    action_init: Tensor | None,
    scale_init: float,
    learn_scale: bool,
    noise_correlation: float,
    return_log_prob: bool,
) -> ComposedActor:
    """A policy of features, a memory if it has a size, and a head."""
    spec, first = first_action(env, action_init, name)
    width, dtype = cast(nn.Linear, features.trunk.mlp[-1]).out_features, next(features.parameters()).dtype
    parts: list[Any] = [TensorDictModule(features, in_keys=list(in_keys), out_keys=["features"])]
    widths = [width]
    if hidden_size:
        memory = GRUModule(
            input_size=width,
            hidden_size=hidden_size,
            python_based=True,
            device=env.device,
            in_keys=["features", MEMORY],
            out_keys=["recalled", ("next", MEMORY)],
        ).to(dtype)
        parts.append(memory)
        widths.append(hidden_size)
    size = 2 * len(first) if learn_scale else len(first)
    last = Network(MLP(sum(widths), size, num_cells=[], device=env.device).to(dtype), [1.0] * len(widths), widths)
    read, options = ["features", "recalled"][: len(widths)], (scale_init, noise_correlation, return_log_prob)
    return policy_of(ComposedActor, parts, last, read, spec, first, *options)


class Features(nn.Module):
    """Features (*, k) of vectors, and of an image where there are convolutions, whose output the trunk reads, too."""

    def __init__(self, convolutions: ConvNet | None, trunk: Network, activation: nn.Module) -> None:
        super().__init__()
        self.convolutions, self.trunk, self.activation = convolutions, trunk, activation

    def forward(self, *inputs: Tensor) -> Tensor:
        """The features of a depth image (*, channels, height, width) [m], unless blind, and of vectors (*, k_i)."""
        if self.convolutions is not None:
            depth, *vectors = inputs
            inputs = self.convolutions(depth.clamp_min(NEAREST).reciprocal()), *vectors
        return self.activation(self.trunk(*inputs))


class Parts(NamedTuple):
    """What a policy with eyes or memory is made of, in the order in which it computes."""

    convolutions: list[nn.Module]  #: each followed by its activation; none if it is blind
    nearest: float  #: [m]; they read 1 / max(depth, nearest)
    trunk: list[nn.Module]  #: linear layers, each followed by its activation; the first reads images, then vectors
    widths: tuple[int, ...]  #: of the output of the convolutions, and of the vectors
    scales: tuple[float, ...]  #: by which these are multiplied
    memory: GRU | None  #: reads what the trunk returns
    head: nn.Linear  #: reads what trunk and memory return; its first outputs are the mean action before the tanh
    size: int  #: of the action
    max_loc: float  #: the largest mean action before the tanh


class ComposedActor(TanhGaussianActor):
    """A policy with eyes or memory, as :func:`make_visual_actor` and :func:`make_actor` build it."""

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        """Write loc, scale and action, the memory, correlated noise, and the log-probability if wanted."""
        if "is_init" in self.in_keys and "is_init" not in tensordict:
            raise UserValueError(
                "A policy with memory reads 'is_init', which says where episodes begin. Fly an environment without "
                "transforms by differentiable_rollout, or give it TorchRL's: "
                "TransformedEnv(env, Compose(InitTracker(), actor.make_tensordict_primer()))."
            )
        return super().forward(tensordict, **kwargs)

    def plain(self) -> PlainParts | None:
        """The policy as pure functions of its present weights; None if its parts were changed or hooked."""
        parts = self.parts()
        return None if parts is None else PlainParts(self, parts)

    def replayed(self) -> Replay | None:
        """The policy as losses let it act again in a whole rollout, or None if it explores in another way."""
        return None if self.is_random is None else Replay(self)

    def parts(self) -> Parts | None:
        """The parts as they were built; None if they were changed or hooked."""
        if layout(self) != self.built or self.is_random is None:
            return None
        first, *memory, last = cast(Any, self[0].module)
        features, head = first.module, last.module.head
        if not features.trunk.is_plain or not is_pointwise(features.activation):
            return None
        return Parts(
            list(features.convolutions)[:-1] if features.convolutions else [],
            NEAREST,
            [*features.trunk.mlp, features.activation],
            features.trunk.widths,
            features.trunk.scales,
            memory[0].gru if memory else None,
            last.module.mlp[0],
            head.size,
            head.max_loc,
        )

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """TorchRL's transform that gives an environment the memory of this policy, in its precision."""
        for part in self.modules():
            if isinstance(part, GRUModule):
                weight = cast(Tensor, part.gru.weight_hh_l0)
                spec = Unbounded(torch.Size((1, weight.shape[-1])), dtype=weight.dtype, device=weight.device)
                return TensorDictPrimer({MEMORY: spec}, expand_specs=True)
        raise UserValueError("This policy has no memory: it was built with recurrent=False, and needs no primer.")


class PlainParts(PlainTanhGaussian):
    """A policy with eyes, with memory or with both on plain tensors; see the engine's ``PlainPolicy``.

    The image has no gradient where ``without_gradient`` names it.
    """

    def __init__(self, actor: ComposedActor, parts: Parts) -> None:
        first, *_ = cast(Any, actor[0].module)
        self.is_random, self.scales, self.widths = actor.is_random, parts.scales, parts.widths
        self.lenses, self.activations, self.nearest = parts.convolutions[1::2], parts.trunk[1::2], parts.nearest
        self.sees, gru = bool(parts.convolutions), cast(Any, parts.memory)
        self.memory = {MEMORY: (1, gru.hidden_size)} if gru else {}
        self.in_keys, self.out_keys = [*map(unravel_key, first.in_keys), *self.memory], list(actor.out_keys)
        self._take_head(actor)
        before = [(x.weight, x.bias) for x in cast(Any, [*parts.convolutions[::2], *parts.trunk[::2]])]
        gates = [(gru.weight_ih_l0, gru.bias_ih_l0), (gru.weight_hh_l0, gru.bias_hh_l0)] if gru else []
        self.weights = tuple(x for pair in (*before, *gates, (parts.head.weight, parts.head.bias)) for x in pair)

    @functools.cached_property
    def signature(self) -> Hashable:
        """What it computes."""
        return (*self._describe(), str((self.lenses, self.activations, self.nearest, list(self.memory))))

    def fits(self, inputs: Sequence[Tensor]) -> bool:
        """Whether the network can read inputs of this width, precision and device."""
        like, vectors = self.weights[0], inputs[self.sees : len(inputs) - len(self.memory)]
        fits = [x.shape[-1] for x in vectors] == list(self.widths[self.sees :])
        return fits and all((x.dtype, x.device) == (like.dtype, like.device) for x in inputs)

    def forward(
        self, weights: Sequence[Tensor], inputs: Sequence[Tensor], drawn: Tensor
    ) -> tuple[list[Tensor], dict[NestedKey, Tensor]]:
        """What was seen, and what each layer returns before its activation; and all that the policy writes."""
        seen, layers = self._see(weights, inputs), self._layers_of(weights)
        x, kept = self._read(inputs, seen), []
        for (weight, bias), activation in zip(layers, self.activations, strict=False):
            kept.append(torch.addmm(bias, x, weight.t()))
            x = activation(kept[-1])
        written: dict[NestedKey, Tensor] = {}
        if self.memory:
            h = inputs[-1].squeeze(-2)
            gates, new, own_new = gates_of(torch.addmm(layers[-3][1], x, layers[-3][0].t()), h, *layers[-2])
            kept += [gates, new, own_new]
            recalled = recalled_by(gates, new, h)
            written["next", MEMORY] = recalled.unsqueeze(-2)
            x = torch.cat((x, recalled), 1)
        kept.append(torch.addmm(layers[-1][1], x, layers[-1][0].t()))
        written |= self._sample(kept[-1], drawn)
        return [*seen, *kept], {key: written[key] for key in self.out_keys}

    def adjoint(
        self,
        weights: Sequence[Tensor],
        inputs: Sequence[Tensor],
        kept: Sequence[Tensor],
        drawn: Tensor,
        grads: dict[NestedKey, Tensor],
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """What each layer read, and the gradient of what it returned; the gradients of inputs and noise."""
        layers, seen, kept = self._layers_of(weights), kept[: self.sees], kept[self.sees :]
        own = {key: grads[key] for key in self.out_keys if key != ("next", MEMORY)}
        grad, grad_drawn = vjp(self._sample, kept[-1], drawn)[1](own)
        activated = [vjp(activation, x)[:2] for activation, x in zip(self.activations, kept, strict=False)]
        x, of_x = activated[-1][0], grad @ layers[-1][0]
        read, of_kept, of_inputs = [x], [grad], []
        if self.memory:
            h, (gates, new, own_new) = inputs[-1].squeeze(-2), kept[-4:-1]
            of_x, of_recalled = of_x.split([x.shape[1], h.shape[1]], 1)
            of_recalled = of_recalled + grads["next", MEMORY].squeeze(-2)
            of_gates, of_own_new, of_h = gradient_before(of_recalled, h, gates, new, own_new, layers[-2][0])
            read, of_kept = [x, h, recalled_by(gates, new, h)], [of_gates, of_own_new, grad]
            of_x = of_x + of_gates @ layers[-3][0]
            of_inputs = [of_h.unsqueeze(-2)]
        before = [self._read(inputs, seen), *(x for x, _ in activated)]
        for i in reversed(range(len(activated))):
            (grad,) = activated[i][1](of_x)
            read, of_kept, of_x = [before[i], *read], [grad, *of_kept], grad @ layers[i][0]
        of_read = [g * scale for g, scale in zip(of_x.split(list(self.widths), 1), self.scales, strict=True)]
        if not self.sees:
            return [*read, *of_kept], [*of_read, *of_inputs], grad_drawn
        image, of_seen = inputs[0], of_read[0]
        of_read[0] = torch.zeros_like(image)
        if self.in_keys[0] not in self.without_gradient:
            (of_read[0],) = vjp(lambda image: self._see(weights, [image])[0], image)[1](of_seen)
        return [image, of_seen, *read, *of_kept], [*of_read, *of_inputs], grad_drawn

    def recall(self, tensordict: TensorDictBase, horizon: int) -> tuple[Tensor, Tensor]:
        """loc and scale (n horizon, k) in the states of a rollout, with gradients in the weights alone."""
        keys = [*self.in_keys, *(["is_init"] if self.memory else []), *(["noise_before"] if self.rho else [])]
        entries = {key: leaf(tensordict, key).detach().flatten(0, tensordict.ndim - 1) for key in keys}
        inputs, layers = [entries[key] for key in self.in_keys], self._layers_of(self.weights)
        x = self._read(inputs, self._see(self.weights, inputs))
        for (weight, bias), activation in zip(layers, self.activations, strict=False):
            x = activation(torch.addmm(bias, x, weight.t()))
        if self.memory:
            read = torch.addmm(layers[-3][1], x, layers[-3][0].t())
            read, lasts = (y.unflatten(0, (-1, horizon)).transpose(0, 1) for y in (read, ~entries["is_init"]))
            start = inputs[-1].squeeze(-2).unflatten(0, (-1, horizon))[:, 0]
            recalled = Recall.apply(read, start, lasts.to(read), *layers[-2])
            x = torch.cat((x, cast(Tensor, recalled).transpose(0, 1).flatten(0, 1)), 1)
        raw = torch.addmm(layers[-1][1], x, layers[-1][0].t())
        return self.head(raw, *(entries[key] for key in keys if key == "noise_before"))

    def weight_gradient(self, weights: Sequence[Tensor], traces: Sequence[Tensor]) -> list[Tensor]:
        """The gradients of all weights, over a batch."""
        seen: tuple[Tensor, ...] = ()
        if self.sees:
            (image, of_seen, *traces), count = traces, 2 * len(self.lenses)
            seen = vjp(lambda *own: self._see(own, [image])[0], *weights[:count])[1](of_seen)
        found = super().weight_gradient(weights, traces)
        if self.memory:  # whose own layer has the first gradients of the other's, and whose head reads x as well
            x, h = traces[len(traces) // 2 - 3 :][:2]
            of_gates, _, grad = traces[-3:]
            size, (of_bias, own, own_bias, head, bias) = 2 * h.shape[1], found[-5:]
            own = torch.cat((of_gates[:, :size].t() @ h, own))
            found[-4:] = own, torch.cat((of_bias[:size], own_bias)), torch.cat((grad.t() @ x, head), 1), bias
        return [*seen, *found]

    def _layers_of(self, weights: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
        """Weight and bias of each layer after the convolutions."""
        own = weights[2 * len(self.lenses) :]
        return list(zip(own[::2], own[1::2], strict=True))

    def _see(self, weights: Sequence[Tensor], inputs: Sequence[Tensor]) -> list[Tensor]:
        """What the convolutions return of a depth image (n, channels, height, width) [m], (n, k); nothing if blind."""
        if not self.sees:
            return []
        x = inputs[0].clamp_min(self.nearest).reciprocal()
        for weight, bias, activation in zip(weights[::2], weights[1::2], self.lenses, strict=False):
            x = activation(nn.functional.conv2d(x, weight, bias, stride=2, padding=1))
        return [x.flatten(1)]

    def _read(self, inputs: Sequence[Tensor], seen: Sequence[Tensor]) -> Tensor:
        """What the first layer reads."""
        return concatenated([*seen, *inputs[self.sees : len(inputs) - len(self.memory)]], self.scales)


class Replay(PlainTanhGaussian):
    """A policy with eyes or memory in the states of a rollout that it flew, in which its memory is built up again."""

    def __init__(self, actor: ComposedActor) -> None:
        self.actor = actor
        self._take_head(actor)

    def distribution(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """loc and scale in the states of a rollout (*, horizon), with gradients in the weights alone.

        Single steps (n) that are no rollout are each remembered as they were flown.
        """
        has_time = tensordict.ndim > 1 or tensordict.names[-1] == "time"
        if (plain := self.actor.plain()) is not None and not torch._C._are_functorch_transforms_active():
            loc, scale = plain.recall(tensordict, tensordict.shape[-1] if has_time else 1)
            return loc.view(*tensordict.shape, -1), scale.view(*tensordict.shape, -1)
        with set_recurrent_mode(has_time):
            read = cast(TensorDictBase, self.actor.get_dist_params(tensordict.select(*self.actor.in_keys).detach()))
        return leaf(read, "loc"), leaf(read, "scale")

    def replay(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """What it writes in the states of a rollout (*, horizon), with the noise of the rollout."""
        noise = self.drawn_again(tensordict)[:, : self.size].view_as(leaf(tensordict, "action"))
        return self.squash(*self.distribution(tensordict), noise, self.log_prob_key)
