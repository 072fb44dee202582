"""What lies under an environment's transforms, and in a policy's memory."""

from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.envs import EnvBase, TransformedEnv


def base_env(env: EnvBase) -> EnvBase:
    """The innermost environment, under all transforms; the environment itself where there are none."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def memory_keys(policy: TensorDictModuleBase) -> tuple[NestedKey, ...]:
    """The entries in which a recurrent policy remembers: it reads them, and writes them below "next"; often none."""
    written = set(map(unravel_key, policy.out_keys))
    return tuple(key for key in policy.in_keys if unravel_key(("next", key)) in written)
