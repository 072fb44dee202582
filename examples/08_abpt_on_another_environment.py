"""The losses work on any differentiable environment: ABPT from visited states swings up TorchRL's own pendulum."""

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import PendulumEnv, RewardScaling, TransformedEnv
from torchrl.modules import MLP
from torchrl.objectives import SoftUpdate

from torchrl_quad import ABPTLoss, VisitedStateBuffer, differentiable_rollout

ITERATIONS = 100

torch.manual_seed(0)
env = TransformedEnv(PendulumEnv(seed=0), RewardScaling(0.0, 0.02))  # returns near 1 are quicker to learn than near 100


def see(th, thdot):
    """The angle as cosine and sine, which do not jump at half a turn, and the speed."""
    return torch.stack((th.cos(), th.sin(), thdot / 8), -1)


features = TensorDictModule(see, ["th", "thdot"], ["features"])
policy = TensorDictModule(MLP(3, 1, num_cells=[64, 64]), ["features"], ["action"])
torque = TensorDictModule(lambda x: 2 * x.tanh(), ["action"], ["action"])  # [N m]
actor = TensorDictSequential(features, policy, torque)
critic = TensorDictModule(MLP(4, 1, num_cells=[64, 64]), ["features", "action"], ["state_action_value"])
loss = ABPTLoss(actor, TensorDictSequential(features, critic))
loss.make_value_estimator(gamma=0.98, lmbda=0.95)
target = SoftUpdate(loss, tau=0.05)
optimizer = torch.optim.Adam(loss.parameters(), 5e-3)
buffer = VisitedStateBuffer(capacity=20_000, env=env)  # keeps th, thdot and params: env.state_keys


def starts(n):
    """Pendulums at random angles, under half the gravity of the Earth: they still have to swing to get up."""
    return env.reset(env.gen_params(g=5.0, batch_size=[n]), set_state=False).select(*buffer.state_keys)


def swing_up():
    """How many of 100 pendulums that hang down are upright after 10 s [%]."""
    hanging = starts(100)
    hanging["th"] = torch.pi + torch.linspace(-0.2, 0.2, 100)
    flight, _ = differentiable_rollout(env, actor, env.reset(hanging, set_state=True), 200)
    return 100 * (flight["next", "th"][:, -1].abs() < 0.3).double().mean()


print(f"before: {swing_up():.0f} % swing up")
carry = env.reset(starts(64), set_state=True)
for _ in range(ITERATIONS):
    rollout, _ = differentiable_rollout(env, actor, carry, 40)
    out = loss(rollout)
    optimizer.zero_grad()
    (out["loss_actor"] + out["loss_qvalue"]).backward()
    optimizer.step()
    target.step()
    buffer.extend(rollout)
    carry = env.reset(torch.cat((starts(32), buffer.sample(32).select(*buffer.state_keys))), set_state=True)
print(f"after:  {swing_up():.0f} % swing up")
