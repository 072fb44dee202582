"""The quickest lap of a race, as a reference for classical controllers: ``MPC(env, reference=racing(env))``."""

import math
from typing import Any

import torch
from torch import Tensor

from torchrl_quad import QuadrotorParams, RacingEnv
from torchrl_quad.controllers.policy import Reference

CATCH_UP = 0.15  # of the speed of the lap, by which the reference runs ahead of a drone that is slower
# Laps:
THRUST_SHARE, RATE_SHARE = 0.9, 0.9  # of the greatest thrust and body rate; the rest is left to the feedback
LEAST_LIFT = 0.2  # vertical part of the thrust, in weights: the drone stays upright
GATE_SHARE = 0.3  # of the radius of a gate, by which the lap may miss its centre
HARMONICS = 3  # for each gate
WEIGHTS = (300.0, 3_000.0, 30_000.0)  # of what breaks a limit, one after the other
POINTS = 33  # in the table of each stretch between two gates


def racing(env: RacingEnv) -> Reference:
    """The quickest lap, from its point next to the drone on, and a little ahead of a slower drone.

    A drone that has missed its gate has to come back, and stop at the gate.
    """
    lap, lead = plan_lap(env.gates, env.nominal, env.gate_radius), env.action_delay * env.control_dt

    def reference(state: dict[Any, Tensor], t: Tensor) -> Tensor:
        begin, is_missed = lap.locate(state["position"], state["gate"][:, 0], lead)
        velocity = lap.velocity(begin[:, 0])
        along = (state["velocity"] * velocity).sum(-1, keepdim=True) / velocity.square().sum(-1, keepdim=True)
        pace = torch.where(is_missed, 0.0, (along + CATCH_UP).clamp(0.0, 1.0))
        return lap.position(begin + pace * (t - lead))

    return reference


