"""What an environment says of itself: the specs that TorchRL reads, and one line for people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.data import Binary, Bounded, Composite, Unbounded

from torchrl_quad.engine import nested


def set_specs(env: Any) -> None:
    """Give an environment its specs, read off what its step writes of the safe state."""

    def spec(x: Any) -> Any:
        if isinstance(x, Mapping):
            return Composite({key: spec(value) for key, value in x.items()}, shape=env.batch_size, device=env.device)
        if x.dtype == torch.bool and x.shape[1:] == (1,):
            return Binary(1, x.shape, device=env.device, dtype=torch.bool)
        return Unbounded(x.shape, device=env.device, dtype=x.dtype)

    safe_state = env.control_step.safe_state
    outputs = env.control_step.at_start(safe_state)
    done = {name: outputs.pop(name) for name in ("done", "terminated", "truncated")}
    outputs = {name: x for name, x in outputs.items() if not isinstance(x, Mapping) or x}
    state = nested(safe_state)
    env.observation_spec = spec({**outputs, "state": state})
    # A key that is in the state spec alone would never be carried on: it has to be in both.
    env.state_spec = spec({"state": state})
    env.action_spec = Bounded(-1.0, 1.0, (env.num_envs, 4), device=env.device, dtype=env.dtype)
    env.reward_spec = Unbounded((env.num_envs, 1), device=env.device, dtype=env.dtype)
    env.done_spec = spec(done)


def describe(env: Any) -> str:
    """The task, number of drones, which one, control period, device and so on of an environment, in one line."""
    if not hasattr(env, "control_step"):
        return f"{type(env).__name__}(not built)"
    name = str(env._drone) if isinstance(env._drone, str | Path) else "own"
    changed = "" if env.params is env.nominal else " with other parameters"
    more = f", disturbances={'+'.join(map(str, env.disturbances))}" if env.disturbances else ""
    return (
        f"{type(env).__name__}(num_envs={env.num_envs}, drone={name!r}{changed}, "
        f"control_dt={env.control_dt:g} s, max_episode_steps={env.max_episode_steps}{more}, device={env.device}, "
        f"dtype={env.dtype}, compiled={env.is_compiled})"
    )
