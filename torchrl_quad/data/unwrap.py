"""What lies under an environment's transforms and in a policy's memory, and entries with their types."""

from collections.abc import Iterable
from typing import Any, cast

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Compose, EnvBase, TransformedEnv

from torchrl_quad.errors import UserTypeError, UserValueError


def leaf(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """An entry that is a tensor, as type checkers cannot know."""
    return cast(Tensor, tensordict.get(key))


def group(tensordict: TensorDictBase, key: NestedKey) -> TensorDictBase:
    """An entry that is a tensordict, as type checkers cannot know."""
    return cast(TensorDictBase, tensordict.get(key))


def observed(env: EnvBase) -> Composite:
    """The spec of what an environment observes, with its type."""
    return cast(Composite, env.observation_spec)


def state_keys(env: EnvBase) -> list[NestedKey]:
    """The entries that make up the Markov state of an environment, under all transforms."""
    return list(cast(Iterable[NestedKey], base_env(env).state_keys))


def check_env(env: EnvBase) -> None:
    """Raise a UserTypeError for what is no environment."""
    if not isinstance(env, EnvBase):
        raise UserTypeError(
            f"env must be a TorchRL environment, such as make_env('hovering', num_envs=64); got {type(env).__name__}."
        )


def check_actor(actor: TensorDictModuleBase, name: str) -> None:
    """Raise a UserTypeError for what is no policy."""
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


def check_tensordict(name: str, rollout: Any) -> None:
    """Raise a UserTypeError for what is no tensordict; ``name`` is what needs one."""
    if not isinstance(rollout, TensorDictBase):
        raise UserTypeError(
            f"{name} needs a rollout, the tensordict that differentiable_rollout returns; got {type(rollout).__name__}."
        )


def base_env(env: EnvBase) -> EnvBase:
    """The innermost environment, under all transforms; the environment itself where there are none."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def check_whole_state(env: EnvBase) -> None:
    """Raise a UserValueError for transforms that drop or overwrite a part of the state, without undoing that."""
    base = base_env(env)
    state = set(map(unravel_key, state_keys(base)))
    lost = state & {*observed(base).keys(True, True)} - {*observed(env).keys(True, True)}
    if lost:
        raise UserValueError(
            f"A transform leaves out {min(lost, key=str)!r}, and every step would start where the first one did. No "
            "transform may drop a part of the state, from which the next step starts: let SelectTransform keep it, too."
        )
    while isinstance(env, TransformedEnv):
        for transform in env.transform if isinstance(env.transform, Compose) else [env.transform]:
            kept = set(map(unravel_key, transform.in_keys_inv))
            for key in sorted(state & set(map(unravel_key, transform.out_keys)) - kept, key=str):
                raise UserValueError(
                    f"{type(transform).__name__} overwrites {key!r}, from which the next step starts, and so changes "
                    f"the flight. Write into another entry: out_keys=[...], or CatTensors([{key!r}], 'features', "
                    "del_keys=False) before it."
                )
        env = env.base_env


def memory_keys(policy: TensorDictModuleBase) -> tuple[NestedKey, ...]:
    """The entries in which a recurrent policy remembers: it reads them, and writes them below "next"; often none."""
    written = set(map(unravel_key, policy.out_keys))
    return tuple(key for key in policy.in_keys if unravel_key(("next", key)) in written)
