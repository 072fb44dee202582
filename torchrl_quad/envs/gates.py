"""The geometry of gates with a direction: their openings, the bars around them, and the way past what is near."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_quad.dynamics import quaternion
from torchrl_quad.envs import terms

LOOKS = 16  # parts of a way, between which obstacles are looked for
INSTANTS = 9  # of the way of a step, at which it may touch a frame


def beyond_edges(aside: Tensor, opening: Tensor) -> Tensor:
    """How far places (*, 2) in the plane of a gate are beyond the edges of its opening (*, 1 or 2)."""
    return (terms.norm(aside) if opening.shape[-1] == 1 else aside.abs()) - opening


def bar_distance(place: Tensor, opening: Tensor, thickness: float) -> tuple[Tensor, Tensor]:
    """The distance (*, 1) [m] of places (*, 3) from the bars of a gate, and the direction (*, 3) away from them.

    The x axis is that of the gate. Bars of a thickness [m] are around an opening (*, 2), half of its width and height,
    or (*, 1), its radius. Within a bar the distance is negative, to the opening or to the outside in the plane of the
    gate, whichever is nearer. On a surface the direction is zero.
    """
    along, aside = place.split((1, 2), -1)
    half, outer = 0.5 * thickness, opening + thickness
    if opening.shape[-1] == 1:
        size = terms.norm(aside)
        sign = torch.where(size < 1e-6, aside.new_tensor([1.0, 0.0]), aside / size.clamp_min(1e-6))
    else:
        size, sign = aside.abs(), torch.where(aside < 0.0, -1.0, 1.0).to(aside)
    axes = torch.arange(opening.shape[-1], device=place.device)
    beyond, room, inner = size - opening, outer - size, torch.minimum(size, opening)
    is_open, least = (beyond <= 0.0).all(-1, keepdim=True), room.amin(-1, keepdim=True)
    is_within = ~is_open & (least >= 0.0) & (along.abs() <= half)
    outwards = torch.where(room.argmin(-1, keepdim=True) == axes, outer, size)
    out = torch.where(terms.norm(size - inner) < least, inner, outwards)
    edge = torch.where(beyond.argmax(-1, keepdim=True) == axes, opening, size)
    nearest = sign * torch.where(is_open, edge, torch.where(is_within, out, torch.minimum(size, outer)))
    gap = place - torch.cat((along.clamp(-half, half), nearest), -1)
    gap = torch.where(is_within, -gap, gap)
    length = terms.norm(gap)
    return torch.where(is_within, -length, length), gap / length.clamp_min(1e-6)


def nearest_frame(
    position: Tensor, centres: Tensor, rotations: Tensor, openings: Tensor, thickness: float
) -> tuple[Tensor, Tensor]:
    """The distance (n, 1) [m] of positions (n, 3) from the bars of the nearest of k frames, and the direction away.

    Centres are (n or 1, k, 3), rotations (n or 1, k, 4), and openings (k, 1 or 2).
    """
    place = quaternion.rotate_inverse(rotations, position.unsqueeze(1) - centres)
    distance, away = bar_distance(place, openings, thickness)
    distance, index = distance.min(1, keepdim=True)
    away = quaternion.rotate(rotations, away).gather(1, index.expand(-1, -1, 3))
    return distance.squeeze(1), away.squeeze(1)


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
    distance, _ = bar_distance(place, openings.unsqueeze(1), thickness)
    return distance.flatten(1).amin(1, keepdim=True)


def around(
    start: Tensor, ahead: Tensor, gap: Tensor, clearance: float, obstacle: Callable[[Tensor], tuple[Tensor, Tensor]]
) -> Tensor:
    """The direction (n, 3) that clears what the straight way comes closest to, from its start (n, 3) in the direction
    ahead (n, 3), as far as the gap (n, 1) [m]; that direction itself where the way is clear.

    ``obstacle`` gives the distance (n, s, 1) [m] of points (n, s, 3) and the direction away, (n, s, 3). It is asked at
    17 places, and at 17 around the closest of them. The way is turned aside by what it lacks of the clearance [m]
    there, at most by 45 degrees, and without a gradient of its own.
    """
    with torch.no_grad():
        share, best = torch.arange(LOOKS + 1, device=gap.device, dtype=gap.dtype) / LOOKS, 0.5 * gap
        for reach in (0.5 * gap, gap / LOOKS):
            along = (best + (2.0 * share - 1.0) * reach).clamp_min(0.0).minimum(gap)
            distance, away = obstacle(start.unsqueeze(1) + along.unsqueeze(-1) * ahead.unsqueeze(1))
            index = distance.argmin(1, keepdim=True)
            best = along.gather(1, index[..., 0])
        away = away.gather(1, index.expand(-1, -1, 3)).squeeze(1)
        aside = away - (away * ahead).sum(-1, keepdim=True) * ahead
        aside = torch.where(best < gap, normalize(aside, dim=-1), aside)  # as it is where the way itself is closest
        lack = (clearance - distance.amin(1)).minimum(best)
        way = normalize(best * ahead + lack * aside, dim=-1)
    return torch.where(lack > 0.0, way, ahead)
