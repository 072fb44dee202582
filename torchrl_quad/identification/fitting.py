"""Damped Gauss-Newton steps on the predictions of all windows at once, and how certain their result is."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.func import jacfwd
from torch.nn.functional import one_hot

from torchrl_quad.identification.parameters import UNKNOWNS, Model
from torchrl_quad.identification.prediction import Windows, differences, states_at

ROBUST = 3.0  # standard deviations, from which a residual counts less and less
POINTS = 5  # times in a window at which predictions are compared
MAX_ITERATIONS = 30
CONVERGED = 1e-3  # change of the coordinates in a step

# The least that a residual is whitened by: position [m], velocity [m/s], attitude [rad], body rate [rad/s]; and the
# constant force [m/s2].
_FLOOR = (1e-4, 1e-3, 1e-4, 1e-3)
_PUSH_FLOOR = 1e-2


@dataclasses.dataclass
class State:
    """Where a fit stands; plain tensors, so that it can be saved and resumed."""

    free: tuple[str, ...]
    x: Tensor  #: (n), coordinates of the drone
    streams: Tensor  #: (L) [s], delays of the on-board clocks
    damping: float = 1e-3
    iteration: int = 0
    cost: float = math.inf
    converged: bool = False
    scale: Sequence[float] | None = None  #: (m), of the residuals; found in the first iterations


@dataclasses.dataclass
class Problem:
    """The windows of some flights and a model whose predictions are to fit them.

    A window starts in its measured state, so its length decides how far errors of the model can grow. Residuals are
    whitened by their own spread (median) at each time of the window, and count robustly (pseudo-Huber). The constant
    pushes before the windows are residuals, too: a model that needs none is the better one.
    """

    model: Model
    windows: Windows
    moves_streams: bool
    counts_push: bool
    scale: Tensor = dataclasses.field(default_factory=lambda: torch.empty(0))  #: (m), of the residuals, once found

    def raw(self, x: Tensor, shift: Tensor, streams: Tensor) -> Tensor:
        """All residuals (W, m): errors (POINTS, 4, 3), the push before a window (2, 3), and of the gyro (POINTS, 3).

        ``shift`` () [s] moves the stream delays of all logs (L), so that one derivative serves each of them.
        """
        windows = self.windows
        plant = self.model.plant(x, (streams + shift)[windows.log])
        speed = windows.rotor_speed(plant)
        push = windows.push(plant, speed)
        seen = windows.measured(plant.stream_delay, torch.arange(0, windows.future + 1, windows.stride))
        flown = windows.fly(plant, states_at(seen, 0), speed, push)
        points = torch.arange(1, POINTS + 1) * (windows.future // windows.stride) // POINTS
        errors = differences(states_at(flown, points), states_at(seen, points))
        turned = windows.turning(plant.stream_delay, windows.future // POINTS)
        return torch.cat([errors.flatten(1), torch.stack(push, -2).flatten(1), turned.flatten(1)], 1)

    def cost(self, state: State) -> float:
        """What is minimised, at a state."""
        raw = self.raw(state.x, state.x.new_zeros(()), state.streams)
        robust = ROBUST**2 * ((1.0 + (raw / self.scale / ROBUST).square()).sqrt() - 1.0)
        return float(robust.sum()) / len(raw)

    def linearise(self, state: State, update_scale: bool) -> tuple[Tensor, Tensor]:
        """Whitened residuals (W, m) at a state, and their derivatives (W, m, n + 1) by the coordinates and the window's
        stream delay."""
        n = len(state.x)

        def f(z: Tensor) -> tuple[Tensor, Tensor]:
            raw = self.raw(z[:n], z[n], state.streams)
            return raw, raw

        jacobian, raw = jacfwd(f, has_aux=True)(torch.cat((state.x, state.x.new_zeros(1))))
        if update_scale or not len(self.scale):
            self.scale = self._spread(raw)
        residual = raw / self.scale
        jacobian = jacobian / self.scale[:, None]
        jacobian[..., n] *= UNKNOWNS["stream"].scale
        if not self.moves_streams:
            jacobian[..., n] = 0.0
        return residual, jacobian

    def equations(self, state: State, update_scale: bool) -> tuple[Tensor, Tensor]:
        """Hessian (W, n + L, n + L) and gradient (W, n + L) of each window's robust cost; of the stream delays only its
        log's counts."""
        residual, jacobian = self.linearise(state, update_scale)
        stream = jacobian[..., -1:] * one_hot(self.windows.log, len(state.streams)).unsqueeze(1)
        jacobian = torch.cat((jacobian[..., :-1], stream), -1)
        weighted = jacobian * (1.0 + (residual / ROBUST).square()).rsqrt().unsqueeze(-1)
        return weighted.transpose(1, 2) @ jacobian, (weighted * residual.unsqueeze(-1)).sum(1)

    def _spread(self, raw: Tensor) -> Tensor:
        """The standard deviation (m) of each residual, from medians; one for the three axes together."""
        errors, push, turned = (1.4826 * raw.abs().median(0).values).split((POINTS * 12, 6, POINTS * 3))
        each = errors.unflatten(0, (POINTS, 4, 3)).mean(-1, keepdim=True).maximum(raw.new_tensor(_FLOOR)[:, None])
        # Of the pushes, that along the thrust tells the level of thrust. The others are the drone's trim.
        pushed = torch.full_like(push, torch.inf)
        if self.counts_push:
            pushed[2] = push[2].clamp_min(_PUSH_FLOOR)
        turned = turned.mean().clamp_min(_FLOOR[2]).expand(POINTS * 3)
        return torch.cat((each.expand(-1, -1, 3).flatten(), pushed, turned))


