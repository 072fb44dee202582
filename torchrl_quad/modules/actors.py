"""Policies: a tanh-Gaussian head on layers, on memory in a GRU, and on convolutions of depth images."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs import EnvBase, TensorDictPrimer
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import MLP, ConvNet, GRUModule, ProbabilisticActor, TanhNormal, set_recurrent_mode

from torchrl_quad.data.unwrap import check_env, leaf, observed
from torchrl_quad.errors import UserValueError
from torchrl_quad.modules.networks import OBSERVATION, Activation, Cells, ScaleInit, first_action, network_of
from torchrl_quad.modules.plain import (
    MEMORY,
    NEAREST,
    GaussianHead,
    Network,
    PlainTanhGaussian,
    is_pointwise,
    layout,
    tanh_gaussian,
)
from torchrl_quad.options import Below1, Entries, Entry, Field, Scale, Width, checked


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
        num_cells: the width of every hidden layer, in a list: [64, 64], or [64] for a single layer. A memory reads the
            first one; the second one, or the head, reads both. Two layers let a policy change its gains by what it
            remembers, as it must to fly any drone.
        in_keys: the entries that are concatenated into the network's input, each (*, k), in a list: ["observation"].
        activation: of the hidden layers; smooth ones give smooth policy gradients.
        input_scale: the input is multiplied by this; a number, or one for each of ``in_keys``. What the tasks observe
            is of one to ten; entries of the state may be far larger.
        action_init: the mean action at the start, (k), strictly between the bounds. By default ``env.neutral_action``
            (see :mod:`torchrl_quad.data`; a drone's is to hover), or the middle of the range.
        scale_init: the standard deviation of the policy's noise at the start, before the tanh, in units of half the
            range. Training cannot bring it below 0.01, or below a tenth of this if that is less.
        learn_scale: whether this noise changes with the state and in training. Otherwise neither a gradient through the
            simulator nor a KL bound takes the exploration away.
        noise_correlation: of the policy's noise in two consecutive steps; 0 is white noise, which averages out; try 0.9
            at 50 Hz. Then loc, scale and the log-probability are those of the action given ``noise_before``, that of
            the step before; ``noise`` is that of the step.
        return_log_prob: whether it also writes the log-probability of the action, which an entropy bonus and PPO need.
            mu then stays between -5 and 5: further out, rounding of the action determines the log-probability.
        recurrent: whether it has a memory, a GRU. See :func:`make_visual_actor` for the entries that this adds.
        hidden_size: numbers in that memory.

    Raises:
        ValueError: the action has no bounds, or more than one dimension; an entry is unknown, or has more than one; or
            the first action is not strictly inside the bounds.
    """
    head = action_init, scale_init, learn_scale, noise_correlation, return_log_prob
    if recurrent:
        if not num_cells:
            raise UserValueError("A memory reads the first hidden layer: give num_cells at least one, such as [64].")
        features = Features(None, network_of(env, in_keys, num_cells[0], [], activation, input_scale), activation())
        more = {"num_cells": list(num_cells[1:]), "activation_class": activation}
        return _composed(env, "make_actor", features, in_keys, hidden_size, more, *head)
    options = num_cells, activation, input_scale
    return _policy(env, "make_actor", [], in_keys, lambda size: network_of(env, in_keys, size, *options), *head)


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
    layer reads its features and the vectors; its output goes to TorchRL's GRUModule, and both outputs to the further
    layers and the head.

    The policy of a recurrent network also reads ``recurrent_state`` (*, 1, hidden_size) and ``is_init`` (*, 1), and
    writes ``("next", "recurrent_state")``. Environments of this package that fly without transforms hand the memory on,
    with its graph, and clear it at the start of an episode. Others need TorchRL's transforms:

    .. code-block:: python

        env = TransformedEnv(env, Compose(InitTracker(), actor.make_tensordict_primer()))

    Args:
        env: any TorchRL environment with an image, for the sizes of its entries.
        num_cells: the width of every hidden layer after the convolutions, in a list: [64]; of several the memory reads
            the first.
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
    trunk = network_of(env, in_keys, num_cells[0], [], activation, input_scale, more=seen)
    features, keys = Features(convolutions, trunk, activation()), [image_key, *in_keys]
    more = {"num_cells": list(num_cells[1:]), "activation_class": activation}
    head = action_init, scale_init, learn_scale, noise_correlation, return_log_prob
    return _composed(env, "make_visual_actor", features, keys, hidden_size if recurrent else 0, more, *head)


