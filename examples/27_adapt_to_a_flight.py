"""Fly a policy on a drone with a weak rotor, in wind, and adapt it to what the flight shows, again and again."""

import torch
from torchrl.envs.utils import ExplorationType

from torchrl_quad import BPTTLoss, HoveringEnv, differentiable_rollout, make_actor, restart
from torchrl_quad.adaptation import Adapter, simulated_log
from torchrl_quad.dynamics import MotorCommand

ITERATIONS = 60
FLIGHTS = 2

torch.manual_seed(0)
env = HoveringEnv(num_envs=64)
actor = make_actor(env, input_scale=0.5)
loss = BPTTLoss(actor).make_value_estimator(gamma=0.99)
optimizer = torch.optim.Adam(actor.parameters(), 2e-2, betas=(0.7, 0.95))
schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, ITERATIONS)
carry = None
for _ in range(ITERATIONS):
    rollout, carry = differentiable_rollout(env, actor, carry, 64)
    optimizer.zero_grad()
    loss(rollout)["loss_actor"].backward()
    torch.nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
    optimizer.step()
    schedule.step()
    carry = restart(env, carry, 0.5)

# What it meets: a rotor that gives four fifths, three that are a little worn, and wind. Nobody tells the policy.
real = HoveringEnv(num_envs=16, seed=1, wind={"mean": [4.0, -2.0, 0.0]})
real.params = real.params.replace(rotor_effectiveness=[0.95, 0.8, 0.95, 0.95])
motors = MotorCommand(float(real.params.rotor_speed_max), 1.0)  # its logs hold speeds of rotors, as shares of this
adapter = Adapter(actor, env, motors, steps=ITERATIONS)
for flight_number in range(FLIGHTS + 1):
    with torch.no_grad():
        kind = ExplorationType.DETERMINISTIC
        flight, _ = differentiable_rollout(real, adapter.policy, None, 256, exploration_type=kind)
    print(f"flight {flight_number}: error {100 * real.episode_metrics(flight)['position_error'].median():.1f} cm")
    if flight_number < FLIGHTS:
        found = adapter([simulated_log(flight, real, drone) for drone in range(2)])
        print(found.reason)
        if found.fit is not None:
            print("each rotor gives", found.fit.fields(found.fit.mean)["rotor_effectiveness"].tolist())
