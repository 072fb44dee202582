"""Rollouts that keep their graph."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type


def differentiable_rollout(
    env: EnvBase,
    actor: TensorDictModuleBase,
    carry: TensorDictBase | None,
    horizon: int,
    *,
    exploration_type: ExplorationType = ExplorationType.RANDOM,
) -> tuple[TensorDictBase, TensorDictBase]:
    """Fly a horizon, and keep the graph from every reward back to every action.

    Environments that finish are reset on the way; the gradient is cut exactly there, and ``"next"`` keeps the true last
    state. Works for any differentiable TorchRL environment and any stack of transforms.

    Args:
        env: the environment.
        actor: a TensorDictModule that writes the action.
        carry: where to start: from ``env.reset()``, the last call, or a visited-state buffer. It is not modified. None
            resets the environment.
        horizon: number of control steps, at least 1.
        exploration_type: RANDOM samples the policy, DETERMINISTIC takes its mode.

    Returns:
        the rollout, of batch size (env.batch_size, horizon), and the carry to go on from: detached, and reset where the
        rollout ended done.

    Raises:
        ValueError: the horizon is less than 1.
        TypeError: the actor is not a TensorDictModule.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1 control step, got {horizon}.")
    if not isinstance(actor, TensorDictModuleBase):
        raise TypeError(
            f"actor must be a TensorDictModule that writes the action, got {type(actor).__name__}. "
            'Wrap a plain module: TensorDictModule(module, in_keys=["observation"], out_keys=["action"]).'
        )
    carry = env.reset() if carry is None else carry.copy()
    with set_exploration_type(exploration_type):
        rollout = env.rollout(horizon, actor, tensordict=carry, auto_reset=False, break_when_any_done=False)
    return rollout, env.maybe_reset(env.step_mdp(rollout[..., -1]).detach().clone())