def _composed(
    env: EnvBase, name: str, features: Features, in_keys: Sequence[NestedKey], hidden_size: int, more: Any, *head: Any
) -> TanhGaussianActor:
    """A policy of features, a memory if it has a size, further layers, and a head, as :func:`_policy` takes it."""
    width, dtype = cast(nn.Linear, features.trunk.mlp[-1]).out_features, next(features.parameters()).dtype
    parts: list[Any] = [TensorDictModule(features, in_keys=list(in_keys), out_keys=["features"])]
    widths = [width, hidden_size] if hidden_size else [width]
    if hidden_size:
        keys: Any = {"in_keys": ["features", MEMORY], "out_keys": ["recalled", ("next", MEMORY)]}
        memory = GRUModule(width, hidden_size, python_based=True, device=env.device, **keys)
        parts.append(memory.to(dtype))

    def last(size: int) -> Network:
        return Network(MLP(sum(widths), size, device=env.device, **more).to(dtype), [1.0] * len(widths), widths)

    return _policy(env, name, parts, ["features", "recalled"][: len(widths)], last, *head)


def _policy(
    env: EnvBase,
    name: str,
    parts: Sequence[Any],
    in_keys: Sequence[NestedKey],
    make_last: Callable[[int], Network],
    action_init: Tensor | None,
    scale_init: float,
    learn_scale: bool,
    rho: float,
    return_log_prob: bool,
) -> TanhGaussianActor:
    """A tanh-Gaussian policy of some parts and a last network of a given size, which reads ``in_keys``.

    It begins with the action ``action_init``, whatever it reads. Errors are about ``name``.
    """
    spec, first = first_action(env, action_init, name)
    network = make_last(2 * len(first) if learn_scale else len(first))
    layer = cast(nn.Linear, network.mlp[-1])
    with torch.no_grad():
        layer.weight.mul_(0.01)
        layer.bias.zero_()
        layer.bias[: len(first)] = first
    least = min(0.01, 0.1 * scale_init)  # to which training can bring the scale down
    max_loc = 5.0 if return_log_prob else math.inf  # as far as TorchRL's TanhNormal goes with tanh_loc=True
    network.head = GaussianHead(len(first), f"biased_softplus_{scale_init}_{least}", max_loc, rho)
    read = [*in_keys, "noise_before"] if rho else list(in_keys)
    last = TensorDictModule(network, in_keys=read, out_keys=["loc", "scale"])
    low, high = spec.low, spec.high
    # Of what the parts hand on to each other only the memory is kept.
    written = ["loc", "scale", *(key for part in parts for key in part.out_keys if key[0] == "next")]
    actor = (ComposedActor if parts else TanhGaussianActor)(
        TensorDictSequential([*parts, last], selected_out_keys=written) if parts else last,
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs={} if (low == -1).all() and (high == 1).all() else {"low": low, "high": high},
        return_log_prob=return_log_prob,
    )
    if rho:
        actor.out_keys = [*actor.out_keys, "noise_before", "noise"]
    actor.built = layout(actor)
    return actor


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


