"""Rollouts that keep their graph."""

from __future__ import annotations

import os

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import expand_as_right, unravel_key
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_quad.data.normalizer import NormalizedPolicy, ObservationNormalizer
from torchrl_quad.data.unwrap import base_env, check_env, check_whole_state, memory_keys
from torchrl_quad.errors import UserTypeError, UserValueError, shown
from torchrl_quad.options import Horizon, checked


@checked
def differentiable_rollout(
    env: EnvBase,
    actor: TensorDictModuleBase,
    carry: TensorDictBase | None,
    horizon: Horizon,
    *,
    exploration_type: ExplorationType = ExplorationType.RANDOM,
) -> tuple[TensorDictBase, TensorDictBase]:
    """Fly a horizon, and keep the graph from every reward back to every action.

    Environments that finish are reset on the way. The gradient is cut exactly there, and ``"next"`` keeps the true last
    state. The rollout is the environment's own ``rollout``, so this works for any differentiable TorchRL environment
    and any stack of transforms. The gradient also goes through the memory of a recurrent actor, which is cleared where
    an episode begins, and cut there.

    Args:
        env: the environment.
        actor: a TensorDictModule that writes the action.
        carry: the reset tensordict to start from: of ``env.reset()``, the last call, ``restart`` or a visited-state
            buffer. It is not modified. None resets the environment.
        horizon: control steps of the rollout.
        exploration_type: RANDOM samples the policy, DETERMINISTIC takes its mode.

    Returns:
        the rollout, of batch size (*env.batch_size, horizon), and the carry to go on from: detached, and reset in the
        environments whose last step was done.

    Raises:
        ValueError: the horizon is out of its range, or its rollout larger than the memory; the actor reads an entry
            that nobody writes, or a transform overwrites or leaves out a part of the state.
        TypeError: ``env`` is no environment, the actor is not a TensorDictModule, or the carry is not a tensordict.
    """
    check_env(env)
    require_exploration(exploration_type)
    require_actor(actor, "actor")
    if not (carry is None or isinstance(carry, TensorDictBase)):
        raise UserTypeError(
            f"carry must be the tensordict to start from, or None to reset the environment; got {type(carry).__name__}."
        )
    try:
        check_whole_state(env)
        carry = env.reset() if carry is None else carry.copy()
        _require_start(env, actor, carry)
        if carry.numel() * horizon > 1_000_000:
            _require_memory(carry, horizon)
        with set_exploration_type(exploration_type):
            rollout = _rollout(env, actor, carry, horizon)
    except KeyError as error:
        if "not found in the environment outputs" in str(error):
            raise UserValueError(
                f"ExcludeTransform: {error.args[0]} TorchRL's transform leaves out single entries, and no groups: name "
                'each, such as ("reward_terms", "velocity"). Keep the state, from which the next step starts.'
            ) from error
        missing = [key for key in actor.in_keys if carry is not None and key not in carry]
        if not missing:
            raise
        if set(missing) & {*memory_keys(actor), "is_init"}:
            raise UserValueError(
                f"The actor remembers, and the tensordict it starts from has no {missing[0]!r}. Give the environment "
                "TorchRL's transforms: Compose(InitTracker(), module.make_tensordict_primer())."
            ) from error
        raise UserValueError(
            f"The actor reads {missing[0]!r}, which is not in the tensordict it starts from. Choose its in_keys from "
            f"what env.reset() writes: {', '.join(map(str, env.observation_spec.keys(True, True)))}."
        ) from error
    base = base_env(env)
    # Transforms such as CatFrames keep past observations in buffers, with their graph.
    for buffer in env.buffers():
        if not buffer.is_leaf:
            buffer.detach_()
    if (shared := getattr(base, "shared_tensordict_parent", None)) is not None:  # of SerialEnv
        shared.detach_()
    end = env.step_mdp(rollout[..., -1]).detach().clone()
    specs = (*env.observation_spec.keys(True, True), *env.state_spec.keys(True, True), *env.action_keys)
    known = set(map(unravel_key, specs))
    written = end.select(*(key for key in actor.out_keys if unravel_key(key) not in known), strict=False).clone()
    # A reset keeps nothing that it does not know, such as noise, and an environment with a state of its own its graph.
    carry = env.maybe_reset(end).detach().update(written)
    done = rollout["next", "done"][..., -1, :]
    for key in memory_keys(actor):
        memory = rollout[..., -1].get(unravel_key(("next", key))).detach()
        carry.set(key, torch.where(expand_as_right(done.squeeze(-1), memory), 0.0, memory))
        carry.set("is_init", done.clone())
    return rollout, carry


