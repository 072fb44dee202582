"""The linear-quadratic problem within bounds that a step of Gauss-Newton solves, for a batch of drones."""

from __future__ import annotations

import torch
from torch import Tensor


def feedback(
    transition: Tensor,
    state_cost: Tensor,
    state_slope: Tensor,
    action_cost: Tensor,
    action_slope: Tensor,
    low: Tensor,
    high: Tensor,
) -> tuple[Tensor, Tensor]:
    """The actions u_t = k_t + K_t x_t that minimise a quadratic cost, by Riccati's recursion.

    The cost is the sum over t = 1..T of x_t' Q_t x_t / 2 + q_t' x_t, and over t = 0..T-1 of u_t' R u_t / 2 + r_t' u_t,
    where x_{t+1} = A_t x_t + B_t u_t. Where k_t would leave its bounds, it stops there, and the gains of that entry are
    zero; the other entries make the best of it (control-limited DDP of Tassa, Mansard and Todorov 2014, with one
    round of its active set).

    Args:
        transition: (T, n, s, s + m), A_t and B_t side by side.
        state_cost: (T, s), the diagonals of Q_1..Q_T.
        state_slope: (T, n, s), q_1..q_T.
        action_cost: (m), the diagonal of R, positive.
        action_slope: (T, n, m), r_0..r_{T-1}.
        low: (T, n, m), least values of k_t.
        high: (T, n, m), greatest values of k_t.

    Returns:
        k (T, n, m), and K (T, n, m, s).
    """
    s = transition.shape[-2]
    eye, penalty = torch.eye(len(action_cost)).to(transition), torch.diag(action_cost)
    value, slope = torch.diag(state_cost[-1]), state_slope[-1]
    steps, gains = [], []
    for t in reversed(range(len(transition))):
        pulled = transition[t].mT
        hessian = pulled @ value @ transition[t]
        gradient = (pulled @ slope.unsqueeze(-1)).squeeze(-1)
        of_actions, mixed = hessian[:, s:, s:] + penalty, hessian[:, s:, :s]
        slope_actions = gradient[:, s:] + action_slope[t]
        # Once without bounds; then with those entries held that have left theirs.
        step = -torch.linalg.solve_ex(of_actions, slope_actions.unsqueeze(-1))[0].squeeze(-1)
        held = ((step <= low[t]) | (step >= high[t])).unsqueeze(-1)
        stop = torch.where(held, step.clamp(low[t], high[t]).unsqueeze(-1), 0.0)
        wanted = torch.cat((slope_actions.unsqueeze(-1) + of_actions @ stop, mixed), -1)
        reduced = torch.where(held | held.mT, eye, of_actions)
        solution = -torch.linalg.solve_ex(reduced, torch.where(held, 0.0, wanted))[0]
        step = (solution[..., :1] + stop).squeeze(-1).clamp(low[t], high[t])
        gain = solution[..., 1:]
        steps.append(step)
        gains.append(gain)
        if t > 0:
            left = slope_actions.unsqueeze(-1) + of_actions @ step.unsqueeze(-1)
            slope = gradient[:, :s] + (mixed.mT @ step.unsqueeze(-1) + gain.mT @ left).squeeze(-1) + state_slope[t - 1]
            crossed = gain.mT @ mixed
            value = hessian[:, :s, :s] + gain.mT @ of_actions @ gain + crossed + crossed.mT
            # What rounding makes unsymmetric would grow from step to step.
            value = 0.5 * (value + value.mT) + torch.diag(state_cost[t - 1])
    return torch.stack(steps[::-1]), torch.stack(gains[::-1])
