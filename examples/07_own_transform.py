"""Write a transform between task and policy that gradients pass: the target in the drone's body frame."""

import torch
from torchrl.data import Unbounded
from torchrl.envs import Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_quad import HoveringEnv, differentiable_rollout, make_actor
from torchrl_quad.dynamics import quaternion


class TargetInBody(Transform):
    """Adds ``target_in_body`` (3) [m]: the way to the target in the drone's own axes, forward, left and up."""

    def __init__(self):
        super().__init__(in_keys=["state"], out_keys=["target_in_body"])

    def _call(self, tensordict):
        state = tensordict["state"]
        way = state["target"] - state["position"]
        # Plain differentiable operations, and a new entry: nothing is written in place, nothing is detached.
        return tensordict.set("target_in_body", quaternion.rotate_inverse(state["quaternion"], way))

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        position = observation_spec["state", "position"]
        observation_spec["target_in_body"] = Unbounded(position.shape, device=position.device, dtype=position.dtype)
        return observation_spec


torch.manual_seed(0)
# Tilted drones, whose axes differ from the world's; in double precision, for the finite difference.
drones = HoveringEnv(num_envs=8, dtype=torch.float64, random_start={"tilt": 1.0, "yaw": 3.0})
env = TransformedEnv(drones, TargetInBody())
actor = make_actor(env, in_keys=["target_in_body", ("state", "quaternion"), ("state", "velocity")], input_scale=1.0)

start = env.reset()


def total_reward():
    """Of 32 steps, from the same start and with actions without noise."""
    flight, _ = differentiable_rollout(env, actor, start, 32, exploration_type=ExplorationType.DETERMINISTIC)
    return flight["next", "reward"].sum()


# The policy sees the target only through the transform, so the derivative passes it at each of the 32 steps.
weight = next(actor.parameters())  # of the first layer: its first column multiplies the way forward
(gradient,) = torch.autograd.grad(total_reward(), weight)
with torch.no_grad():
    weight[0, 0] += 1e-5
    more = total_reward()
    weight[0, 0] -= 2e-5
    less = total_reward()
print("the target of the first drone:", [f"{x:.2f}" for x in start["target_in_body"][0]], "m forward, left, up")
print(f"gradient {gradient[0, 0]:.9f}, finite difference {(more - less) / 2e-5:.9f}")
