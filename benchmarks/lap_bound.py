"""The least time in which a point mass with a drone's thrust and drag flies through gates: a bound for every lap.

The mass has its full thrust in any direction at once: no rates, rotors, floor, frames or obstacles hold it. Drag is
included: along body axes, whose direction is free, it is C v with eigenvalues of C between the drone's least and
greatest coefficients at the speed |v|. Thrust and drag together reach a ball of accelerations, which no drone leaves.

In the quickest flight the acceleration is on the edge of that ball, and without drag its direction, the primer vector,
is linear in time between gates (Lawden 1963). Here it has three knots on each way, and SLSQP finds them with the times,
the velocities at gates, and the points at which openings are passed. A lap is steady: it ends as it begins.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor
from torch.nn.functional import pad

from torchrl_quad import RacingEnv
from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs.track import forward

STEPS = 24  # of the midpoint rule, on each way
GUESSES = (0.7, 1.2)  # of the times, in those from rest to rest without gravity; the best end of all counts


def bound_of(env: RacingEnv, gates: Tensor, rotations: Tensor) -> float:
    """The least time [s] of a lap, or from the start to the last gate, of gates (k, 3) with rotations (k, 4)."""
    points, turned, ahead = gates.double().cpu(), rotations.double().cpu(), None
    reach = env.gate_radius * torch.eye(3).double().repeat(len(points), 1, 1)
    if env.is_directed:
        half = torch.diag_embed(pad(env.openings.double().cpu().expand(-1, 2), (1, 0)))
        reach, ahead = quaternion.rotate(turned[:, None].expand(-1, 3, -1), half), forward(turned)
    if not env.is_closed:
        points = torch.cat((env.starts[:1].double().cpu(), points))
        reach = torch.cat((env.start_range * torch.eye(3).double()[None], reach))
    drone, mass = env.nominal, env.nominal.mass.item()
    thrust, drag = drone.max_thrust_to_weight.item() * drone.gravity.item(), (drone.linear_drag, drone.quadratic_drag)
    air = tuple(x.item() / mass for x in (drag[0].min(), drag[0].max(), drag[1].max()))
    is_round = env.openings.shape[-1] != 2
    return least_time(points, reach, ahead, is_round, env.is_closed, thrust, drone.gravity.item(), air)


def rule(kind: str, function: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """A constraint of SLSQP, with its Jacobian."""
    functions = {"fun": function, "jac": torch.func.jacrev(function)}
    return {"type": kind} | {name: lambda x, f=f: f(torch.from_numpy(x)).numpy() for name, f in functions.items()}


def least_time(
    points: Tensor,
    reach: Tensor,
    ahead: Tensor | None = None,
    is_round: bool = False,
    is_closed: bool = True,
    thrust: float = 20.0,
    gravity: float = 9.81,
    drag: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> float:
    """The least time [s] of a steady lap, or from rest at the first point until the last, NaN where none is found.

    Args:
        points: (n, 3) [m]; each is passed at itself plus offsets @ reach (n, 3, 3) [m], with offsets within -1 and 1.
        ahead: the directions (k, 3) in which the last k points are passed.
        is_round: offsets, except those of a start, are at most 1 long.
        thrust: per mass [m/s2], as the gravity.
        drag: per mass, the least [1/s], and the greatest at rest [1/s] and per speed [1/m].
    """
    n, ways, first = len(points), len(points) - (not is_closed), int(not is_closed)
    after = (torch.arange(ways) + 1) % n
    length = (points[after] - points[:ways]).norm(dim=1).mean().item()  # with the thrust, the units from here on
    unit = math.sqrt(length / thrust)
    points, reach, drag = points / length, reach / length, (drag[0] * unit, drag[1] * unit, drag[2] * length)
    weight = points.new_tensor((0.0, 0.0, gravity / thrust))
    cut = 6 * n  # first a velocity and an offset at each point, then a time and three knots of each way

    def accelerate(v: Tensor, primer: Tensor, share: float) -> Tensor:
        knot = int(2.0 * share)
        edge = torch.lerp(primer[:, knot], primer[:, knot + 1], 2.0 * share - knot)
        edge = edge / (edge.square().sum(-1, keepdim=True) + 1e-6).sqrt()
        speed = (v.square().sum(-1, keepdim=True) + 1e-12).sqrt()
        most = drag[1] + drag[2] * speed
        return (1.0 + 0.5 * (most - drag[0]) * speed) * edge - 0.5 * (most + drag[0]) * v - weight

    def gaps(x: Tensor) -> Tensor:
        """By how much the ways miss the points, and the velocities there."""
        node, way = x[:cut].view(n, 6), x[cut:].view(ways, 10)
        place = points + (node[:, None, 3:] @ reach).squeeze(1)
        p, v, h, primer = place[:ways], node[:ways, :3], way[:, :1] / STEPS, way[:, 1:].view(ways, 3, 3)
        for i in range(STEPS):
            middle = v + 0.5 * h * accelerate(v, primer, (i + 0.5) / STEPS)
            change = h * accelerate(middle, primer, (i + 0.5) / STEPS)
            p, v = p + h * (2.0 * v + 4.0 * middle + change) / 6.0, v + change  # by Simpson's rule
        return torch.cat((p - place[after], v - node[after, :3])).flatten()

    def room(x: Tensor) -> Tensor:
        """What must not be negative: how far offsets are inside, and the speed in the direction of gates."""
        node = x[:cut].view(n, 6)[first:]
        inside = 1.0 - node[:, 3:].square().sum(-1) if is_round else x[:0]
        return torch.cat((inside, x[:0] if ahead is None else (node[:, :3] * ahead).sum(-1)))

    def solve(guess: float) -> float:
        gap = points[after] - points[:ways]
        time = guess * 2.0 * gap.norm(dim=1, keepdim=True).sqrt()
        velocity = torch.zeros_like(points).index_add(0, after, 0.5 * gap / time)
        velocity[:ways] += 0.5 * gap / time
        if not is_closed:  # from rest, and with no braking on the last way
            velocity[0], velocity[-1] = 0.0, 2.0 * gap[-1] / time[-1] - velocity[-2] * (n > 2)
        begin, end = velocity[:ways], velocity[after]
        ends = 6.0 * gap / time - 4.0 * begin - 2.0 * end, 2.0 * begin + 4.0 * end - 6.0 * gap / time  # of a cubic
        knots = torch.stack((ends[0], 0.5 * (ends[0] + ends[1]), ends[1]), 1) / time.unsqueeze(1) + weight
        x = torch.cat(
            (torch.cat((velocity, 0.0 * velocity), 1).flatten(), torch.cat((time, knots.flatten(1)), 1).flatten())
        )
        times = np.zeros(len(x))
        times[cut::10] = 1.0
        limits = np.tile([-np.inf, np.inf], (len(x), 1))
        limits[cut::10, 0] = 1e-3
        limits[:cut].reshape(n, 6, 2)[:, 3:] = -1.0, 1.0
        limits[: 3 * first] = 0.0
        rules = [rule("eq", gaps), rule("ineq", room)]
        options = {"maxiter": 300, "ftol": 1e-6}
        end = minimize(times.dot, x.numpy(), jac=lambda x: times, bounds=limits, constraints=rules, options=options)
        return end.fun if np.abs(rules[0]["fun"](end.x)).max() < 1e-4 else math.inf

    return unit * least if (least := min(map(solve, GUESSES))) < math.inf else math.nan
