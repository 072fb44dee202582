"""Find the ends of episodes in a rollout, and read measurements there."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.errors import UserValueError


def first_episode(rollout: TensorDictBase) -> Tensor:
    """Mark the steps of each environment's first episode, its last one included, bool (num_envs, time, 1)."""
    done = rollout["next", "done"]
    return (done.cumsum(1) - done.int()) == 0


def at_episode_end(rollout: TensorDictBase, value: Tensor) -> Tensor:
    """A value (num_envs, time, 1) at the last step of the first episode of each environment, (num_envs)."""
    last = first_episode(rollout).sum(1, keepdim=True) - 1
    return value.gather(1, last).flatten()


def summarise_episodes(rollout: TensorDictBase) -> dict[str, Tensor]:
    """Judge the first episode of each environment; see ``QuadrotorEnv.episode_metrics``."""
    missing = [name for name in ("crash", "success", "reward", "done") if ("next", name) not in rollout]
    if missing:
        raise UserValueError(
            f'episode_metrics reads ("next", {missing[0]!r}), which is not in the rollout. Judge a rollout before you '
            "leave out entries, and evaluate without the transform that drops this one."
        )
    ends, first = rollout["next"], first_episode(rollout)
    crash, success = (at_episode_end(rollout, ends[name]) for name in ("crash", "success"))
    dtype = ends["reward"].dtype
    return {
        "return": (ends["reward"] * first).sum(1).squeeze(-1),
        "crash": crash.to(dtype),
        "solved": (success & ~crash).to(dtype),
        **{name: at_episode_end(rollout, value) for name, value in ends.get("metrics", {}).items()},
    }
