"""Write a dynamics model as one class: a drone whose autopilot follows velocity commands."""

import torch

from torchrl_quad import BPTTLoss, HoveringEnv, differentiable_rollout, make_actor
from torchrl_quad.dynamics import DYNAMICS, quaternion
from torchrl_quad.dynamics.vector import Components, cat, stack

ITERATIONS = 40


class VelocityDrone:
    """Always level; its velocity approaches the command (3) [m/s] in 0.3 s. The fourth number does nothing."""

    sizes = {"position": 3, "quaternion": 4, "velocity": 3, "angular_velocity": 3}
    plant_fields, limits, time_constant, top_speed = (), {}, 0.3, 3.0

    def __init__(self, nominal, dt, substeps, integrator):
        self.nominal, self.dt, self.substeps = nominal.detach(), dt, substeps
        self.hover_action = torch.zeros(4, dtype=nominal.mass.dtype, device=nominal.mass.device)

    def rest(self, position):
        still, level = torch.zeros_like(position), quaternion.identity(position)
        return {"position": position, "quaternion": level, "velocity": still, "angular_velocity": still.clone()}

    def physics_step(self, position, velocity, command):  # tensors (n, 3) or Components: both know + and *
        velocity = velocity + (command - velocity) * (self.dt / self.time_constant)
        return position + velocity * self.dt, velocity

    def control_step(self, state, action, params, wind):
        position, velocity, command = state["position"], state["velocity"], self.setpoint_rows(action).t()
        for _ in range(self.substeps):
            position, velocity = self.physics_step(position, velocity, command)
        return {**{key: state[key] for key in self.sizes}, "position": position, "velocity": velocity}

    def setpoint_rows(self, action):
        return self.top_speed * action[:, :3].clamp(-1, 1).t()

    def rows_step(self):
        def step(x, setpoint, plant, wind):
            x, command = Components(x.unbind()), Components(setpoint.unbind())
            position, velocity = self.physics_step(x[..., :3], x[..., 7:10], command)
            return stack(cat(position, x[..., 3:7], velocity, x[..., 10:]))

        return step


torch.manual_seed(0)
DYNAMICS["velocity"] = VelocityDrone
env = HoveringEnv(num_envs=64, dynamics="velocity", dt=0.02)
actor = make_actor(env, input_scale=0.5)
loss, optimizer = BPTTLoss(actor), torch.optim.Adam(actor.parameters(), 1e-2)
for _ in range(ITERATIONS):
    rollout, _ = differentiable_rollout(env, actor, None, 40)
    optimizer.zero_grad()
    loss(rollout)["loss_actor"].backward()
    optimizer.step()
    print(f"{rollout['next', 'metrics', 'position_error'][:, -1].median():.2f} m from the target after 0.8 s")
