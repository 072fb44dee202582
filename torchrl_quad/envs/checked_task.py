"""The check of a task: whether its methods return what the base class says."""

from __future__ import annotations

import numbers
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.checks import names, require
from torchrl_quad.envs.metrics import EPISODE_METRICS
from torchrl_quad.envs.task import Task
from torchrl_quad.envs.terms import Event
from torchrl_quad.errors import UserValueError


def check_task(env: Any, state: State) -> None:
    """Refuse a task whose methods do not return what the base class says.

    A tensor with more columns than it should have would shift all that lies behind it.
    """
    task, n = type(env).__name__, env.num_envs

    def check(method: str, x: Any, dtype: torch.dtype | None, columns: int | None = 1, hint: str = "") -> None:
        is_right = isinstance(x, Tensor) and x.shape == (n, columns or x.shape[-1:].numel())
        if not is_right or dtype not in (None, x.dtype):
            got = f"{tuple(x.shape)}, {x.dtype}" if isinstance(x, Tensor) else type(x).__name__
            kind = "" if dtype is None else f", {dtype}"
            raise UserValueError(f"{task}.{method} must be a tensor ({n}, {columns or 'k'}){kind}; got {got}.{hint}")

    def named(method: str, entries: Any) -> Mapping[Any, Any]:
        message = f"{task}.{method} must be a mapping from names to tensors; got {type(entries).__name__}."
        require(isinstance(entries, Mapping), message)
        return entries

    taken = {"step", "action_queue", "collided", "drone", "scene"}
    taken |= {key for x in env.disturbances.values() for key in x.start(env.randomness, state) if isinstance(key, str)}
    for key in taken & set(env.task_entries):
        raise UserValueError(f"{task}.initial_state: entry {key!r} is the environment's own; give yours another name.")
    for key, x in state.items():
        require(
            isinstance(x, Tensor) and x.dim() > 1 and len(x) == n and x.dtype in (env.dtype, torch.int64, torch.bool),
            f"{task}.initial_state: entry {key!r} must be a tensor ({n}, ...) of at least two dimensions, {env.dtype}, "
            f"int64 or bool; got {(tuple(x.shape), x.dtype) if isinstance(x, Tensor) else type(x).__name__}.",
        )
        if isinstance(key, tuple) and key[0] == "drone":
            fields = env.dynamics.plant_fields
            require(key[1] in fields, f"Entry {key!r} changes no parameter of the drone. Choose from: {names(fields)}.")
    check("observe(state)", env.observe(state), env.dtype, None)
    terms = named("reward_terms(state)", env.reward_terms(state))
    for name, term in terms.items():
        hint = " Sum a vector over its components: .sum(-1, keepdim=True)."
        check(f"reward_terms(state)[{name!r}]", term, env.dtype, hint=hint)
    for name, event in named("events(previous, state)", env.events(state, state)).items():
        method = f"events(previous, state)[{name!r}]"
        require(isinstance(event, Event), f"{task}.{method} must be an Event; got {type(event).__name__}.")
        check(f"{method}.happened", event.happened, torch.bool)
        check(f"{method}.time", event.time, env.dtype)
        if not isinstance(event.amount, numbers.Real) and getattr(event.amount, "numel", lambda: 0)() != 1:
            check(f"{method}.amount", event.amount, env.dtype)
        taken = f"{task}.{method} gives the term '{name}_time', which the reward has already: rename one of them."
        require(f"{name}_time" not in terms, taken)
        unknown = f"{task}.{method}.term must be one of {names(terms)}, or None; got {event.term!r}."
        require(event.term is None or event.term in terms, unknown)
    metrics = named("metrics(state)", env.metrics(state))
    missing = env.metric_info.keys() - EPISODE_METRICS.keys() - metrics.keys()
    are_its_own = type(env).episode_metrics is not Task.episode_metrics  # which may add some
    require(
        are_its_own or not missing,
        f"{task}.metrics(state) lacks {names(sorted(missing))}, which metric_info describes.",
    )
    for name, metric in metrics.items():
        check(f"metrics(state)[{name!r}]", metric, None)
    for method in ("is_crash", "is_success"):
        check(f"{method}(state)", getattr(env, method)(state), torch.bool)
    advanced = named("advance(previous, state)", env.advance(state, dict(state)))
    for key in env.task_entries:
        x = advanced.get(key)
        kind, got = (tuple(state[key].shape), state[key].dtype), None if x is None else (tuple(x.shape), x.dtype)
        require(
            got == kind,
            f"{task}.advance must return the whole state, and {key!r} as initial_state gives it, {kind}; got {got}. "
            "Start from {**state, ...}.",
        )
