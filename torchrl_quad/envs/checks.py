"""Refuse wrong arguments, states and actions, with the reason and a remedy."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import torch
from pydantic import AfterValidator
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.dynamics import DYNAMICS, QuadrotorParams
from torchrl_quad.dynamics.vector import is_traced
from torchrl_quad.engine.simulation import State
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.options import Explained, between, check_value

MAX_SUBSTEPS = 200  # physics steps of a control step, which take half a second without compilation
MAX_STEPS = 2**31  # since the start of an episode
Weight = Annotated[
    float, between(-1e6, 1e6)
]  # a larger one would leave none of the seven digits of single precision to the others


def require(condition: bool, message: str) -> None:
    """Raise a ValueError with this message unless the condition holds."""
    if not condition:
        raise UserValueError(message)


def names(keys: Iterable[Any]) -> str:
    """Keys in a sentence."""
    return ", ".join(str(key) for key in keys)


# -- arguments ---------------------------------------------------------------------------------------------------------


def timing(
    dynamics: str, control: Any, dt: float, control_dt: float, action_delay: int, integrator: str, shows_actions: bool
) -> dict[str, Any]:
    """The arguments of the dynamics model, if those of the environment fit each other."""
    takes_control = "control" in inspect.signature(DYNAMICS[dynamics]).parameters
    require(
        takes_control or control == "rates",
        f"dynamics={dynamics!r} takes no control: its actions have a meaning of their own. Leave out "
        f"control={shown(control)}.",
    )
    substeps = round(control_dt / dt)
    require(
        1 <= substeps <= MAX_SUBSTEPS and math.isclose(substeps * dt, control_dt, rel_tol=1e-6),
        f"control_dt must be a whole multiple of dt, and at most {MAX_SUBSTEPS} of them; got {control_dt} and {dt}. "
        f"Try control_dt={min(max(substeps, 1), MAX_SUBSTEPS) * dt:g}.",
    )
    require(
        action_delay > 0 or not shows_actions,
        "observe_last_action shows the commands that are on their way; with action_delay=0 there are none.",
    )
    options = {"dt": dt, "substeps": substeps, "integrator": integrator}
    return {**options, "control": control} if takes_control else options


def check_compilation(options: Mapping[str, Any]) -> None:
    """Refuse keywords that torch.compile does not take."""
    known = [*list(inspect.signature(torch.compile).parameters)[1:], "warmup"]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise UserTypeError(f"compile: torch.compile takes no {shown(unknown[0])}. Choose from: {names(known)}.")
    for name, kind in {"fullgraph": bool, "dynamic": bool | None, "disable": bool}.items():
        check_value(f"compile: {name}", options.get(name, False), kind)
    modes = ["default", *torch._inductor.list_mode_options()]
    mode = options.get("mode") or "default"
    require(mode in modes, f"compile: mode must be one of {names(modes)}; got {shown(mode)}.")
    given = check_value("compile: options", options.get("options"), dict[str, Any] | None) or {}
    unknown = [name for name in given if name.replace("-", "_") not in torch._inductor.list_options()]
    require(not unknown, f"compile: the compiler has no option {names(map(shown, unknown))}.")
    backend, backends = options.get("backend", "inductor"), torch.compiler.list_backends(())
    require(
        callable(backend) or (isinstance(backend, str) and backend in backends),
        f"compile: backend must be a function, or one of {names(backends)}; got {shown(backend)}.",
    )


def full_signature(cls: type, base: type) -> inspect.Signature:
    """All arguments of a task: its own, then those it hands on to its base, then ``compile``, which TorchRL takes."""
    arguments: dict[str, inspect.Parameter] = {}
    for owner in cls.__mro__[: cls.__mro__.index(base)]:
        parameters = inspect.signature(vars(owner)["__init__"]).parameters if "__init__" in vars(owner) else {}
        for name, argument in parameters.items():
            if name != "self" and argument.kind not in (argument.VAR_KEYWORD, argument.VAR_POSITIONAL):
                arguments.setdefault(name, argument)
    option = inspect.Parameter("compile", inspect.Parameter.KEYWORD_ONLY, default=False, annotation="bool | dict")
    return inspect.Signature(sorted([*arguments.values(), option], key=lambda x: x.kind))


def _weights(weights: Any) -> Any:
    """Weights by name, each a number or a tensor of one."""
    if weights is None:
        return None
    if not isinstance(weights, Mapping):
        raise UserValueError("be a mapping from terms of the reward to numbers")
    for name, value in weights.items():
        x = value.detach() if isinstance(value, Tensor) else value
        if isinstance(x, Tensor) and x.numel() == 1 and not (x.is_complex() or x.dtype == torch.bool):
            x = x.item()
        try:
            check_value(str(name), x, Weight)
        except UserValueError as error:
            raise Explained(str(error)) from None
    return weights


Weights = Annotated[Any, AfterValidator(_weights)]


def checked_weights(weights: Mapping[str, Any], known: Mapping[str, Any]) -> Mapping[str, Any]:
    """Weights of reward terms, if the task has these terms."""
    unknown = [str(name) for name in weights if name not in known]
    require(not unknown, f"weights: unknown term {names(unknown)}. Choose from: {names(known)}.")
    return {name: check_value("weights", {name: x}, Weights)[name] for name, x in weights.items()}


def checked_params(params: Any, num_envs: int) -> QuadrotorParams:
    """The drone, if it is one, for this number of environments."""
    if not isinstance(params, QuadrotorParams):
        raise UserTypeError(
            f"params must be QuadrotorParams, such as env.params.replace(mass=0.5) or load_drone('visfly'); got "
            f"{type(params).__name__}."
        )
    for name, value in params.fields().items():
        batch = value.shape[0] if value.dim() > params.dim(name) else 1
        require(batch in (1, num_envs), f"drone: field {name!r} is for {batch} environments, and num_envs={num_envs}.")
    return params


def require_clear_reset(tensordict: Any, set_state: bool | None, select_reset_only: bool = False, **_: Any) -> None:
    """Refuse a mask beside a state, unless it is said which counts: TorchRL 0.14 takes the state, 0.15 the mask."""
    said = set_state is not None or select_reset_only or tensordict is None
    unclear = not said and "_reset" in tensordict and "state" in tensordict
    require(
        not unclear,
        'reset: the tensordict has a mask in "_reset" and a state. For fresh starts in the environments of the mask '
        "write env.reset(tensordict, set_state=False); to set them to this state, set_state=True.",
    )


def check_source(source: Any) -> None:
    """Refuse a source of states that cannot be called."""
    require(
        source is None or callable(source),
        "initial_state_source must be a function from a number n to n states, or None for the task's own starts; "
        f"got {type(source).__name__}.",
    )


# -- states and actions ------------------------------------------------------------------------------------------------


def read_state(state: Any, safe_state: State, source: str) -> State:
    """The entries of a state (a tensordict), if all are there with the right shape, precision and device."""
    require(
        isinstance(state, TensorDictBase),
        f'{source}: a state is a tensordict, such as env.reset()["state"]; got {type(state).__name__}.',
    )
    given = dict(state.items())  # one look at all names is quicker than many
    entries = {key: state.get(key, None) if isinstance(key, tuple) else given.get(key) for key in safe_state}
    for key, x in entries.items():
        like = safe_state[key]
        if x is None or x.shape != like.shape or x.dtype != like.dtype or x.device != like.device:
            _refuse_entry(entries, key, safe_state, source)
    return entries


def restore_state(env: Any, state: Any, source: str, mask: Tensor | None = None) -> State:
    """A copy of a state to fly from, in the precision and on the device of the environment.

    Args:
        env: the environment.
        state: a tensordict with all entries of its state.
        source: where the state comes from, for messages.
        mask: which environments it is for, bool (n) or (n, 1); all for None. The others may hold anything.
    """
    step = env.control_step
    require(
        isinstance(state, TensorDictBase),
        f'{source}: a state is a tensordict, such as env.reset()["state"]; got {type(state).__name__}.',
    )
    entries = {key: state.get(key, None) for key in step.safe_state}
    for key, x in entries.items():
        like = step.safe_state[key]
        if x is None or x.shape != like.shape or _kind(x) != _kind(like):
            _refuse_entry(entries, key, step.safe_state, source)
    entries = {key: x.to(step.safe_state[key], copy=True) for key, x in entries.items()}
    if is_traced():
        return entries
    wrong = step.complaints(entries)
    for key, (low, high) in {"step": (0, MAX_STEPS), **env.state_bounds()}.items():
        outside = ~((entries[key] >= low) & (entries[key] <= high)).flatten(1).all(1)
        wrong[f"{key!r} must lie between {low} and {high}"] = outside
    for complaint, where in wrong.items():
        where = where if mask is None else where & mask.flatten()
        require(
            not where.any(),
            f"{source}: no drone can fly from the state of environments {first_ten(where)}: {complaint}.",
        )
    return entries


def check_action(action: Tensor | None, like: Tensor) -> None:
    """Refuse an action that is not (n, 4) of the precision and on the device of a tensor (n, ...)."""
    if (
        action is not None
        and action.shape == (len(like), 4)
        and action.dtype == like.dtype
        and action.device == like.device
    ):
        return
    if action is None or action.shape != (len(like), 4):
        got = "there is none" if action is None else f"got {tuple(action.shape)}"
        raise UserValueError(
            f"The action must have shape ({len(like)}, 4), named in env.action_units, for each environment; {got}. A "
            'policy writes it under "action", as make_actor(env) does.'
        )
    if action.device != like.device:
        raise UserValueError(f"The action is on {action.device}, and the environment on {like.device}.")
    raise UserValueError(
        f"The action is {action.dtype}, and the environment flies in {like.dtype}. Convert the policy, "
        f"policy.to({like.dtype}), or build the environment with dtype={action.dtype}."
    )


def require_finite(action: Tensor) -> None:
    """Refuse actions (n, 4), or (n, time, 4) of a horizon, that are not finite.

    Raises:
        ValueError: some are not, with their environments and the first step.
    """
    if is_traced():
        return
    finite = action.isfinite().all(-1)
    if finite.all():
        return
    broken = ~finite if action.dim() == 3 else ~finite.unsqueeze(1)
    at = f", first at step {broken.any(0).nonzero()[0].item()} of the rollout" if action.dim() == 3 else ""
    raise UserValueError(
        f"The action is not finite in environments {first_ten(broken.any(1))}{at}: the weights of the policy are "
        "broken, or what it reads is. Look for NaN in both; if training made them, clip the norm of the gradient, and "
        "skip updates whose gradient is not finite."
    )


def first_ten(flags: Tensor) -> str:
    """The indices of the first flags (n) that are set, for a message."""
    who = flags.nonzero().flatten().tolist()
    return ", ".join(str(i) for i in who[:10]) + (", ..." if len(who) > 10 else "")


def _kind(x: Tensor) -> str:
    if x.dtype == torch.bool:
        return "bool"
    return "floating point" if x.is_floating_point() else "complex" if x.is_complex() else "whole numbers"


def _refuse_entry(entries: Mapping[Any, Any], key: Any, safe_state: State, source: str) -> None:
    missing = [key for key, x in entries.items() if x is None]
    require(
        not missing,
        f"{source}: the state lacks {names(missing)}. A state is restored whole: take it from a tensordict of this "
        f"environment, which holds {names(safe_state)}. No transform may drop a part of it, as ExcludeTransform would.",
    )
    x, like = entries[key], safe_state[key]
    shape, expected = tuple(x.shape), tuple(like.shape)
    require(shape == expected, f"{source}: state {key!r} has shape {shape}, expected {expected}.")
    require(_kind(x) == _kind(like), f"{source}: state {key!r} must be {_kind(like)}, got {x.dtype}.")
    raise UserValueError(
        f"{source}: state {key!r} is {x.dtype} on {x.device}, and this environment {like.dtype} on {like.device}. "
        "Convert it: env.reset(tensordict, set_state=True) does."
    )
