"""The tasks as gymnasium environments: numpy arrays in and out, no gradient.

Importing ``torchrl_quad`` registers them, and so does ``gymnasium.make("torchrl_quad:torchrl_quad/Hovering-v0")``.
``AsyncVectorEnv`` starts processes that import your program again (torchrl sets multiprocessing's start method to
"spawn"): put what starts them under ``if __name__ == "__main__":``, or use a plain ``make_vec``, which needs none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, cast

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.envs import QuadrotorEnv, make_env
from torchrl_quad.errors import UserTypeError, UserValueError, WrongState, shown
from torchrl_quad.options import Seed, check_value

_LIMIT = 1e6  # of an observation, where a task does not know better: before, the episode ends
_NO_LIMIT = 10_000_000  # control steps, as many as a task takes: gymnasium.make has a time limit of its own
INFO = "success", "crash", "reward_terms", "metrics"
Mode = Literal["NextStep", "SameStep", "Disabled"]
Observation = np.ndarray | dict[str, np.ndarray]


class ResetNeeded(WrongState, gymnasium.error.ResetNeeded):
    """A step or a picture needs an episode: ``reset()`` comes first."""


class Closed(WrongState, gymnasium.error.ClosedEnvironmentError):
    """The environment has been closed."""


class GymVectorEnv(VectorEnv):
    """All drones of a task in one batched environment: ``gymnasium.make_vec("torchrl_quad/Hovering-v0", num_envs=64)``.

    Observations are float32 (num_envs, k), clipped to the bounds of their space: the task's ``observation_bounds`` or
    1e6. With a ``camera`` they are a dictionary of ``observation`` and ``depth`` (num_envs, 1, height, width) [m].
    Actions are floats (num_envs, k), clipped to [-1, 1], rewards float64 (num_envs). ``info`` holds ``success``,
    ``crash``, ``reward_terms`` and ``metrics`` by name, each (num_envs), with a mask ``_name`` for every name.

    The time limit is the task's ``max_episode_steps``. ``reset(seed=...)`` seeds the one generator of all drones;
    without a seed it continues to draw. ``torchrl_env`` is the TorchRL environment, to be read.

    Args:
        task: "forest", "hovering", "landing", "racing" or "tracking".
        num_envs: number of drones.
        autoreset_mode: how an episode that has ended resets. "NextStep": at the next step, which ignores the action and
            has no reward; "SameStep": in the same step, with ``final_obs`` and ``final_info`` in ``info``; "Disabled":
            by ``reset(options={"reset_mask": mask})`` with a bool mask (num_envs).
        render_mode: "rgb_array" for pictures, which need matplotlib; None for none.
        **kwargs: of the task's environment. Without ``seed`` the first starts differ from run to run, as is usual in
            gymnasium.

    Raises:
        TypeError, ValueError: as in other environments; a call that is refused leaves the flight as it was.
        ResetNeeded: a step or a picture before the first reset; a step, with "Disabled", after an episode's end.
        ClosedEnvironmentError: a call after ``close()``, which may be called twice.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> None:
        mode = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        self.autoreset_mode = AutoresetMode(check_value("autoreset_mode", mode, Mode))
        self.render_mode = check_value("render_mode", render_mode, Literal["rgb_array"] | None)
        if kwargs.get("max_episode_steps", 0) is None:  # as the task has it
            del kwargs["max_episode_steps"]
        self.torchrl_env: QuadrotorEnv = make_env(task, num_envs=num_envs, **kwargs)
        if "seed" not in kwargs:
            self.torchrl_env.set_seed(None)
        self.num_envs = self.torchrl_env.num_envs
        fps = round(1 / self.torchrl_env.control_dt)
        self.metadata = {**self.metadata, "render_fps": fps, "autoreset_mode": self.autoreset_mode}
        self._bounds = _bounds(self.torchrl_env)
        self.single_observation_space = Box(-self._bounds, self._bounds, dtype=np.float32)
        if (camera := self.torchrl_env.camera) is not None:
            depth = Box(0.0, camera.range, (1, camera.height, camera.width), np.float32)
            self.single_observation_space = Dict({"observation": self.single_observation_space, "depth": depth})
        self.single_action_space = Box(-1.0, 1.0, self.torchrl_env.hover_action.shape[-1:], np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.now: TensorDictBase | None = None  # the tensordict to step from
        self._over = np.zeros(self.num_envs, dtype=bool)  # whose episode has ended, and has not been reset

    @torch.no_grad()
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with all drones, or with those of the bool ``options["reset_mask"]`` (num_envs)."""
        seed, mask = check_value("seed", seed, Seed | None), self._check_mask(check_options(options, "reset_mask"))
        check_open(self)
        super().reset(seed=seed)
        if seed is not None:
            self.torchrl_env.set_seed(seed)
        now = self._restart(self.now, mask)
        return self._observe(now), _info(now, mask)

    @torch.no_grad()
    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly one control step with actions (num_envs, k)."""
        env, over, info = self.torchrl_env, self._over, {}
        actions = check_action(actions, self.action_space)
        now = check_open(self, needed_by="A step")
        if self.autoreset_mode is AutoresetMode.DISABLED and over.any():
            raise ResetNeeded(
                f"The episodes of drones {np.flatnonzero(over).tolist()} have ended. Call reset() before the next "
                'step or, to leave the others alone, reset(options={"reset_mask": terminated | truncated}).'
            )
        after = env.step(now.set("action", torch.tensor(actions, dtype=env.dtype, device=env.device)))["next"]
        self.now = now = after.exclude("reward")
        reward, terminated, truncated = (_array(after[name]) for name in ("reward", "terminated", "truncated"))
        if over.any():
            now = self._restart(now, over)
            reward[over], terminated[over], truncated[over] = 0.0, False, False
        self._over = over = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and over.any():
            last, observations = self._observe(after), np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(over):
                observations[i] = _row(last, int(i))
            info = {"final_obs": observations, "_final_obs": over.copy()}
            info |= {"final_info": _info(after, over), "_final_info": over.copy()}
            now = self._restart(now, over)
        info |= _info(now, np.ones(self.num_envs, dtype=bool))
        return self._observe(now), reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (336, 336, 3) of each drone, uint8; None without ``render_mode="rgb_array"``.

        With "SameStep" it shows the start of the next episode after the end of one, as gymnasium's own do.
        """
        check_open(self)
        if self.render_mode is None:
            gymnasium.logger.warn('render() draws nothing without render_mode="rgb_array", an argument of make_vec.')
            return None
        check_open(self, needed_by="A picture")
        return tuple(self.torchrl_env.render([i]) for i in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the TorchRL environment."""
        self.torchrl_env.close()

    def _check_mask(self, options: Mapping[str, Any]) -> np.ndarray:
        """Whose episodes ``reset`` begins, bool (num_envs)."""
        if "reset_mask" not in options:
            return np.ones(self.num_envs, dtype=bool)
        mask = _as_array(options["reset_mask"])
        if mask is None or mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise UserValueError(
                f"reset_mask must be a bool array of shape ({self.num_envs},) that marks at least one drone, got "
                f"{shown(options['reset_mask'])}. To reset all drones, leave it out."
            )
        if self.now is None and not mask.all():
            raise ResetNeeded("The first episodes begin together: call reset() without reset_mask first.")
        return mask.copy()

    def _restart(self, now: TensorDictBase | None, mask: np.ndarray) -> TensorDictBase:
        """Reset the drones of the mask, as a rollout does where their episodes end."""
        if now is not None:
            chosen = torch.as_tensor(mask, device=self.torchrl_env.device).unsqueeze(-1)
            now = now.exclude("action").set("_reset", chosen)
        self.now = now = self.torchrl_env.reset(now, set_state=False)
        self._over = self._over & ~mask
        return now

    def _observe(self, outputs: TensorDictBase) -> Observation:
        # What is handed out is copied: the next step starts from the same memory.
        observation = cast("Tensor", outputs["observation"]).numpy(force=True).astype(np.float32)
        observation.clip(-self._bounds, self._bounds, out=observation)
        if (camera := self.torchrl_env.camera) is None:
            return observation
        depth = cast("Tensor", outputs["depth"]).numpy(force=True).astype(np.float32, order="C")
        return {"observation": observation, "depth": depth.clip(0.0, camera.range, out=depth)}


class GymEnv(gymnasium.Env):
    """One drone of a task: ``gymnasium.make("torchrl_quad/Hovering-v0")``; see :class:`GymVectorEnv`.

    To train, fly a batch, ``gymnasium.make_vec``: it makes hundreds of times as many steps per second. The time limit
    is gymnasium's: ``gymnasium.make`` adds that of the task. ``GymEnv("hovering")`` flies until ``max_episode_steps``,
    by default ten million. Arguments and errors are those of :class:`GymVectorEnv` with "Disabled".
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(self, task: str, **kwargs: Any) -> None:
        for name in ("num_envs", "autoreset_mode"):
            if name in kwargs:
                raise UserValueError(f"{name} is for many drones: write gymnasium.make_vec. GymEnv flies one.")
        kwargs.setdefault("max_episode_steps", _NO_LIMIT)
        self._drones = GymVectorEnv(task, autoreset_mode=AutoresetMode.DISABLED, **kwargs)
        self.torchrl_env, self.render_mode = self._drones.torchrl_env, self._drones.render_mode
        self.metadata = {name: self._drones.metadata[name] for name in self.metadata}
        self.observation_space = self._drones.single_observation_space
        self.action_space = self._drones.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; there are no options."""
        seed = check_value("seed", seed, Seed | None)
        check_options(options)
        observation, info = self._drones.reset(seed=seed)
        super().reset(seed=seed)
        return _row(observation, 0), _first(info)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Fly one control step with an action (k)."""
        observation, *ends, info = self._drones.step(check_action(action, self.action_space)[None])
        reward, terminated, truncated = (x.item() for x in ends)
        return _row(observation, 0), reward, terminated, truncated, _first(info)

    def render(self) -> np.ndarray | None:
        """A picture (336, 336, 3), uint8; None without ``render_mode="rgb_array"``."""
        frames = self._drones.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Close the TorchRL environment."""
        self._drones.close()


def check_open(env: Any, needed_by: str | None = None) -> TensorDictBase:
    """What the next step of an adapter starts from; an error if it was closed, or has none and something needs one."""
    if env.closed:
        raise Closed("The environment has been closed: make another one.")
    if needed_by and env.now is None:
        raise ResetNeeded(f"{needed_by} needs an episode: call reset() first.")
    return env.now


def check_action(action: Any, space: Space) -> np.ndarray:
    """A finite action of floats as a float64 array of the shape of its space, a copy, clipped to the bounds."""
    given, space = _as_array(action), cast("Box", space)
    if given is None or given.dtype.kind != "f":
        got = type(action).__name__ + ("" if given is None else f" of {given.dtype}")
        raise UserTypeError(
            f"The action must be an array of floats of shape {space.shape} in the memory of the CPU, each entry in "
            f"[-1, 1], as env.action_space.sample() returns it; got {got}."
        )
    check_numbers(given, space.shape)
    return given.clip(space.low, space.high).astype(np.float64)


def check_numbers(action: np.ndarray | Tensor, shape: Sequence[int]) -> None:
    """Raise unless an action has its shape, and is finite."""
    if tuple(action.shape) != tuple(shape):
        rows = ", one row per drone" if len(shape) > 1 else ""
        raise UserValueError(f"The action has shape {tuple(action.shape)}, expected {tuple(shape)}{rows}.")
    finite = torch.as_tensor(action.isfinite() if isinstance(action, Tensor) else np.isfinite(action))
    if not finite.all():
        broken = (~finite).nonzero().tolist()
        raise UserValueError(
            f"The action is NaN or infinite at {broken[:10]}{' and others' * (len(broken) > 10)}. Check the policy's "
            "parameters, or replace these by nan_to_num."
        )


def check_options(options: Any, *known: str) -> Mapping[str, Any]:
    """The options of a reset, a mapping of those that are known; none for None."""
    options = {} if options is None else options
    if not isinstance(options, Mapping) or not set(options) <= set(known):
        raise UserValueError(f"options: a dictionary may hold {', '.join(known) or 'nothing'}; got {shown(options)}.")
    return options


def _as_array(x: Any) -> np.ndarray | None:
    """Whatever was given as an array; None if it is none, as a ragged list or a tensor of another device."""
    try:
        return np.asarray(x.detach() if isinstance(x, Tensor) else x)
    except Exception:  # numpy lets every error of other people's objects pass
        return None


def _bounds(env: QuadrotorEnv) -> np.ndarray:
    """The bounds of the observation (k): the task's, and of the commands on their way those of the action."""
    size = cast("Any", env.observation_spec)["observation"].shape[-1]
    own, commands = env.observation_bounds(), env.action_delay if env.observe_last_action else 0
    action = cast("Any", env.action_spec).space.high[0].repeat(commands)
    if own is None or len(own) + len(action) != size:
        return np.full(size, _LIMIT, dtype=np.float32)
    return torch.cat((own, action)).numpy(force=True).astype(np.float32)


def _row(observation: Observation, i: int) -> Observation:
    """The observation of one drone."""
    return {name: x[i] for name, x in observation.items()} if isinstance(observation, dict) else observation[i]


def _array(x: Tensor) -> np.ndarray:
    """An entry (n, 1) as (n), a copy, float64 as gymnasium has it, or bool."""
    return np.array(x.squeeze(-1).numpy(force=True), dtype=bool if x.dtype is torch.bool else np.float64)


def _info(entries: Any, mask: np.ndarray, names: Iterable[str] = INFO) -> dict[str, Any]:
    """Gymnasium's info of the drones under the mask (n), of others zeros."""
    info: dict[str, Any] = {}
    for name, x in entries.select(*names, strict=False).items():
        info[name] = np.where(mask, _array(x), False) if isinstance(x, Tensor) else _info(x, mask, x.keys())
        info[f"_{name}"] = mask.copy()
    return info


def _first(info: dict[str, Any]) -> dict[str, Any]:
    """The info of the first drone, as a single environment gives it."""
    own = {name: x for name, x in info.items() if not name.startswith("_")}
    return {name: _first(x) if isinstance(x, dict) else x[0].item() for name, x in own.items()}
