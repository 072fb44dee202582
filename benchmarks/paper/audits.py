"""Audit the rewards of all tasks, from states in which every term is paid: which terms have a gradient?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict

import torch

from torchrl_quad import audit_reward, differentiable_rollout, make_actor, make_env

REWARDS = {  # task and name of a reward: options of the environment
    ("hovering", ""): {},
    ("tracking", ""): {},
    ("landing", ""): {},
    ("racing", "position"): {"reward": "position"},
    ("racing", "velocity"): {"reward": "velocity"},
    ("racing", "velocity, log bonus"): {"reward": "velocity", "gate_bonus": "log"},
    ("racing", "velocity, reciprocal bonus"): {"reward": "velocity", "gate_bonus": "reciprocal"},
}


def audit_tasks(
    own: Iterable[str] = (), num_envs: int = 64, horizon: int = 32, seed: int = 0
) -> list[dict[str, object]]:
    """Audit each reward, and those of tasks of your own, under an untrained policy: a row for each term."""
    rows = []
    for (task, name), options in {**REWARDS, **{(task, ""): {} for task in own}}.items():
        torch.manual_seed(seed)
        env = make_env(task, num_envs=num_envs, seed=seed, **options)
        td = env.reset()
        state, some = td["state"], slice(0, num_envs // 2)
        if task == "landing":  # near the pad: some will land, and some crash
            state["position"][some] = (
                state["target"][some] + 0.4 * torch.rand(num_envs // 2, 3) + env.tensor([0, 0, 0.1])
            )
            state["velocity"][some] = torch.linspace(-1.0, 0.0, num_envs // 2)[:, None] * env.tensor([0.0, 0.0, 1.0])
        if task == "racing":  # on the way through the next gate
            way = torch.nn.functional.normalize(state["target"] - state["position"], dim=-1)
            state["position"][some] = (state["target"] - torch.rand(num_envs, 1) * way)[some]
            state["velocity"][some] = 2.0 * way[some]
        actor = make_actor(env)
        rollout, _ = differentiable_rollout(env, actor, env.reset(td, set_state=True), horizon)
        audit = audit_reward(rollout, actor, gamma=0.99)
        rows += [{"task": task, "reward": name, "term": term, **asdict(found)} for term, found in audit.items()]
    return rows