class Lap:
    """A closed path of a period [s], from the coefficients (2 K + 1, 3) [m] of 1, K cosines and K sines.

    It passes the gates at the times ``passes`` (gates) [s], the first at zero, rising.
    """

    def __init__(self, coefficients: Tensor, period: float, passes: Tensor) -> None:
        self.coefficients, self.period, self.passes = coefficients, period, passes
        self.rates = 2.0 * math.pi / period * torch.arange(1, len(coefficients) // 2 + 1).to(coefficients)
        ends = torch.where(passes > 0.0, passes, period)
        lengths = ends - passes.roll(1)  # of the stretch before each gate
        shares = torch.linspace(1.0, 0.0, POINTS, dtype=passes.dtype, device=passes.device)
        self.times = ends[:, None] - lengths[:, None] * shares
        self.points = self.position(self.times)

    def position(self, t: Tensor) -> Tensor:
        """Where it is at times (*) [s], (*, 3) [m]."""
        return basis(t, self.rates, 0) @ self.coefficients

    def velocity(self, t: Tensor) -> Tensor:
        """How it moves at times (*) [s], (*, 3) [m/s]."""
        return basis(t, self.rates, 1) @ self.coefficients

    def locate(self, position: Tensor, gate: Tensor, beyond: float) -> tuple[Tensor, Tensor]:
        """The time (n, 1) [s] at which it is next to positions (n, 3) [m] on the way to their next gates (n).

        Second, bool (n, 1), whether the gate has been missed: the time is then ``beyond`` [s] behind it.
        """
        nearest = (self.points[gate] - position.unsqueeze(1)).square().sum(-1).argmin(1, keepdim=True)
        t, low, high = self.times[gate].gather(1, nearest), self.times[gate, :1], self.times[gate, -1:] + beyond
        for _ in range(2):  # Newton's method, from the nearest point of the table
            place, velocity = self.position(t[:, 0]), self.velocity(t[:, 0])
            step = ((position - place) * velocity).sum(-1, keepdim=True) / velocity.square().sum(-1, keepdim=True)
            t = torch.minimum(torch.maximum(t + step, low), high)
        return t, t >= high


def plan_lap(gates: Tensor, drone: QuadrotorParams, gate_radius: float) -> Lap:
    """Plan the quickest lap through gates (g, 3) [m] that leaves some thrust and body rate to the feedback.

    A quadrotor is differentially flat (Mellinger and Kumar 2011): a path with the acceleration a and the jerk j asks
    for the thrust m |a + g| and, where the heading is free, for the body rate |(a + g) x j| / |a + g|^2. L-BFGS
    minimises the period and a penalty on what breaks the limits of the drone or misses the centre of a gate.
    """
    centres, least_gravity = gates.detach().double().cpu(), drone.gravity.detach().double().amin().item()
    gravity = centres.new_tensor((0.0, 0.0, least_gravity))
    max_rate = RATE_SHARE * drone.max_body_rate[..., :2].amin().item()
    most = drone.max_thrust_to_weight.detach().double().amin().item()
    max_thrust = THRUST_SHARE * most * least_gravity  # per mass [m/s2]
    harmonics = HARMONICS * max(len(centres), 4)
    orders = torch.arange(1, harmonics + 1).to(centres)
    scale = torch.cat((orders.new_tensor([1e-3]), orders**3, orders**3)).unsqueeze(1)  # jerk costs alike in all
    angles = 2.0 * math.pi * orders
    gaps = (centres.roll(-1, 0) - centres).norm(dim=1).clamp_min(2.0 * gate_radius)
    shares = torch.cat((gaps.new_zeros(1), gaps.cumsum(0)[:-1])) / gaps.sum()  # of the period, where gates are
    second, third = (basis(torch.arange(16 * harmonics).to(centres) / (16 * harmonics), angles, k) for k in (2, 3))
    with torch.enable_grad():
        x = (torch.linalg.pinv(basis(shares, angles, 0) / scale.T) @ centres).requires_grad_()
        moved = torch.zeros_like(shares[1:]).requires_grad_()
        log_period = (gaps.sum() / 4.0).log().requires_grad_()  # at 4 m/s, to begin with
        unknowns = [x, moved, log_period]
        optimizer = torch.optim.LBFGS(unknowns, max_iter=80, history_size=30, line_search_fn="strong_wolfe")
        for weight in WEIGHTS:

            def objective(weight: float = weight) -> Tensor:
                optimizer.zero_grad()
                period, path = log_period.exp(), x / scale
                force, jerk = second @ path / period**2 + gravity, third @ path / period**3
                thrust = force.norm(dim=1)
                rate = torch.linalg.cross(force, jerk).norm(dim=1) / thrust.square()
                passes = torch.cat((shares[:1], shares[1:] + moved))
                miss = ((basis(passes, angles, 0) @ path - centres).square().sum(1) + 1e-12).sqrt()
                broken = (
                    (thrust / max_thrust - 1.0).clamp_min(0.0).square().mean()
                    + (rate / max_rate - 1.0).clamp_min(0.0).square().mean()
                    + (LEAST_LIFT - force[:, 2] / gravity[2]).clamp_min(0.0).square().mean()
                    + 0.1 * (miss - GATE_SHARE * gate_radius).clamp_min(0.0).square().mean()
                )
                loss = period + weight * broken + 1e-6 * x.square().sum()
                loss.backward()
                return loss

            optimizer.step(objective)
        period = log_period.exp()
        passes = torch.cat((shares[:1], shares[1:] + moved)) * period
        return Lap((x / scale).detach().to(gates), period.item(), passes.detach().to(gates))


def basis(t: Tensor, rates: Tensor, order: int) -> Tensor:
    """The derivative of some order in time of 1, cos(rates t) and sin(rates t), (*, 2 K + 1), at times (*)."""
    angle, factor = t.unsqueeze(-1) * rates + 0.5 * math.pi * order, rates**order
    one = torch.full_like(t, float(order == 0)).unsqueeze(-1)
    return torch.cat((one, factor * angle.cos(), factor * angle.sin()), -1)