def minimise(problem: Problem, state: State, report: Callable[[State], None], max_iterations: int) -> State:
    """Levenberg-Marquardt steps from a state until the coordinates stand still, each of which is reported."""
    state = dataclasses.replace(state, x=problem.model.bounded(state.x))
    if state.scale is not None:
        problem.scale = state.x.new_tensor(state.scale)
    while not state.converged and state.iteration < max_iterations:
        hessian, gradient = (x.sum(0) for x in problem.equations(state, update_scale=state.iteration < 8))
        state.scale = problem.scale.tolist()
        state.cost = problem.cost(state)
        before = state
        for _ in range(8):
            state = _moved(before, _solve(hessian, gradient, before.damping), problem.model)
            cost = problem.cost(state)
            if math.isfinite(cost) and cost <= before.cost * (1.0 + 1e-9):
                change = float((state.x - before.x).abs().max()) if len(before.x) else 0.0
                change = max(change, float((state.streams - before.streams).abs().max()) / UNKNOWNS["stream"].scale)
                is_still = change < CONVERGED or before.cost - cost < CONVERGED * 0.1 * before.cost
                state.cost, state.damping = cost, max(before.damping / 6.0, 1e-9)
                state.converged = before.iteration >= 8 and is_still
                break
            before.damping *= 8.0
        else:  # no step makes it better
            state = dataclasses.replace(before, converged=True)
        state.iteration += 1
        report(state)
    return state


def covariance(hessians: Tensor, scores: Tensor, log: Tensor, lags: int) -> tuple[Tensor, Tensor]:
    """The covariance (n + L, n + L) of the unknowns, from the equations of windows, and the inverse Hessian in it.

    It is a sandwich: windows that follow each other err alike, since the air, the battery and the model's own faults
    stay, so the scores of windows up to ``lags`` apart are summed (Newey and West 1987).
    """
    hessian = hessians.sum(0)
    bread = _inverse(hessian)
    meat = scores.T @ scores
    for lag in range(1, lags + 1):
        same = (log[lag:] == log[:-lag]).to(scores).unsqueeze(1)
        part = (scores[lag:] * same).T @ scores[:-lag]
        meat += (1.0 - lag / (lags + 1.0)) * (part + part.T)
    used = int((hessian.diag() > 0).sum())
    correction = len(scores) / max(len(scores) - used, 1)
    return correction * bread @ meat @ bread, bread


def bootstrap(hessians: Tensor, scores: Tensor, block: int, draws: int, seed: int) -> Tensor:
    """Changes of the unknowns (draws, n + L) where blocks of windows are resampled, with one Gauss-Newton step each."""
    count = len(scores)
    generator = torch.Generator().manual_seed(seed)
    blocks = -(-count // block)
    changes = []
    for _ in range(draws):
        first = torch.randint(count, (blocks,), generator=generator)
        drawn = ((first[:, None] + torch.arange(block)) % count).flatten()[:count]
        counts = torch.bincount(drawn, minlength=count).to(scores)
        hessian = (counts[:, None, None] * hessians).sum(0)
        changes.append(-_inverse(hessian) @ (counts[:, None] * scores).sum(0))
    return torch.stack(changes)


def _solve(hessian: Tensor, gradient: Tensor, damping: float) -> Tensor:
    diagonal = hessian.diag()
    damped = hessian + torch.diag(damping * diagonal + 1e-9 * diagonal.max().clamp_min(1e-12))
    return -torch.linalg.solve(damped, gradient)


def _inverse(hessian: Tensor) -> Tensor:
    """The inverse, in units in which the diagonal is one; zero for unknowns that no residual depends on."""
    d = hessian.diag().clamp_min(0.0).sqrt()
    used = d > 0
    unit = torch.where(used, 1.0 / d.clamp_min(1e-300), 0.0)
    scaled = hessian * unit[:, None] * unit + torch.diag((~used).to(hessian))
    return torch.linalg.pinv(scaled, hermitian=True, rtol=1e-13) * unit[:, None] * unit


def _moved(state: State, step: Tensor, model: Model) -> State:
    """The state after a step (n + L) that goes no further than its derivatives are good for, nor than a body can."""
    n, stream = len(state.x), UNKNOWNS["stream"]
    limit = state.x.new_tensor([UNKNOWNS[name].limit for name in state.free])
    most = torch.tensor([0.7 if UNKNOWNS[name].is_log else 2.0 for name in state.free]).to(state.x)
    x = (state.x + step[:n].clamp(-most, most)).clamp(-limit, limit)
    end = stream.limit * stream.scale
    streams = (state.streams + step[n:].clamp(-2.0, 2.0) * stream.scale).clamp(-end, end)
    return dataclasses.replace(state, x=model.bounded(x), streams=streams)
