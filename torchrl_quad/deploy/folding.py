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
    *layers, last = zip(plain.weights[::2], plain.weights[1::2], strict=True)
    activations, count = [*plain.lenses, *plain.activations], len(plain.lenses)
    activated = [(*layer, activation) for layer, activation in zip(layers, activations, strict=False)]
    seen = _layers(activated[:count]) if plain.sees else []
    memory = Memory(*(_numbers(x).astype(np.float32) for x in plain.weights[-6:-2])) if plain.memory else None
    height, width = image or (0, 0)
    network = Network([], seen, (height, width), plain.nearest, memory, plain.head.max_loc)
    if seen and (image is None or network.features != plain.widths[0] or seen[0].weight.shape[1] != 1):
        camera = "has no camera" if image is None else f"shows it {image[1]} x {image[0]} pixels"
        raise UserValueError(f"export_policy: the policy is for images of another size; the environment {camera}.")
    columns, own = np.repeat(plain.scales, plain.widths), [*activated[count:], (*last, nn.Tanh())]
    network = network._replace(layers=_layers(own, plain.size, columns, normalizer))
    if not all(np.isfinite(x).all() for x in network.weights()):
        raise UserValueError("export_policy: the weights of the policy, or its normaliser, are not finite.")
    return network


def _layers(
    parts: Any,
    size: int | None = None,
    columns: NDArray[np.float64] | None = None,
    normalizer: ObservationNormalizer | None = None,
) -> list[Layer]:
    """Layers from weights, biases and activations: the first one's inputs times ``columns``, of which the last are
    normalised, and of the last one's outputs the first ``size``, or all."""
    weights, biases, activations = zip(*parts, strict=True)
    for activation in activations:
        if type(activation).__name__ not in ACTIVATIONS or repr(activation) != repr(type(activation)()):
            raise UserValueError(
                f"export_policy cannot write {activation} as ONNX and C. Choose from: {', '.join(ACTIVATIONS)}, with "
                "their default arguments."
            )
    weights, biases = ([_numbers(x) for x in values] for values in (weights, biases))
    if columns is not None:
        weights[0] = weights[0] * columns
    if normalizer is not None:
        loc, scale = _numbers(normalizer.loc), _numbers(normalizer.scale)
        others, own = np.split(weights[0], [-len(loc)], 1)
        own = own / scale
        weights[0], biases[0] = np.concatenate((others, own), 1), biases[0] - own @ loc
    weights[-1], biases[-1] = weights[-1][:size], biases[-1][:size]  # the rest is the noise's
    names = [type(activation).__name__ for activation in activations]
    weights, biases = ([x.astype(np.float32) for x in values] for values in (weights, biases))
    return [Layer(*parts) for parts in zip(weights, biases, names, strict=True)]


def _numbers(x: Tensor) -> NDArray[np.float64]:
    return x.detach().double().cpu().numpy()
