"""Rollouts that keep their graph, one by one or from a collector."""

from __future__ import annotations

import functools
import types
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Annotated, Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad.data.transforms import check_statistics, under_transforms
from torchrl_quad.data.unwrap import base_env, check_actor, check_env, check_whole_state, leaf, memory_keys, observed
from torchrl_quad.data.visited_states import restart
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.options import Field, Fraction, Horizon, accepted, checked

with warnings.catch_warnings():  # TorchRL's collectors warn of their own classes when they are imported
    warnings.simplefilter("ignore", DeprecationWarning)
    from torchrl.collectors import BaseCollector

Exploration = Annotated[
    Any,
    accepted(
        lambda kind: isinstance(kind, ExplorationType),
        f"one of {', '.join(f'ExplorationType.{x.name}' for x in ExplorationType)}",
    ),
]


@checked
def differentiable_rollout(
    env: EnvBase,
    actor: TensorDictModuleBase,
    carry: TensorDictBase | None,
    horizon: Horizon,
    *,
    exploration_type: Exploration = ExplorationType.RANDOM,
) -> tuple[TensorDictBase, TensorDictBase]:
    """Fly a horizon, and keep the graph from every reward back to every action.

    Environments that finish are reset on the way: the gradient is cut exactly there, also in the memory of a recurrent
    actor, which is cleared, and ``"next"`` keeps the true last state. The rollout is the environment's own ``rollout``,
    so this works for any differentiable TorchRL environment and any stack of transforms.

    Args:
        env: the environment.
        actor: a TensorDictModule that writes the action.
        carry: the reset tensordict to start from: of ``env.reset()``, the last call, ``restart`` or a visited-state
            buffer. It is not modified. None resets the environment.
        horizon: control steps of the rollout.
        exploration_type: RANDOM samples the policy, DETERMINISTIC takes its mode.

    Returns:
        the rollout (*env.batch_size, horizon), and the carry to continue from: detached, and reset where the last step
        was done.

    Raises:
        ValueError: the actor reads an entry that is missing, or a transform changes a part of the state.
    """
    check_env(env)
    check_actor(actor, "actor")
    if not (carry is None or isinstance(carry, TensorDictBase)):
        raise UserTypeError(
            f"carry must be the tensordict to start from, or None to reset the environment; got {type(carry).__name__}."
        )
    try:
        check_whole_state(env)
        check_statistics(env)
        carry = env.reset() if carry is None else carry.copy()
        _check_start(env, actor, carry)
        with set_exploration_type(exploration_type):
            flown = under_transforms(env, actor) if isinstance(env, TransformedEnv) else ""
            rollout = None if isinstance(flown, str) else flown.fly(env, actor, carry, horizon)
            if rollout is None:
                rollout = env.rollout(horizon, actor, tensordict=carry, auto_reset=False, break_when_any_done=False)
    except KeyError as error:
        missing = [key for key in actor.in_keys if carry is not None and key not in carry]
        if "not found in the environment outputs" in str(error):
            raise UserValueError(
                f"ExcludeTransform: {error.args[0]} It leaves out single entries, and no groups: name each, such as "
                '("reward_terms", "velocity").'
            ) from error
        if not missing:
            raise
        if set(missing) & {*memory_keys(actor), "is_init"}:
            raise UserValueError(
                f"The actor remembers, and the tensordict it starts from has no {missing[0]!r}. Give the environment "
                "TorchRL's transforms: Compose(InitTracker(), module.make_tensordict_primer())."
            ) from error
        raise UserValueError(
            f"The actor reads {missing[0]!r}, which is not in the tensordict it starts from. Choose its in_keys from "
            f"what env.reset() writes: {', '.join(map(str, observed(env).keys(True, True)))}."
        ) from error
    base = base_env(env)
    # Transforms such as CatFrames keep past observations in buffers, with their graph.
    for buffer in env.buffers():
        if not buffer.is_leaf:
            buffer.detach_()
    if (shared := getattr(base, "shared_tensordict_parent", None)) is not None:  # of SerialEnv
        shared.detach_()
    with torch.no_grad():
        end = env.step_mdp(cast(TensorDictBase, rollout[..., -1])).clone()
    state = cast(Composite, env.state_spec)
    specs = (*observed(env).keys(True, True), *state.keys(True, True), *cast(Iterable[NestedKey], env.action_keys))
    known = set(map(unravel_key, specs))
    written = end.select(*(key for key in actor.out_keys if unravel_key(key) not in known), strict=False).clone()
    # A reset drops entries that it does not know, such as noise; an environment that keeps its state keeps its graph.
    carry = env.maybe_reset(end).detach().update(written)
    done = leaf(rollout, ("next", "done"))[..., -1, :]
    for key in memory_keys(actor):
        memory = leaf(cast(TensorDictBase, rollout[..., -1]), unravel_key(("next", key))).detach()
        carry.set(key, torch.where(cast(Tensor, expand_as_right(done.squeeze(-1), memory)), 0.0, memory))
        carry.set("is_init", done.clone())
    return rollout, carry


