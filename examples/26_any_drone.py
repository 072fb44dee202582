"""Train one policy that flies every quadrotor: it finds out in flight, from its memory, which one it flies."""

import torch
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import SoftUpdate

from torchrl_quad import HoveringEnv, SHACLoss, differentiable_rollout, make_actor, make_value, restart

ITERATIONS = 300
ANY = {
    "drone": "cf2x",  # the order of its rotors; nothing else of it
    "randomize": "any",  # mass, size, thrust, lag and delay are drawn for each episode
    "control": "rotor_thrusts",  # -1 to 1 is all that the rotors of the drawn drone can give
    "control_dt": 0.01,  # [s]
    "observe_last_action": True,
    "max_episode_steps": 500,
    "random_start": {"tilt": 0.6, "velocity": 1.0, "angular_velocity": 1.0},
    "weights": {"position": 0.06, "velocity": 0.004},
}

torch.manual_seed(0)
env = HoveringEnv(num_envs=64, **ANY)
actor = make_actor(env, recurrent=True, hidden_size=24, num_cells=[24], input_scale=0.5, scale_init=0.03)
# The critic may know the drone: it is needed in training only. The policy has to remember how the drone answered.
value = make_value(env, in_keys=["observation", ("state", "traits")], input_scale=[0.5, 1.0])
loss = SHACLoss(actor, value)
loss.make_value_estimator(gamma=0.99, lmbda=0.95)
actor_optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), 5e-3, betas=(0.9, 0.99))
critic_optimizer = torch.optim.Adam(loss.value_network_params.parameters(), 5e-3)
target = SoftUpdate(loss, tau=0.05)
carry = env.reset()
for _ in range(ITERATIONS):
    rollout, end = differentiable_rollout(env, actor, carry, 32)
    actor_optimizer.zero_grad()
    loss.loss_actor(rollout)[0].backward()
    torch.nn.utils.clip_grad_norm_(loss.actor_network_params.parameters(), 0.5)
    actor_optimizer.step()
    data = loss.write_value_target(rollout.detach())
    for _ in range(4):
        critic_optimizer.zero_grad()
        loss.loss_value(data)[0].backward()
        critic_optimizer.step()
        target.step()
    carry = restart(env, end, 0.1)  # the others go on with their flight, and remember it

test = HoveringEnv(num_envs=128, seed=1, **ANY)
with torch.no_grad():
    flight, _ = differentiable_rollout(test, actor, None, 500, exploration_type=ExplorationType.DETERMINISTIC)
result, numbers = test.episode_metrics(flight), sum(x.numel() for x in actor.parameters())
mass = flight["state", "drone", "mass"][:, 0]
print(f"{numbers} numbers fly drones of {mass.min():.2f} to {mass.max():.2f} kg that they have never flown:")
print(f"solved {result['solved'].mean():.0%}, median error {100 * result['position_error'].median():.0f} cm")
