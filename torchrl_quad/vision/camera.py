"""A depth camera: its images, and what its sensor makes of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import Below1, Delay, Fraction, between, build, checked, entries
from torchrl_quad.vision.primitives import Primitives
from torchrl_quad.vision.rays import cast_rays

Side = Annotated[int, between(1, 10_000)]


@checked
@dataclasses.dataclass(frozen=True)
class DepthCamera:
    """A depth camera on the drone, as an option of every task: ``HoveringEnv(camera=DepthCamera(), scene=...)``.

    An image is (n, 1, height, width) [m], its first row the uppermost, its first column the leftmost. A pixel is the
    depth along the optical axis, as depth cameras measure it, or with ``along_ray`` the length of the ray, at most
    ``range``. Pixels are square, and rays go through their centres. Without ``pitch`` and ``quaternion`` the camera
    looks along the body's x axis, and the top of the image is the body's z axis.

    Args:
        width: pixels of a row, at most 10,000; an image has at most a million.
        height: rows of pixels, at most 10,000.
        field_of_view: the horizontal angle from edge to edge, 0.01 to 2.967 rad; 90 degrees are 1.571 rad.
        position: of the camera [m], x, y and z in the body frame, each within 10 m.
        pitch: by which the camera looks upwards [rad], -pi to pi.
        quaternion: (w, x, y, z) of unit norm, from camera to body; replaces the pitch.
        range: the greatest depth, 0.01 to 10,000 m.
        rate: control steps from one image to the next, 1 to 1000.
        delay: control steps from the instant of an image until the policy gets it, 0 to 1000.
        noise: standard deviation of the depth, independent in each pixel, as a share of the depth, 0 to 1.
        dropout: the probability that a pixel measures nothing, and is 0; below 1.
        along_ray: whether a pixel is the length of the ray instead of the depth along the optical axis.
        differentiable: whether images have their derivative in the pose of the drone.
    """

    width: Side = 16
    height: Side = 12
    field_of_view: Annotated[float, between(0.01, 2.967)] = 0.5 * math.pi
    position: Annotated[Sequence[Annotated[float, between(-10.0, 10.0)]], entries(3, 3)] = (0.0, 0.0, 0.0)
    pitch: Annotated[float, between(-math.pi, math.pi)] = 0.0
    quaternion: Annotated[Sequence[Annotated[float, between(-1.001, 1.001)]], entries(4, 4)] | None = None
    range: Annotated[float, between(0.01, 10_000.0)] = 10.0
    rate: Annotated[int, between(1, 1_000)] = 1
    delay: Delay = 0
    noise: Fraction = 0.0
    dropout: Below1 = 0.0
    along_ray: bool = False
    differentiable: bool = False

    def __post_init__(self) -> None:
        tall = 2 * math.atan(self.height / self.width * math.tan(0.5 * self.field_of_view))
        if self.pixels > 1_000_000:
            raise UserValueError(f"{self.width} x {self.height} pixels are too many. Give a million at most.")
        if tall >= math.radians(170.0):  # a picture plane cannot show half of all directions
            raise UserValueError(
                f"{self.height} rows of {self.width} square pixels span {math.degrees(tall):.0f} degrees from top to "
                "bottom, and 170 are too many. Give fewer rows, or a smaller field_of_view."
            )
        if (q := self.quaternion) is not None and abs(math.hypot(*q) - 1.0) > 1e-3:
            raise UserValueError(f"quaternion must be four numbers (w, x, y, z) of unit norm, got {q!r}.")
        if q is not None and self.pitch != 0.0:
            raise UserValueError("pitch and quaternion both say where the camera looks. Give one of them.")

    @classmethod
    def of(cls, spec: DepthCamera | Mapping[str, Any]) -> DepthCamera:
        """The camera that a mapping of its fields describes, or the camera itself."""
        return build(cls, "camera", spec)

    @property
    def pixels(self) -> int:
        """How many pixels an image has."""
        return self.width * self.height

    @property
    def is_noisy(self) -> bool:
        """Whether its sensor needs random numbers."""
        return self.noise > 0 or self.dropout > 0

    def plane(self, like: Tensor) -> Tensor:
        """Where the rays pass the plane at a depth of 1 m, (2, pixels): to the left, and upwards, row by row [m]."""
        half = math.tan(0.5 * self.field_of_view)
        columns = torch.arange(self.width, dtype=like.dtype, device=like.device)
        rows = torch.arange(self.height, dtype=like.dtype, device=like.device)
        left = half * (1.0 - (2.0 * columns + 1.0) / self.width)
        up = half * (self.height - 1.0 - 2.0 * rows) / self.width
        return torch.stack((left.repeat(self.height), up.repeat_interleave(self.width)))

    def mount(self, like: Tensor) -> Tensor:
        """The camera's attitude on the body (4), a unit quaternion, to the body frame."""
        q = self.quaternion
        if q is None:
            q = (math.cos(0.5 * self.pitch), 0.0, -math.sin(0.5 * self.pitch), 0.0)
        norm = math.sqrt(sum(x * x for x in q))
        return torch.tensor([x / norm for x in q], dtype=like.dtype, device=like.device)

    def pose(self, position: Tensor, attitude: Tensor) -> tuple[Tensor, Tensor]:
        """Position (n, 3) [m] and attitude (n, 4) of the camera, world frame, from those of the drone."""
        offset = torch.tensor(tuple(self.position), dtype=position.dtype, device=position.device)
        place = position + quaternion.rotate(attitude, offset.expand_as(position))
        return place, quaternion.multiply(attitude, self.mount(attitude).expand_as(attitude))

    def depth(self, solids: Primitives, position: Tensor, attitude: Tensor, *, fused: bool = False) -> Tensor:
        """Images (n, 1, height, width) [m] of n scenes, without noise, rate and delay.

        The drones are at positions (n, 3) [m], world frame, with unit quaternions (n, 4), body to world. ``fused``
        compiles the rays, 30 times as fast, as a compiled step does in any case.
        """
        plane = self.plane(position)
        depth = cast_rays(solids, *self.pose(position, attitude), plane, self.range, self.differentiable, fused=fused)
        if self.along_ray:
            depth = (depth * (1.0 + plane.square().sum(0)).sqrt()).clamp_max(self.range)
        return depth.unflatten(1, (1, self.height, self.width))

    def measure(self, depth: Tensor, normal: Tensor) -> Tensor:
        """What the sensor makes of images (n, 1, height, width), with standard normal numbers (n, pixels).

        One number decides both whether a pixel measures anything, and its error: the share ``dropout`` of the least
        numbers drops out, and what is left of the distribution is stretched to a whole one.
        """
        error, lost = normal.reshape(depth.shape), None
        if self.dropout:
            share = 0.5 * (1.0 + torch.erf(error * math.sqrt(0.5)))
            lost = share < self.dropout
            rest = (share - self.dropout) / (1.0 - self.dropout)
            error = math.sqrt(2.0) * torch.erfinv((2.0 * rest - 1.0).clamp(-0.999999, 0.999999))
        noisy = (depth * (1.0 + self.noise * error)).clamp(0.0, self.range)
        noisy = torch.where(depth < self.range, noisy, depth)
        return noisy if lost is None else torch.where(lost, 0.0, noisy)