def _check_start(env: EnvBase, actor: TensorDictModuleBase, carry: TensorDictBase) -> None:
    """Raise a UserValueError for a tensordict whose batch size, device or precision is not the environment's."""
    size = cast(torch.Size, env.batch_size)
    if env.batch_locked and carry.batch_size != size:
        raise UserValueError(
            f"carry has batch size {tuple(carry.batch_size)}, and the environment {tuple(size)}. Start from "
            "the tensordict of its own reset(), or of its last rollout."
        )
    # Transforms have a precision of their own: TargetReturn resets in float32.
    for key in (key for key in actor.in_keys if key in carry and key in observed(base_env(env)).keys(True, True)):
        x, spec = leaf(carry, key), observed(env)[key]
        if x.dtype != spec.dtype or (env.device is not None and x.device != env.device):
            raise UserValueError(
                f"{key!r} of the carry is {x.dtype} on {x.device}, and that of the environment {spec.dtype} on "
                f"{env.device}. Start from the tensordict of its own reset(), or of its last rollout."
            )


@checked
class DifferentiableCollector(BaseCollector):
    """Horizons with their graph, for ``torchrl.trainers.Trainer`` and for loops written around collectors.

    Each batch is a :func:`differentiable_rollout` that begins where the one before has ended, or at a fresh start. Take
    one step of the optimizer for each (``optim_steps_per_batch=1``): ``backward`` frees its graph. The policy is not
    copied: a step of the optimizer affects the next batch.

    Args:
        env: any differentiable environment, also under transforms; or a function that builds it.
        policy: a TensorDictModule that writes the action.
        frames_per_batch: control steps of all environments together in a batch, a multiple of their number.
        total_frames: control steps of all environments together after which no batch begins; -1 for no end.
        restart_fraction: the share of flights that each batch gives up for a fresh start; see :func:`restart`.
        exploration_type: RANDOM samples the policy, DETERMINISTIC takes its mode.

    Attributes:
        carry: the tensordict from which the next batch starts, which may be set; None resets the environment.
    """

    init_random_frames = 0
    trajs_per_batch = None

    def __init__(
        self,
        env: EnvBase | Callable[[], EnvBase],
        policy: TensorDictModuleBase,
        *,
        frames_per_batch: Annotated[int, Field(ge=1, le=10**12)],
        total_frames: Annotated[int, Field(ge=-1, le=10**15)] = -1,
        restart_fraction: Fraction = 0.0,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
    ) -> None:
        super().__init__()
        self.env = cast(EnvBase, env() if isinstance(env, types.FunctionType | functools.partial) else env)
        check_env(self.env)
        check_actor(policy, "policy")
        self.policy, self.exploration_type, self.restart_fraction = policy, exploration_type, restart_fraction
        self.horizon, rest = divmod(frames_per_batch, self.env.numel())
        if rest or self.horizon < 1:
            nearest = max(self.horizon, 1) * self.env.numel()
            raise UserValueError(
                f"frames_per_batch={frames_per_batch} must be a multiple of the number of environments, "
                f"{self.env.numel()}. Try {nearest}, a horizon of {nearest // self.env.numel()} control steps."
            )
        self.frames_per_batch = self.requested_frames_per_batch = frames_per_batch
        self.total_frames: Any = float("inf") if total_frames < 0 else total_frames
        self.carry: TensorDictBase | None = None
        self._frames = 0

    def iterator(self) -> Iterator[TensorDictBase]:
        """Fly one batch after the other."""
        while self._frames < self.total_frames:
            start = self.carry
            if start is not None and self.restart_fraction and self._frames:
                start = restart(self.env, start, self.restart_fraction)
            batch, self.carry = differentiable_rollout(
                self.env, self.policy, start, self.horizon, exploration_type=self.exploration_type
            )
            self._frames += batch.numel()
            yield batch

    def __len__(self) -> int:
        return -(self.total_frames // -self.frames_per_batch)

    def update_policy_weights_(self, policy_or_weights: Any = None, **given: Any) -> None:
        """Copy weights into the policy: those of a module, or a tensordict of them; without any it is up to date."""
        given |= given.get("weights_dict") or {}
        for weights in (policy_or_weights, given.get("weights"), given.get("policy")):
            if weights is not None:
                own = TensorDict.from_module(weights) if isinstance(weights, nn.Module) else TensorDict(weights)
                TensorDict.from_module(self.policy).data.update_(own.unflatten_keys(".").data)

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the environment; the next batch begins with a reset. Returns the seed for another environment."""
        self.carry = None
        return cast(int, self.env.set_seed(seed, static_seed=static_seed))

    def state_dict(self) -> dict[str, Any]:  # pyrefly: ignore[bad-override]  # TorchRL's is an OrderedDict
        """All that the collector needs to continue exactly, but torch's own random numbers, which the policy draws."""
        random = getattr(base_env(self.env), "random_state", dict)
        return {
            "frames": self._frames,
            "carry": None if self.carry is None else self.carry.to_dict(),
            "policy": self.policy.state_dict(),
            "env": self.env.state_dict(),
            "random": random(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], **_: Any) -> None:
        """Continue from what :meth:`state_dict` returned."""
        self._frames = state_dict["frames"]
        carry = state_dict["carry"]
        size = cast(torch.Size, self.env.batch_size)
        self.carry = None if carry is None else TensorDict(carry, size, device=self.env.device)
        self.policy.load_state_dict(state_dict["policy"])
        with torch.random.fork_rng([]):  # CatFrames has no place for its frames before a reset
            self.env.reset()
        self.env.load_state_dict(state_dict["env"])
        if state_dict["random"]:
            cast(Any, base_env(self.env)).set_random_state(state_dict["random"])

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        """Close the environment."""
        if close_env and not self.env.is_closed:
            self.env.close(raise_if_closed=raise_on_error)
