"""A depth camera: what it sees, and what its sensor makes of it."""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.dynamics import quaternion
from torchrl_quad.dynamics.presets import is_number, is_numbers
from torchrl_quad.errors import UserValueError
from torchrl_quad.vision.primitives import Primitives
from torchrl_quad.vision.rays import cast_rays

MAX_FIELD_OF_VIEW = math.radians(170.0)  # a picture plane cannot show half of all directions
MAX_PIXELS, MAX_COUNT, MAX_RANGE = 1_000_000, 1_000, 10_000.0


@dataclasses.dataclass(frozen=True)
class DepthCamera:
    """A depth camera on the drone, as an option of every task: ``HoveringEnv(camera=DepthCamera(), scene=...)``.

    An image is (n, 1, height, width) [m]. Its first row is the uppermost, and its first column the leftmost. A pixel is
    the depth along the optical axis of what its ray meets, as depth cameras measure it, or with ``along_ray`` the
    length of the ray. What is further away than ``range``, and empty space, has the depth ``range``.

    The pixels are square, and the rays go through their centres. Without ``pitch`` and ``quaternion`` the camera looks
    along the body's x axis, and the top of the image is the body's z axis.

    Raises:
        ValueError: a value is out of its range; there is no pixel, or the field of view is 170 degrees or more.
    """

    width: int = 16  #: pixels of a row
    height: int = 12  #: rows
    field_of_view: float = 0.5 * math.pi  #: [rad], horizontal, from edge to edge
    position: Sequence[float] = (0.0, 0.0, 0.0)  #: of the camera [m], body frame
    pitch: float = 0.0  #: [rad], by which the camera looks upwards
    quaternion: Sequence[float] | None = None  #: (w, x, y, z), from camera to body, in the place of the pitch
    range: float = 10.0  #: [m]
    rate: int = 1  #: control steps from one image to the next
    delay: int = 0  #: control steps from the instant of an image until the policy sees it
    noise: float = 0.0  #: standard deviation of the depth, as a share of it, in each pixel by itself
    dropout: float = 0.0  #: the probability that a pixel measures nothing, which it shows as 0
    along_ray: bool = False  #: the length of the ray instead of the depth along the optical axis
    differentiable: bool = False  #: give images their derivative in the pose of the drone

    def __post_init__(self) -> None:
        for name, least, most in (
            ("width", 1, MAX_PIXELS),
            ("height", 1, MAX_PIXELS),
            ("rate", 1, MAX_COUNT),
            ("delay", 0, MAX_COUNT),
        ):
            value = getattr(self, name)
            is_whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
            what = "pixels: an image needs at least one" if most == MAX_PIXELS else "control steps"
            _require(
                is_whole and least <= value <= most,
                f"{name} must be a whole number of {what}, from {least} to {most:,}; got {value!r}.",
            )
        angle = self.field_of_view
        hint = f" In degrees? {angle:g} degrees are {math.radians(angle):.4g}." if is_number(angle) else ""
        _require(
            is_number(angle) and 0 < angle < MAX_FIELD_OF_VIEW,
            f"field_of_view must be an angle above 0 and below 170 degrees, {MAX_FIELD_OF_VIEW:.3f} [rad], since a "
            f"plane shows no more; got {angle!r}.{hint}",
        )
        tall = math.atan(self.height / self.width * math.tan(0.5 * angle)) * 2
        _require(
            tall < MAX_FIELD_OF_VIEW,
            f"{self.height} rows of {self.width} square pixels see {math.degrees(tall):.0f} degrees from top to "
            "bottom; 170 are too many. Give fewer rows, or a smaller field_of_view.",
        )
        _require(is_numbers(self.position, 3), f"position must be three numbers [m], got {self.position!r}.")
        _require(
            is_number(self.pitch) and abs(self.pitch) <= math.pi,
            f"pitch must be an angle from -pi to pi [rad], got {self.pitch!r}.",
        )
        q = self.quaternion
        is_unit = q is None or (is_numbers(q, 4) and abs(math.sqrt(sum(x * x for x in q)) - 1.0) < 1e-3)
        _require(is_unit, f"quaternion must be four numbers (w, x, y, z) of unit norm, got {q!r}.")
        _require(
            q is None or self.pitch == 0.0, "pitch and quaternion both say where the camera looks. Give one of them."
        )
        _require(
            is_number(self.range) and 0 < self.range <= MAX_RANGE,
            f"range must be above 0 and at most {MAX_RANGE:g} m, got {self.range!r}.",
        )
        _require(
            is_number(self.noise) and 0 <= self.noise <= 1,
            f"noise must be a share of the depth, from 0 to 1, got {self.noise!r}.",
        )
        _require(
            is_number(self.dropout) and 0 <= self.dropout < 1,
            f"dropout must be a probability, from 0 to below 1, got {self.dropout!r}.",
        )

    @classmethod
    def of(cls, spec: DepthCamera | Mapping[str, Any]) -> DepthCamera:
        """The camera that a mapping of its fields describes, or the camera itself."""
        if isinstance(spec, cls):
            return spec
        allowed = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(spec, Mapping):
            raise UserValueError(
                f"camera must be a DepthCamera, or a mapping with any of {', '.join(allowed)}; got {spec!r}."
            )
        unknown = sorted(str(key) for key in spec if key not in allowed)
        _require(not unknown, f"unknown key {unknown[0] if unknown else ''!r}. Allowed: {', '.join(allowed)}.")
        return cls(**spec)

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
        eye = position + quaternion.rotate(attitude, offset.expand_as(position))
        return eye, quaternion.multiply(attitude, self.mount(attitude).expand_as(attitude))

    def depth(self, solids: Primitives, position: Tensor, attitude: Tensor, *, fused: bool = False) -> Tensor:
        """What the camera sees without noise, rate and delay.

        Args:
            solids: of n scenes.
            position: of the drones (n, 3) [m], world frame.
            attitude: of the drones (n, 4), unit quaternions, body to world.
            fused: compile the rays, 30 times as fast; as a compiled step does in any case.

        Returns:
            images (n, 1, height, width) [m].
        """
        plane = self.plane(position)
        pose = self.pose(position, attitude)
        depth = cast_rays(solids, *pose, plane, self.range, self.differentiable, fused=fused)
        if self.along_ray:
            depth = (depth * (1.0 + plane.square().sum(0)).sqrt()).clamp_max(self.range)
        return depth.unflatten(1, (1, self.height, self.width))

    def measure(self, depth: Tensor, normal: Tensor) -> Tensor:
        """What the sensor makes of images (n, 1, height, width), with standard normal numbers (n, pixels).

        One number decides both whether a pixel measures anything, and its error: the share ``dropout`` of the least
        numbers drops out, and what is left of the distribution is stretched to a whole one.
        """
        normal = normal.reshape(depth.shape)
        error, lost = normal, None
        if self.dropout:
            share = 0.5 * (1.0 + torch.erf(normal * math.sqrt(0.5)))
            lost = share < self.dropout
            rest = (share - self.dropout) / (1.0 - self.dropout)
            error = math.sqrt(2.0) * torch.erfinv((2.0 * rest - 1.0).clamp(-0.999999, 0.999999))
        noisy = (depth * (1.0 + self.noise * error)).clamp(0.0, self.range)
        noisy = torch.where(depth < self.range, noisy, depth)
        return noisy if lost is None else torch.where(lost, 0.0, noisy)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise UserValueError(f"camera: {message}")
