"""The geometry of gates with a direction: their openings, and the bars around them."""

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs import terms

INSTANTS = 9  # of the way of a step, at which it may touch a frame


def outside(aside: Tensor, opening: Tensor) -> Tensor:
    """How far places (*, 2) in the plane of a gate are beyond the edges of its opening (*, 1 or 2)."""
    return (terms.norm(aside) if opening.shape[-1] == 1 else aside.abs()) - opening


def to_frame(place: Tensor, opening: Tensor, thickness: float) -> tuple[Tensor, Tensor]:
    """The signed distance (*, 1) [m] from places (*, 3) to the surface of a frame, and the direction (*, 3) away from
    it, both with the gate's x axis in its direction.

    Bars of a thickness [m] are around an opening (*, 2), half of its width and height, or (*, 1), its radius. From
    within a bar the way out is into the opening or to the outside, in the plane of the gate.
    """
    along, aside = place.split((1, 2), -1)
    is_round, half, outer = opening.shape[-1] == 1, 0.5 * thickness, opening + thickness
    size = terms.norm(aside) if is_round else aside.abs()
    beyond, room = size - opening, (outer - size).amin(-1, keepdim=True)
    is_open, inner = (beyond <= 0.0).all(-1, keepdim=True), torch.minimum(size, opening)
    is_within = ~is_open & (room >= 0.0) & (along.abs() <= half)
    out = torch.where(terms.norm(size - inner) < room, inner, torch.where(outer - size == room, outer, size))
    edge = torch.where(beyond == beyond.amax(-1, keepdim=True), opening, size)
    nearest = torch.where(is_open, edge, torch.where(is_within, out, torch.minimum(size, outer)))
    nearest = aside * nearest / size.clamp_min(1e-6) if is_round else torch.where(aside < 0.0, -nearest, nearest)
    gap = place - torch.cat((along.clamp(-half, half), nearest), -1)
    gap = torch.where(is_within, -gap, gap)
    length = terms.norm(gap)
    return torch.where(is_within, -length, length), gap / length.clamp_min(1e-6)


def nearest_frame(
    points: Tensor, centres: Tensor, rotations: Tensor, openings: Tensor, thickness: float
) -> tuple[Tensor, Tensor]:
    """The signed distance (n, s, 1) [m] from points (n, s, 3) to the nearest of k frames, and the direction away.

    Centres are (n or 1, k, 3), rotations (n or 1, k, 4), and openings (k, 1 or 2).
    """
    rotations = rotations.unsqueeze(1)
    place = quaternion.rotate_inverse(rotations, points.unsqueeze(2) - centres.unsqueeze(1))
    distance, away = to_frame(place, openings, thickness)
    distance, index = distance.min(2, keepdim=True)
    away = quaternion.rotate(rotations, away).gather(2, index.expand(-1, -1, -1, 3))
    return distance.squeeze(2), away.squeeze(2)


def least_distance(
    start: Tensor, end: Tensor, centres: Tensor, rotations: Tensor, openings: Tensor, thickness: float
) -> Tensor:
    """The least distance (n, 1) [m] of the straight way between two positions (n, 3) from the bars of k frames.

    It is taken at nine instants, and where the way crosses the plane of the gate.
    """
    start, end = (quaternion.rotate_inverse(rotations, x[:, None] - centres) for x in (start, end))
    way = end - start
    share = torch.arange(INSTANTS, device=way.device, dtype=way.dtype) / (INSTANTS - 1)
    crossing = (-start[..., :1] / torch.where(way[..., :1] == 0.0, 1.0, way[..., :1])).clamp(0.0, 1.0)
    share = torch.cat((share + 0.0 * crossing, crossing), -1).unsqueeze(-1)  # (n, k, instants, 1)
    place = start.unsqueeze(2) + share * way.unsqueeze(2)
    distance, _ = to_frame(place, openings.unsqueeze(1), thickness)
    return distance.flatten(1).amin(1, keepdim=True)
