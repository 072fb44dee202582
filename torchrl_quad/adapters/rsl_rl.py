"""A task for rsl-rl, as legged robots train in Isaac Lab."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_quad.adapters.torch_vector import TorchVectorEnv
from torchrl_quad.errors import UserTypeError, UserValueError, needing

with needing('RslRlVecEnv needs rsl-rl: pip install ".[adapters]" in a clone'):
    from rsl_rl.env import VecEnv


class RslRlVecEnv(VecEnv):
    """A vector environment of rsl-rl: ``OnPolicyRunner(RslRlVecEnv(HoveringEnv(num_envs=512)), config, log_dir)``.

    The observation is in the group "policy", which is the default of actor and critic. Actions are clipped to their
    bounds. ``extras`` holds ``time_outs``, by which rsl-rl bootstraps, and ``log``, the means of ``success``, ``crash``
    and the metrics over the episodes that end in the step.

    ``episode_length_buf`` (num_envs) is the step in the state of the task. Setting it, as ``init_at_random_ep_len``
    does, to whole numbers from 0 to ``max_episode_length`` - 1, brings the time limit of each episode nearer.

    Args:
        env: as for :class:`~torchrl_quad.adapters.TorchVectorEnv`; a task, or transforms around one.
    """

    def __init__(self, env: EnvBase) -> None:
        self.drones = TorchVectorEnv(env)
        if not hasattr(env, "max_episode_steps"):
            raise UserTypeError(
                f"RslRlVecEnv needs a task, which has a time limit, and got {type(env).__name__}: build "
                "HoveringEnv(num_envs=512), or derive your task from QuadrotorEnv."
            )
        self.num_envs, self.device = self.drones.num_envs, self.drones.device
        self.num_actions = self.drones.single_action_space.shape[0]
        self.max_episode_length = cast("int", env.max_episode_steps)
        self.cfg = {"task": type(getattr(env, "base_env", env)).__name__, "num_envs": self.num_envs}
        self.drones.reset()

    @property
    def episode_length_buf(self) -> Tensor:
        """Control steps since the start of each episode (num_envs)."""
        return cast("Any", self.drones.now)["state", "step"].squeeze(-1)

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Tensor) -> None:
        now, limit = self.episode_length_buf, self.max_episode_length
        fits = isinstance(steps, Tensor) and steps.dtype in (torch.int32, torch.int64) and steps.device == now.device
        if not fits or steps.shape != now.shape or not ((steps >= 0) & (steps < limit)).all():
            raise UserValueError(
                f"episode_length_buf must be whole numbers ({self.num_envs},) on {now.device}, with steps from 0 to "
                f"{limit - 1}. Write torch.randint_like(env.episode_length_buf, high={limit})."
            )
        cast("Any", self.drones.now)["state", "step"] = steps.unsqueeze(-1).to(now.dtype, copy=True)

    def get_observations(self) -> TensorDict:
        """The present observations: ``policy`` (num_envs, k)."""
        return self._grouped(cast("Any", self.drones.now)["observation"])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Fly one control step with actions (num_envs, 4): observations, rewards and ends (num_envs), extras."""
        observation, reward, terminated, truncated, info = self.drones.step(actions)
        done = terminated | truncated
        extras: dict[str, Any] = {"time_outs": truncated & ~terminated}
        if done.any():
            ended = {name: info[name] for name in ("success", "crash") if name in info} | info.get("metrics", {})
            extras["log"] = {f"Episode/{name}": x[done].to(torch.float32).mean() for name, x in ended.items()}
        return self._grouped(observation), reward, done, extras

    def _grouped(self, observation: Tensor) -> TensorDict:
        return TensorDict({"policy": observation}, [self.num_envs], self.device)
