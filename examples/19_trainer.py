"""Train with TorchRL's Trainer: its hooks clip, log, save and schedule; the collector keeps the graph.

Every collector of TorchRL cuts the graph between actions and rewards. DifferentiableCollector yields horizons that have
it, so that the Trainer's one step of the optimizer for each batch follows the gradient through the dynamics.
"""

import torch
from torchrl.envs.utils import ExplorationType
from torchrl.trainers import DefaultOptimizationStepper, LRSchedulerHook, Trainer

from torchrl_quad import BPTTLoss, DifferentiableCollector, HoveringEnv, differentiable_rollout, make_actor

ITERATIONS = 60
HORIZON = 64

torch.set_num_threads(1)
torch.manual_seed(0)
env = HoveringEnv(num_envs=64, seed=0, dt=0.01)
actor = make_actor(env, input_scale=0.5)
optimizer = torch.optim.Adam(actor.parameters(), 2e-2, betas=(0.7, 0.95))
schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, ITERATIONS)

frames = env.num_envs * HORIZON
total = ITERATIONS * frames
collector = DifferentiableCollector(env, actor, frames_per_batch=frames, total_frames=total, restart_fraction=0.5)
trainer = Trainer(
    collector=collector,
    total_frames=total,
    frame_skip=1,
    optim_steps_per_batch=1,  # backward frees the graph of a batch
    loss_module=BPTTLoss(actor).make_value_estimator(gamma=0.99),
    optimizer=optimizer,
    optimization_stepper=DefaultOptimizationStepper(),
    clip_norm=0.5,
    progress_bar=False,
)
LRSchedulerHook(schedule).register(trainer)
rewards = []
trainer.register_op("pre_steps_log", lambda batch: rewards.append(batch["next", "reward"].mean().item()))
trainer.train()

print(f"reward per step: {rewards[0]:.4f} in the first batch, {rewards[-1]:.4f} in the last")
with torch.no_grad():
    flight, _ = differentiable_rollout(env, actor, None, 256, exploration_type=ExplorationType.DETERMINISTIC)
result = env.episode_metrics(flight)
print(f"solved {100 * result['solved'].mean():.0f} %, error {100 * result['position_error'].median():.1f} cm")
