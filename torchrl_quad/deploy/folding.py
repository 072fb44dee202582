"""Take a policy apart: its weights as plain numbers, with the normaliser and the scales of the input in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad.data import ObservationNormalizer
from torchrl_quad.data.transforms import PolicyUnder
from torchrl_quad.deploy.network import ACTIVATIONS, Layer, Memory, Network
from torchrl_quad.errors import UserValueError


def fold(
    actor: TensorDictModuleBase, normalizer: ObservationNormalizer | None = None, image: Sequence[int] | None = None
) -> Network:
    """The network of a policy's mean action, in float32, with the normaliser and the input's scale in its weights.

    ``image`` is the height and width of the camera's image, where there is a camera. ValueError for a policy that
    another function has built, or that reads what a drone cannot give it.
    """
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        make = None if isinstance(actor, PolicyUnder) else getattr(actor, "plain", None)
        plain: Any = make() if callable(make) else None
    if not hasattr(plain, "lenses"):  # what somebody else has written may have a plain form, too
        raise UserValueError(
            "export_policy exports what make_actor and make_visual_actor build, with its parts unchanged and without "
            f"hooks: tanh-Gaussian policies. This {type(actor).__name__} is something else; build the policy with "
            "make_actor(env, ...) or make_visual_actor(env, ...), and load your weights into it."
        )
    read = [key for key in plain.in_keys if key not in plain.memory]
    if read != ["depth"] * plain.sees + ["observation"]:
        raise UserValueError(
            f'export_policy: the policy reads {read}. A drone only has the "observation": train it with '
            'in_keys=[\'observation\']. A visual policy may also read "depth", with image_key="depth".'
        )
    if plain.low is not None:
        raise UserValueError(f"export_policy: actions must lie from -1 to 1, got {plain.low} to {plain.high}.")
    pairs, eyes = [*zip(plain.weights[::2], plain.weights[1::2], strict=True)], len(plain.lenses)
    activations = [*plain.lenses, *plain.activations]
    memory = None
    if plain.memory:  # between the first two layers
        memory = Memory(*(_numbers(x).astype(np.float32) for pair in pairs[eyes + 1 : eyes + 3] for x in pair))
        del pairs[eyes + 1 : eyes + 3]
    layers = [_layer(*pair, x) for pair, x in zip(pairs, [*activations, nn.Tanh()], strict=True)]
    layers[eyes] = _reading(layers[eyes], np.repeat(plain.scales, plain.widths), normalizer)
    last = layers[-1]
    layers[-1] = last._replace(weight=last.weight[: plain.size], bias=last.bias[: plain.size])  # the rest is noise's
    layers = [Layer(weight.astype(np.float32), bias.astype(np.float32), x) for weight, bias, x in layers]
    height, width = image or (0, 0)
    network = Network(layers[eyes:], layers[:eyes], (height, width), plain.nearest, memory, plain.head.max_loc)
    if eyes and (image is None or network.features != plain.widths[0] or layers[0].weight.shape[1] != 1):
        camera = "has no camera" if image is None else f"shows it {image[1]} x {image[0]} pixels"
        raise UserValueError(f"export_policy: the policy is for images of another size; the environment {camera}.")
    if not all(np.isfinite(x).all() for x in network.weights()):
        raise UserValueError("export_policy: the weights of the policy, or its normaliser, are not finite.")
    return network


def _layer(weight: Tensor, bias: Tensor, activation: nn.Module) -> Layer:
    """A layer of a policy, in float64."""
    name = type(activation).__name__
    if name not in ACTIVATIONS or repr(activation) != repr(type(activation)()):
        raise UserValueError(
            f"export_policy cannot write {activation} as ONNX and C. Choose from: {', '.join(ACTIVATIONS)}, with their "
            "default arguments."
        )
    return Layer(_numbers(weight), _numbers(bias), name)


def _reading(layer: Layer, columns: NDArray[Any], normalizer: ObservationNormalizer | None) -> Layer:
    """A layer that reads its inputs times ``columns``, of which the last are normalised."""
    weight: Any = layer.weight * columns
    bias: Any = layer.bias
    if normalizer is not None:
        loc, scale = _numbers(normalizer.loc), _numbers(normalizer.scale)
        others, own = np.split(weight, [-len(loc)], 1)
        own = own / scale
        weight, bias = np.concatenate((others, own), 1), bias - own @ loc
    return layer._replace(weight=weight, bias=bias)


def _numbers(x: Tensor) -> NDArray[Any]:
    return x.detach().double().cpu().numpy()
