"""Traps of a task: what keeps a policy from learning it, each in a sentence with its remedy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.objectives.calls import total

# Entries of the state that jump for other reasons than a task's.
_OF_THE_ENVIRONMENT = {"position", "velocity", "quaternion", "angular_velocity", "rotor_speed", "action_queue", "step"}
_OF_THE_ENVIRONMENT |= {"collided", "drone", "scene", "wind", "traits", "delay"}


def jumping_targets(reward: Tensor, done: Tensor, state: Any) -> Iterator[str]:
    """A target that jumps: an entry of the state that changes in one step and not beside it, nor by a clock."""
    reward, done = (x.reshape(-1, x.shape[-2]) for x in (reward, done))
    jumps, names, falls, usual = set(), [], [], 0.25 * (reward.quantile(0.9) - reward.quantile(0.1))
    within = ~(done[:, :-3] | done[:, 1:-2] | done[:, 2:-1])
    step = None if state is None else state.get("step", None)
    if not isinstance(step, Tensor) or step.numel() != reward.numel():  # not of ours: the step of the rollout
        step = torch.ones_like(reward).cumsum(1)
    step = step.reshape(reward.shape)[:, 2:-1]
    for name, change in _changes(state, reward):
        alone = change[:, 1:-1] > 10.0 * torch.maximum(change[:, :-2], change[:, 2:]) + 1e-6
        alone &= within
        # In one step of the episode in at least four flights, nine tenths of them, it is a clock.
        for time in step[alone].unique():
            then = within & (step == time)
            if then.sum() >= 4 and alone[then].double().mean() >= 0.9:
                alone &= ~then
        if alone.any():
            names, jumps = [*names, name], jumps | {(i, t + 2) for i, t in alone.nonzero().tolist()}
    for i, t in jumps:
        ends = [k for k in range(t + 1, reward.shape[1]) if done[i, k - 1] or (i, k) in jumps]
        before, after = reward[i, t - 1], reward[i, t : min(ends, default=None)]
        fell = before - reward[i, t + 1]
        if fell > usual + 5.0 * (before - reward[i, t - 2]).abs() and (after - before).sum() < 0.0:
            falls.append((before.item(), reward[i, t + 1].item()))
    if len(falls) > 0.5 * len(jumps):
        before, after = (sum(x) / len(falls) for x in zip(*falls, strict=True))
        yield (
            f"{', '.join(names)} jumped {len(jumps)} times, and a step then paid {after:.3g} instead of {before:.3g}: "
            "if a drone that waits there is paid the same, waiting pays more than arriving. If so, reward the "
            "velocity towards the target, or the arrival"
        )


def _changes(state: Any, reward: Tensor) -> Iterator[tuple[str, Tensor]]:
    """How far each entry of the state that is the task's own moves from step to step, (flights, horizon - 1)."""
    for name, x in () if state is None else state.flatten_keys("/").items():
        if name.partition("/")[0] not in _OF_THE_ENVIRONMENT and x.shape[: state.ndim] == state.shape:
            yield name, x.detach().to(reward).reshape(*reward.shape, -1).diff(dim=1).norm(dim=-1)


def paid_arrivals(name: str, term: Tensor, done: Tensor, state: Any) -> Iterator[str]:
    """A term that rises where an entry of the task's state changes, and pays as much in each later step."""
    term, done = (x.reshape(-1, x.shape[-2]) for x in (term.detach(), done))
    rise, within = term.diff(dim=1), ~done[:, :-1]
    rises = (rise > 0.0) & within
    if not rises.any() or ((rise < 0.0) & within).any():
        return
    if entries := [entry for entry, change in _changes(state, term) if torch.equal(rises, (change > 0.0) & within)]:
        yield (
            f"{name!r} pays for each change of {', '.join(map(repr, entries))} in every later step, which drowns terms "
            "with a gradient: pay once, in the step of the change"
        )


def costly_ends(reward: Tensor, ends: Mapping[str, Tensor], collided: Tensor, steps: float) -> Iterator[str]:
    """Ends of episodes that pay more than going on, and successes that pay less."""
    never = torch.zeros_like(reward, dtype=torch.bool)
    terminated, success, crash = (ends.get(name, never) for name in ("terminated", "success", "crash"))
    won = terminated & success & ~crash
    died = terminated & ~won
    alive = reward[~terminated]
    usual = alive.mean().item()
    cost = reward[died].mean().item() if died.any() else 0.0
    losing = (alive < 0.0).double().mean().item() > 0.9  # else a policy soon finds steps that pay
    if ("crash" in ends or died.any()) and losing and cost > steps * usual:
        cheap = f"must cost more than {-steps * usual:.3g}, else dying is"
        cheap = f"pays {cost:.3g}: dying is" if died.any() else cheap
        yield (
            f"as this policy flies a step pays {usual:.3g} on average, {steps * usual:.3g} in {steps:.0f} steps, and a "
            f"crash {cheap} cheap. Add a constant, so that a good step pays more than nothing, or let a crash cost more"
            + ("; these were collisions, which state['collided'] tells" if died.any() and collided[died].all() else "")
        )
    if success.all():
        yield "success is true in every step: an untrained policy solves the task. Ask for more in is_success"
    before, ended = reward[..., :-1, :][won[..., 1:, :]], reward[..., 1:, :][won[..., 1:, :]]
    if len(before) and (loitering := steps * before.mean().item()) > ended.mean().item():
        yield (
            f"success ends an episode and pays {ended.mean().item():.3g}, while going on as in the step before it pays "
            f"{loitering:.3g} in {steps:.0f} steps: loitering pays more. Let success pay more, or the episode go on"
        )


def large_observations(observation: Any) -> Iterator[str]:
    """Entries of the observation that drown the others in a network."""
    if isinstance(observation, Tensor) and observation.is_floating_point():
        size = observation.detach().abs().flatten(0, -2).mean(0)
        if large := (size > 100.0).nonzero().flatten().tolist():
            which = ", ".join(f"{i} ({size[i]:.3g})" for i in large[:5])
            yield (
                f"the observation has entries of more than a hundred in the mean: {which}. They drown the others: "
                "scale each to about one, and leave out what never changes"
            )


def flat_terms(name: str, term: Tensor, returns: Tensor, grads: Sequence[Tensor | None]) -> Iterator[str]:
    """A term that has no gradient in the actions of most flights: of those that it pays least."""
    squares = [g.square().sum(-1) for g in grads if g is not None]  # of each step, or of all steps first
    size = total(x.sum(0) if x.dim() > returns.dim() else x for x in squares) if squares else returns.new_zeros(())
    if size.shape != returns.shape:
        return
    flat = size < 1e-6 * size.max()
    paid = (term[~flat] != 0).float().mean() > 0.5  # in each step: a bonus for an event is another matter
    if paid and 2 * flat.sum() >= flat.numel() and returns[flat].mean() < returns[~flat].mean():
        yield (
            f"{name!r} is flat in {flat.float().mean():.0%} of the flights, those in which it pays least: it leads "
            "nobody there. Reward a distance, or its logarithm, and nothing that saturates far from the goal"
        )
