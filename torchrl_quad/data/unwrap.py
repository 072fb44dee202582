"""What lies under an environment's transforms, and in a policy's memory."""

from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.envs import Compose, EnvBase, TransformedEnv

from torchrl_quad.errors import UserTypeError, UserValueError


def require_env(env: EnvBase) -> None:
    """Refuse what is no environment.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(env, EnvBase):
        raise UserTypeError(
            f"env must be a TorchRL environment, such as make_env('hovering', num_envs=64); got {type(env).__name__}."
        )


def base_env(env: EnvBase) -> EnvBase:
    """The innermost environment, under all transforms; the environment itself where there are none."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def require_whole_state(env: EnvBase) -> None:
    """Refuse transforms that change the state from which the next step starts.

    Raises:
        ValueError: a transform leaves out a part of it, or overwrites one and does not undo that before the step.
    """
    base = base_env(env)
    state = set(map(unravel_key, base.state_keys))
    lost = state & {*base.observation_spec.keys(True, True)} - {*env.observation_spec.keys(True, True)}
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
