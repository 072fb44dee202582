"""Multi-layer perceptrons for policies and critics, sized by an environment's specs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, cast

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.modules import MLP, ValueOperator

from torchrl_quad.data.unwrap import base_env, check_env, observed
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.modules.plain import Network, layout
from torchrl_quad.options import AfterValidator, Entries, Field, Scale, Width, checked

OBSERVATION = ("observation",)
MOST_WEIGHTS = 100_000_000  # of a network


def _pointwise(activation: Any) -> Any:
    try:
        with torch.random.fork_rng(devices=[]):
            fits = issubclass(activation, nn.Module) and activation()(torch.zeros(2, 3)).shape == (2, 3)
    except Exception:  # what is no activation raises anything
        fits = False
    if not fits:
        raise UserValueError("be a class of activations of torch.nn without arguments, such as torch.nn.ELU")
    return activation


Activation = Annotated[Any, AfterValidator(_pointwise)]
Cells = Annotated[Sequence[Width], Field(max_length=64)]
ScaleInit = Annotated[float, Field(ge=1e-4, le=100)]  # TorchRL's mapping to a scale ends at 1e-4


@checked
def make_value(
    env: EnvBase,
    num_cells: Cells = (64, 64),
    *,
    in_keys: Entries = OBSERVATION,
    activation: Activation = nn.ELU,
    input_scale: Scale | Sequence[Scale] = 1.0,
) -> ValueOperator:
    """A state value V(s), written to ``state_value``, (*, 1).

    LayerNorm normalises its hidden layers: without it the gradient of the critic, which the policy follows, is far off.
    A critic may read more than the actor does, such as ``in_keys=("observation", ("state", "rotor_speed"))``. Rotors
    turn at some 1000 rad/s, and ``input_scale=(1.0, 1e-3)`` brings both entries to about one. Among obstacles,
    ``"obstacle"`` (*, 7) is the distance to the nearest [m], the direction away from it in the body frame, and the
    distances in 0.25, 0.5 and 1 s at the present velocity.

    Args:
        env, activation, input_scale, in_keys: as for :func:`~torchrl_quad.make_actor`, and so are the errors.
        num_cells: the width of every hidden layer, in a list: [64, 64], or [64] for a single layer.
    """
    net = network_of(env, in_keys, 1, num_cells, activation, input_scale, layer_norm=True)
    return Critic(net, in_keys)


@checked
def make_qvalue(
    env: EnvBase,
    num_cells: Cells = (64, 64),
    *,
    in_keys: Entries = OBSERVATION,
    activation: Activation = nn.ELU,
    input_scale: Scale | Sequence[Scale] = 1.0,
    action_scale: Scale = 0.3,
) -> ValueOperator:
    """A state-action value Q(s, a), written to ``state_action_value``, (*, 1); otherwise as :func:`make_value`.

    Args:
        env, activation, input_scale, in_keys: as for :func:`~torchrl_quad.make_actor`, and so are the errors.
        num_cells: the width of every hidden layer, in a list: [64, 64], or [64] for a single layer.
        action_scale: the action is multiplied by this. It reveals the state, and a critic that reads the state off it
            gets its gradient in the action wrong: below one it relies on the state first.
    """
    in_keys = [*in_keys, "action"]
    net = network_of(env, in_keys, 1, num_cells, activation, input_scale, action_scale, layer_norm=True)
    return Critic(net, in_keys)


class Critic(ValueOperator):
    """What :func:`~torchrl_quad.make_value` and :func:`~torchrl_quad.make_qvalue` build."""

    def __init__(self, network: Network, in_keys: Sequence[NestedKey]) -> None:
        super().__init__(network, in_keys=list(in_keys))
        self.built = layout(self)

    def plain(self) -> Callable[[Mapping[str, Tensor], Sequence[Tensor]], Tensor] | None:
        """The prediction (*, 1) as a pure function of the parameters, by name, and the inputs, each (*, k).

        None if its parts were changed or hooked.
        """
        network = cast(Network, self.module)
        if layout(self) != self.built or not network.is_plain:
            return None

        def predict(params: Mapping[str, Tensor], inputs: Sequence[Tensor]) -> Tensor:
            x = network.joined(inputs)
            for name, layer in network.mlp.named_children():
                weight, bias = (params.get(f"module.mlp.{name}.{kind}") for kind in ("weight", "bias"))
                if isinstance(layer, nn.LayerNorm):
                    x = nn.functional.layer_norm(x, layer.normalized_shape, weight, bias, layer.eps)
                else:
                    x = layer(x) if weight is None else nn.functional.linear(x, weight, bias)
            return x

        return predict


def first_action(env: EnvBase, action_init: Tensor | None, name: str) -> tuple[Bounded, Tensor]:
    """The spec of one action, and the mean of the first actions before the tanh, (k); errors are about ``name``."""
    check_env(env)
    spec = env.action_spec_unbatched
    if not isinstance(spec, Bounded):
        raise UserValueError(f"{name} needs an action with bounds, a Bounded spec; got {type(spec).__name__}.")
    if len(spec.shape) != 1:
        raise UserValueError(
            f"{name} writes one action (k) for each environment, and here it has shape {tuple(spec.shape)}: leave out "
            "transforms such as MultiAction. To hold each action longer, give the environment control_dt=0.04."
        )
    low, high = spec.low, spec.high
    middle = 0.5 * (low + high)
    if action_init is None:
        action_init = getattr(_single(env), "neutral_action", middle)
        action_init = action_init.mean(0) if action_init.dim() > middle.dim() else action_init
    first = middle
    try:
        first = torch.as_tensor(action_init).to(middle)
        fits = first.shape == spec.shape and bool(((low < first) & (first < high)).all())
    except (TypeError, ValueError, RuntimeError, OverflowError):  # raised for what cannot become a tensor
        fits = False
    if not fits:
        raise UserValueError(
            f"action_init must be {spec.shape[-1]} numbers strictly between {low.tolist()} and {high.tolist()}, got "
            f"{shown(action_init)}."
        )
    return spec, torch.atanh((first - middle) / (0.5 * (high - low)))


def network_of(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    out_features: int,
    num_cells: Sequence[int],
    activation: type[nn.Module],
    input_scale: float | Sequence[float],
    action_scale: float | None = None,
    layer_norm: bool = False,
    more: int = 0,
) -> Network:
    """A network on entries of an environment; before them it reads ``more`` numbers."""
    check_env(env)
    specs = [_spec(env, key) for key in in_keys]
    own = len(in_keys) - (action_scale is not None)  # without the action of a critic
    scales = list(input_scale) if isinstance(input_scale, Sequence) else [input_scale] * own
    if len(scales) != own:
        raise UserValueError(
            f"input_scale must be a number, or one for each of the {own} in_keys; got {input_scale!r}."
        )
    if action_scale is not None:
        scales.append(action_scale)
    widths = [spec.shape[-1] for spec in specs]
    if more:
        scales, widths = [1.0, *scales], [more, *widths]
    weights = sum(a * b for a, b in itertools.pairwise([sum(widths), *num_cells, out_features]))
    if weights > MOST_WEIGHTS:
        raise UserValueError(
            f"A network of this many cells has {weights:,} weights, more than {MOST_WEIGHTS:,}: write smaller widths, "
            "such as num_cells=[256, 256]."
        )
    mlp = MLP(
        in_features=sum(widths),
        out_features=out_features,
        num_cells=list(num_cells),
        activation_class=activation,
        norm_class=nn.LayerNorm if layer_norm else None,
        norm_kwargs=[{"normalized_shape": cells} for cells in num_cells] if layer_norm else None,
        device=env.device,
    )
    dtype = next((spec.dtype for spec in specs if spec.dtype.is_floating_point), None)
    return Network(mlp.to(dtype), scales, widths)


def _single(env: EnvBase) -> EnvBase:
    """The environment under transforms; a new one like those that run in other processes."""
    env = base_env(env)
    if isinstance(env, BatchedEnvBase):
        return _single(env.create_env_fn[0](**env.create_env_kwargs[0]))
    return env


def _spec(env: EnvBase, key: NestedKey) -> TensorSpec:
    """The spec of an entry (*, k) that a network can read."""
    known: dict[NestedKey, TensorSpec] = {**dict(observed(env).items(True, True))}
    known["action"] = cast(TensorSpec, env.action_spec)
    if key not in known:
        raise UserValueError(f"Unknown entry {key!r} in in_keys. Choose from: {', '.join(map(str, known))}.")
    if known[key].ndim != env.ndim + 1:
        raise UserValueError(
            f"Entry {key!r} has shape {tuple(known[key].shape)} and a network reads vectors: flatten it, for example "
            "with TorchRL's FlattenObservation."
        )
    return known[key]
