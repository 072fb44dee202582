"""What lies under an environment's transforms."""

from torchrl.envs import EnvBase, TransformedEnv


def base_env(env: EnvBase) -> EnvBase:
    """The innermost environment, under all transforms; the environment itself where there are none."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env
