"""Flights of a bundle as rollouts, for the package's pictures and tools; this needs torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_quad.deploy.judging import episode_steps, targets
from torchrl_quad.deploy.simulators import require_open_air
from torchrl_quad.envs import QuadrotorEnv, make_env

STATES = ("position", "quaternion", "velocity", "angular_velocity", "rotor_speed")


def environment(contract: Mapping[str, Any], num_envs: int = 1) -> QuadrotorEnv:
    """The environment of a contract, with its drone and its task, and without what made training harder.

    Raises:
        ValueError: the policy sees, or flies through obstacles, which a contract does not hold.
    """
    require_open_air(contract)
    task, about = contract["task"], contract["simulator"]
    options = {name: about[name] for name in ("dt", "dynamics", "integrator")}
    options |= {name: contract[name] for name in ("control_dt", "action_delay", "drone")}
    if task["rule"] == "curve":
        amplitudes = torch.tensor([*task["cosine"], *task["sine"]])
        offset, harmonics = torch.tensor(task["offset"]), torch.arange(1, len(task["cosine"]) + 1)

        def curve(phase: Tensor) -> Tensor:
            angles = phase.unsqueeze(-1) * harmonics
            return offset + torch.cat((angles.cos(), angles.sin()), -1) @ amplitudes

        options |= {"curve": curve, "period": task["period"]}
    if task["rule"] == "gates":
        options["track"] = {name: task[name] for name in ("gates", "gate_radius")}
    env = make_env(task["name"], num_envs=num_envs, max_episode_steps=task["max_episode_steps"], **options)
    if task["rule"] == "target":
        env.target = tuple(task["target"])
    return env


def as_rollout(contract: Mapping[str, Any], flight: Mapping[str, Any]) -> TensorDict:
    """What :func:`~torchrl_quad.deploy.transfer.fly` returns as a rollout (n, time), of the first episodes alone."""
    steps, crash = episode_steps(contract, flight)
    states = {name: torch.from_numpy(flight[name]).float() for name in STATES}
    states["target"] = torch.from_numpy(targets(contract, flight)[0].copy()).float()
    n, time = flight["action"].shape[:2]
    last = torch.from_numpy(np.arange(time) == steps[:, None] - 1).unsqueeze(-1)
    flags = {"done": last, "crash": last & torch.from_numpy(crash)[:, None, None]}
    flags["success"] = last & torch.from_numpy(flight["solved"] > 0)[:, None, None]
    flags["truncated"] = last & (torch.arange(time) == contract["task"]["max_episode_steps"] - 1)[:, None]
    flags["terminated"] = last & ~flags["truncated"]
    return TensorDict(
        {
            "state": {name: x[:, :-1] for name, x in states.items()},
            "action": torch.from_numpy(flight["action"]).float(),
            "next": {"state": {name: x[:, 1:] for name, x in states.items()}, **flags},
        },
        [n, time],
    )