class TanhGaussianActor(ProbabilisticActor):
    """What :func:`~torchrl_quad.make_actor` builds: a tanh-Gaussian policy that environments can fly as pure functions.

    With noise that is correlated in time it writes ``noise``, which a flight hands on, and ``noise_before``, that of
    the step before. If there is none yet it is drawn. A deterministic flight has none.
    """

    built: list[Any]  # its layout

    @property
    def last(self) -> Network:
        """The network that ends in the head."""
        parts: Any = self[0]
        return cast(Network, (parts[-1] if isinstance(parts, TensorDictSequential) else parts).module)

    @property
    def sampler(self) -> Any:
        """The part that samples."""
        return self[1]

    def scale_noise(self, share: float) -> None:
        """Draw only this share of the noise from now on.

        ``scale`` and the log-probability stay those of the whole noise; copies and checkpoints do not know the share.
        """
        cast(GaussianHead, self.last.head).share = share

    @property
    def is_random(self) -> bool | None:
        """Whether it samples, or takes the mode; None if it is asked for something else."""
        kind = exploration_type() or self.sampler.default_interaction_type
        return {ExplorationType.RANDOM: True, ExplorationType.DETERMINISTIC: False}.get(kind)

    @property
    def log_prob_entry(self) -> NestedKey | None:
        """The entry of the log-probability, if it is wanted."""
        return self.sampler.log_prob_key if self.sampler.return_log_prob else None

    @property
    def bounds(self) -> tuple[Tensor, Tensor] | None:
        """The least and the greatest action, each (k); None for -1 and 1."""
        bounds = self.sampler.distribution_kwargs
        return (bounds["low"], bounds["high"]) if bounds else None

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase, **kwargs: Any) -> TensorDictBase:
        """Write loc, scale and action, the noise if it is correlated, and the log-probability if wanted."""
        head = getattr(self.last, "head", None)
        if not isinstance(head, GaussianHead) or not (head.rho or (head.share != 1.0 and self.is_random)):
            return super().forward(tensordict, **kwargs)
        is_random = self.is_random
        if head.rho:
            before = tensordict.get("noise", None)
            if before is None or not is_random:
                last = cast(nn.Linear, self.last.mlp[-1])
                before = head.draw(last.weight.new_zeros((*tensordict.batch_size, head.size)), is_random)
            tensordict.set("noise_before", before)
            if is_random is None:
                return super().forward(tensordict, **kwargs).set("noise", before)
        # Evaluated for each of the two, which fixes the order in which gradients add up.
        loc, scale = (leaf(self[0](tensordict), key) for key in ("loc", "scale"))
        xi = head.draw(torch.zeros_like(loc.detach()), is_random)
        tensordict.update(tanh_gaussian(loc, scale, xi, self.bounds, self.log_prob_entry))
        return tensordict.set("noise", head.next(leaf(tensordict, "noise_before"), xi)) if head.rho else tensordict

    def plain(self) -> PlainTanhGaussian | None:
        """The policy as pure functions of its present weights; None if its parts were changed or hooked."""
        if type(self) is not TanhGaussianActor or self.is_random is None or layout(self) != self.built:
            return None
        network, keys = self.last, list(self[0].in_keys)
        if len(set(map(str, keys))) < len(keys) or not network.is_plain:  # one that reads an entry twice is called
            return None
        return PlainTanhGaussian(self, keys[: len(network.scales)], network, list(network.mlp))


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

    def plain(self) -> PlainTanhGaussian | None:
        """The policy as pure functions of its present weights; None if its parts were changed or hooked."""
        if layout(self) != self.built or self.is_random is None:
            return None
        first, *memory, _ = cast(Any, self[0].module)
        features = first.module
        if not (features.trunk.is_plain and is_pointwise(features.activation) and self.last.is_plain):
            return None
        layers = [*features.trunk.mlp, features.activation, *self.last.mlp]
        convolutions, gru = list(features.convolutions or ())[:-1], memory[0].gru if memory else None
        return PlainTanhGaussian(self, first.in_keys, features.trunk, layers, convolutions, gru)

    def replayed(self) -> Replay | None:
        """The policy as losses let it act again in a whole rollout, or None if it explores in another way."""
        return None if self.is_random is None else Replay(self)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """TorchRL's transform that gives an environment the memory of this policy, in its precision."""
        for part in self.modules():
            if isinstance(part, GRUModule):
                weight = cast(Tensor, part.gru.weight_hh_l0)
                spec = Unbounded(torch.Size((1, weight.shape[-1])), dtype=weight.dtype, device=weight.device)
                return TensorDictPrimer({MEMORY: spec}, expand_specs=True)
        raise UserValueError("This policy has no memory: it was built with recurrent=False, and needs no primer.")


class Replay(PlainTanhGaussian):
    """A policy with eyes or memory in the states of a rollout that it flew, in which its memory is built up again."""

    def __init__(self, actor: ComposedActor) -> None:
        self.actor = actor
        self._take_head(actor)

    def distribution(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """loc and scale in the states of a rollout (*, horizon), with gradients in the weights alone.

        Single steps (n) that are no rollout are each remembered as they were flown.
        """
        if (plain := self.actor.plain()) is not None and not torch._C._are_functorch_transforms_active():
            return plain.distribution(tensordict)
        has_time = tensordict.ndim > 1 or tensordict.names[-1] == "time"
        with set_recurrent_mode(has_time):
            read = cast(TensorDictBase, self.actor.get_dist_params(tensordict.select(*self.actor.in_keys).detach()))
        return leaf(read, "loc"), leaf(read, "scale")
