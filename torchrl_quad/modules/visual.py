"""Visual policies: a convolutional network on depth images, memory in a GRU, and the tanh-Gaussian head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs import EnvBase, TensorDictPrimer
from torchrl.modules import MLP, ConvNet, GRUModule, ProbabilisticActor, set_recurrent_mode
from torchrl.modules.tensordict_module.rnn import GRU

from torchrl_quad.data.unwrap import check_env, leaf, observed
from torchrl_quad.errors import UserValueError
from torchrl_quad.modules.networks import OBSERVATION, Activation, Cells, ScaleInit, first_action, network_of, policy_of
from torchrl_quad.modules.plain import Network, PlainTanhGaussian, TanhGaussianActor, is_pointwise, layout
from torchrl_quad.options import Below1, Entries, Entry, Field, Scale, Width, checked

MEMORY = "recurrent_state"
NEAREST = 0.3  # [m]; closer depths are clamped


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
    spec, first = first_action(env, action_init, "make_visual_actor")
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
    features = VisualFeatures(convolutions, trunk, activation())
    parts: list[Any] = [TensorDictModule(features, in_keys=[image_key, *in_keys], out_keys=["features"])]
    widths = [num_cells[-1]]
    if recurrent:
        memory = GRUModule(
            input_size=num_cells[-1],
            hidden_size=hidden_size,
            python_based=True,
            device=env.device,
            in_keys=["features", MEMORY],
            out_keys=["recalled", ("next", MEMORY)],
        ).to(image.dtype)
        parts.append(memory)
        widths.append(hidden_size)
    size = 2 * len(first) if learn_scale else len(first)
    last = Network(MLP(sum(widths), size, num_cells=[], device=env.device).to(image.dtype), [1.0] * len(widths), widths)
    read, options = ["features", "recalled"][: len(widths)], (scale_init, noise_correlation, return_log_prob)
    return policy_of(VisualActor, parts, last, read, spec, first, *options)


class VisualFeatures(nn.Module):
    """Features (*, k) of an image and of vectors: convolutions, and a trunk that reads their output and the vectors."""

    def __init__(self, convolutions: ConvNet, trunk: Network, activation: nn.Module) -> None:
        super().__init__()
        self.convolutions, self.trunk, self.activation = convolutions, trunk, activation

    def forward(self, depth: Tensor, *vectors: Tensor) -> Tensor:
        """The features of a depth image (*, channels, height, width) [m] and of vectors (*, k_i)."""
        return self.activation(self.trunk(self.convolutions(depth.clamp_min(NEAREST).reciprocal()), *vectors))


class Parts(NamedTuple):
    """What a visual policy is made of, in the order in which it computes."""

    convolutions: list[nn.Module]  #: each followed by its activation
    nearest: float  #: [m]; they read 1 / max(depth, nearest)
    trunk: list[nn.Module]  #: linear layers, each followed by its activation; the first reads images, then vectors
    widths: tuple[int, ...]  #: of the output of the convolutions, and of the vectors
    scales: tuple[float, ...]  #: by which these are multiplied
    memory: GRU | None  #: reads what the trunk returns
    head: nn.Linear  #: reads what trunk and memory return; its first outputs are the mean action before the tanh
    size: int  #: of the action
    max_loc: float  #: the largest mean action before the tanh


class VisualActor(TanhGaussianActor):
    """What :func:`~torchrl_quad.make_visual_actor` builds."""

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

    def replayed(self) -> Replay | None:
        """The policy as losses let it act again in a whole rollout, or None if it explores in another way."""
        return None if self.is_random is None else Replay(self)

    def parts(self) -> Parts | None:
        """The parts as :func:`~torchrl_quad.make_visual_actor` builds them; None if they were changed or hooked."""
        if layout(self) != self.built or self.is_random is None:
            return None
        first, *memory, last = cast(Any, self[0].module)
        features, head = first.module, last.module.head
        if not features.trunk.is_plain or not is_pointwise(features.activation):
            return None
        return Parts(
            list(features.convolutions)[:-1],
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


class Replay(PlainTanhGaussian):
    """A visual policy in the states of a rollout that it has flown, in which its memory is built up again."""

    def __init__(self, actor: VisualActor) -> None:
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