def _require_start(env: EnvBase, actor: TensorDictModuleBase, carry: TensorDictBase) -> None:
    """Refuse a tensordict of another batch size, device or precision than those of the environment."""
    if env.batch_locked and carry.batch_size != env.batch_size:
        raise UserValueError(
            f"carry has batch size {tuple(carry.batch_size)}, and the environment {tuple(env.batch_size)}. Start from "
            "the tensordict of its own reset(), or of its last rollout."
        )
    for key in actor.in_keys:
        x, spec = carry.get(key, None), env.observation_spec.get(key, None)
        if x is None or spec is None or (x.dtype == spec.dtype and (env.device is None or x.device == env.device)):
            continue
        raise UserValueError(
            f"{key!r} of the carry is {x.dtype} on {x.device}, and that of the environment {spec.dtype} on "
            f"{env.device}. Start from the tensordict of its own reset(), or of its last rollout."
        )


def _require_memory(carry: TensorDictBase, horizon: int) -> None:
    """Refuse a rollout whose entries alone, without their graph, are larger than the memory."""
    needed = 2 * horizon * sum(x.numel() * x.element_size() for x in carry.values(True, True))
    if carry.device is not None and carry.device.type == "cuda":
        has = torch.cuda.get_device_properties(carry.device).total_memory
    elif hasattr(os, "sysconf"):
        has = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    else:
        return
    if needed > has:
        raise UserValueError(
            f"A rollout of {horizon:,} steps of {carry.numel():,} environments takes more than {needed / 1e9:,.0f} GB, "
            f"and there are {has / 1e9:,.0f}. Fly far fewer than {horizon * has // needed:,} steps at a time, or fewer "
            "environments."
        )


def require_actor(actor: TensorDictModuleBase, name: str) -> None:
    """Refuse what is no policy.

    Raises:
        TypeError: it is not a TensorDictModule.
    """
    if hasattr(actor, "_orig_mod"):
        raise UserTypeError(
            f"torch.compile({name}) is no TensorDictModule. Write {name}.compile() instead, which compiles it in "
            "place, or give the environment compile=True, which compiles the whole horizon."
        )
    if not isinstance(actor, TensorDictModuleBase):
        raise UserTypeError(
            f"{name} must be a TensorDictModule that writes the action, got {type(actor).__name__}. "
            'Wrap a plain module: TensorDictModule(module, in_keys=["observation"], out_keys=["action"]).'
        )


def require_exploration(kind: ExplorationType) -> None:
    """Refuse what is no way to explore."""
    if not isinstance(kind, ExplorationType):
        names = ", ".join(f"ExplorationType.{x.name}" for x in ExplorationType)
        raise UserValueError(f"exploration_type must be one of {names}; got {shown(kind)}.")


def _rollout(env: EnvBase, actor: TensorDictModuleBase, start: TensorDictBase, horizon: int) -> TensorDictBase:
    """The environment's own rollout.

    Where its only transform is our normaliser, the environment inside flies, which may do so compiled, and what it
    observed is normalised afterwards.
    """
    options = {"auto_reset": False, "break_when_any_done": False}
    if not (isinstance(env, TransformedEnv) and type(env.transform) is ObservationNormalizer):
        return env.rollout(horizon, actor, tensordict=start, **options)
    normalizer = env.transform
    (key,) = normalizer.in_keys
    if key in start:  # otherwise the environment complains
        start.set(key, normalizer.undo(start.get(key)))
    rollout = env.base_env.rollout(horizon, NormalizedPolicy(actor, normalizer), tensordict=start, **options)
    for name in (key, ("next", key)):
        rollout.set(name, normalizer.normalize(rollout.get(name)))
    return rollout
