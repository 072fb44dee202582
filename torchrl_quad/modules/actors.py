"""Policies: a tanh-Gaussian head on layers, on memory in a GRU, and on convolutions of depth images."""

from __future__ import annotations

from collections.abc import Sequence
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
from torchrl_quad.modules.plain import Network, PlainTanhGaussian, TanhGaussianActor, concatenated, is_pointwise, layout
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

    Its adjoint computes the network again. Where ``without_gradient`` names the image, it has no gradient, and is then
    convolved only once.
    """

    def __init__(self, actor: ComposedActor, parts: Parts) -> None:
        first, *_ = cast(Any, actor[0].module)
        self.parts, self.is_random, self.scales, self.widths = parts, actor.is_random, parts.scales, parts.widths
        self.sees = bool(parts.convolutions)
        self.memory = {MEMORY: (1, parts.memory.hidden_size)} if parts.memory else {}
        self.in_keys, self.out_keys = [*map(unravel_key, first.in_keys), *self.memory], list(actor.out_keys)
        self.without_gradient: frozenset[NestedKey] = frozenset()
        self._take_head(actor)
        layers: list[Any] = [*parts.convolutions[::2], *parts.trunk[::2], parts.head]
        gru = parts.memory
        remembering = (gru.weight_ih_l0, gru.bias_ih_l0, gru.weight_hh_l0, gru.bias_hh_l0) if gru else ()
        self.weights = (*(x for layer in layers for x in (layer.weight, layer.bias)), *cast(Any, remembering))
        activations = [parts.convolutions[1::2], parts.trunk[1::2]]
        self.signature = (*self._describe(), str((activations, parts.nearest, self.sees, list(self.memory))))

    def fits(self, inputs: Sequence[Tensor]) -> bool:
        """Whether the network can read inputs of this width, precision and device."""
        like = self.weights[0]
        vectors = inputs[self.sees : len(inputs) - len(self.memory)]
        fits = [x.shape[-1] for x in vectors] == list(self.widths[self.sees :])
        return fits and all((x.dtype, x.device) == (like.dtype, like.device) for x in inputs)

    def forward(
        self, weights: Sequence[Tensor], inputs: Sequence[Tensor], drawn: Tensor
    ) -> tuple[list[Tensor], dict[NestedKey, Tensor]]:
        """What was seen, and loc, scale, action, features, memory, and log-probability if wanted."""
        seen = self._see(weights, inputs)
        raw, features, *recalled = self._network(weights, inputs, seen)
        written = {**self._sample(raw, drawn), "features": features}
        for x in recalled:
            written |= {"recalled": x, ("next", MEMORY): x.unsqueeze(-2)}
        return seen, {key: written[key] for key in self.out_keys}

    def adjoint(
        self,
        weights: Sequence[Tensor],
        inputs: Sequence[Tensor],
        kept: Sequence[Tensor],
        drawn: Tensor,
        grads: dict[NestedKey, Tensor],
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """What the network read, and the gradients of what it returned; the gradients of inputs and noise."""
        is_constant = self.sees and self.in_keys[0] in self.without_gradient
        read = inputs[1:] if is_constant else inputs

        def network(*read: Tensor) -> tuple[Tensor, ...]:
            every = [inputs[0], *read] if is_constant else read
            return tuple(self._network(weights, every, kept if is_constant else self._see(weights, every)))

        (raw, *_), pull = vjp(network, *read)[:2]
        own = {key: grads[key] for key in self.out_keys if key not in ("features", "recalled", ("next", MEMORY))}
        grad_raw, grad_drawn = vjp(self._sample, raw, drawn)[1](own)
        grads_out = [grad_raw, grads["features"]]
        if self.memory:
            grads_out.append(grads["recalled"] + grads["next", MEMORY].squeeze(-2))
        of_read = list(pull(tuple(grads_out)))
        of_inputs = [torch.zeros_like(inputs[0]), *of_read] if is_constant else of_read
        return [*inputs, *grads_out], of_inputs, grad_drawn

    def weight_gradient(self, weights: Sequence[Tensor], traces: Sequence[Tensor]) -> list[Tensor]:
        """The gradients of all weights, over a batch."""
        inputs, grads = traces[: len(self.in_keys)], traces[len(self.in_keys) :]
        _, pull = vjp(lambda *own: tuple(self._network(own, inputs, self._see(own, inputs))), *weights)[:2]
        return list(pull(tuple(grads)))

    def _see(self, weights: Sequence[Tensor], inputs: Sequence[Tensor]) -> list[Tensor]:
        """What the convolutions return of a depth image (n, channels, height, width) [m], (n, k); nothing if blind."""
        if not self.sees:
            return []
        x, layers = inputs[0].clamp_min(self.parts.nearest).reciprocal(), self.parts.convolutions
        for i, activation in enumerate(layers[1::2]):
            x = activation(nn.functional.conv2d(x, weights[2 * i], weights[2 * i + 1], stride=2, padding=1))
        return [x.flatten(1)]

    def _network(self, weights: Sequence[Tensor], inputs: Sequence[Tensor], seen: Sequence[Tensor]) -> list[Tensor]:
        """What the head returns, the features, and what is recalled (n, hidden_size)."""
        weights = weights[len(self.parts.convolutions) :]
        vectors = inputs[self.sees : len(inputs) - len(self.memory)]
        x = concatenated([*seen, *vectors], self.scales)
        layers = len(self.parts.trunk) // 2
        for i, activation in enumerate(self.parts.trunk[1::2]):
            x = activation(torch.addmm(weights[2 * i + 1], x, weights[2 * i].t()))
        head, bias, *gru = weights[2 * layers :]
        if not self.memory:
            return [torch.addmm(bias, x, head.t()), x]
        h = inputs[-1].squeeze(-2)
        of_x, of_h = torch.addmm(gru[1], x, gru[0].t()).chunk(3, 1), torch.addmm(gru[3], h, gru[2].t()).chunk(3, 1)
        reset, keep = (of_x[0] + of_h[0]).sigmoid(), (of_x[1] + of_h[1]).sigmoid()
        new = (of_x[2] + reset * of_h[2]).tanh()
        recalled = new + keep * (h - new)
        return [torch.addmm(bias, torch.cat((x, recalled), 1), head.t()), x, recalled]


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
        with set_recurrent_mode(has_time):
            read = cast(TensorDictBase, self.actor.get_dist_params(tensordict.select(*self.actor.in_keys).detach()))
        return leaf(read, "loc"), leaf(read, "scale")

    def replay(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """What it writes in the states of a rollout (*, horizon), with the noise of the rollout."""
        noise = self.drawn_again(tensordict)[:, : self.size].view_as(leaf(tensordict, "action"))
        return self.squash(*self.distribution(tensordict), noise, self.log_prob_key)
