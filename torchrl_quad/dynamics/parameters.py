"""What a drone is: its physical parameters, and the presets that ship with the package."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.dynamics import presets
from torchrl_quad.dynamics.motors import MotorCommand
from torchrl_quad.errors import UserValueError, shown

_DRONES = resources.files(__package__) / "drones"

# Per field: the shape of one drone's value, and the least and the greatest number that makes sense for it. Beyond them
# the numbers of a drone that could never fly overflow, and their derivatives with them.
_FIELDS = {
    "mass": ((1,), 1e-3, 1e3),
    "inertia": ((3,), 1e-8, 1e3),
    "rotor_positions": ((4, 2), -1e1, 1e1),
    "rotor_spin": ((4,), -1.0, 1.0),
    "yaw_torque_coefficient": ((1,), 1e-5, 1e1),
    "thrust_map": ((3,), -1e3, 1e3),
    "rotor_speed_min": ((1,), 0.0, 1e5),
    "rotor_speed_max": ((1,), 1e0, 1e5),
    "motor_time_constant": ((1,), 1e-4, 1e1),
    "linear_drag": ((3,), 0.0, 1e2),
    "quadratic_drag": ((3,), 0.0, 1e2),
    "rate_gain": ((3,), 1e-3, 1e4),
    "rate_damping": ((3,), 0.0, 1e3),
    "max_body_rate": ((3,), 1e-2, 1e2),
    "max_thrust_to_weight": ((1,), 1e-1, 1e2),
    "gravity": ((1,), 1e-2, 1e3),
    "drag_height": ((1,), -1e0, 1e0),
}
_OTHER_SHAPES = {"motor_time_constant": (2,)}  # which a field may have as well
_OPTIONAL = {"drag_height": 0.0}
LIMITS = {name: (low, high) for name, (_, low, high) in _FIELDS.items()}
# The fields that only the flight controller reads, from its nominal drone; and those of the drone that flies.
CONTROLLER_FIELDS = ("rate_gain", "rate_damping", "max_body_rate", "max_thrust_to_weight")
PLANT_FIELDS = tuple(name for name in _FIELDS if name not in CONTROLLER_FIELDS)

# As QuadrotorParams, but unchecked and of any form: for drones that are drawn at random, and for compiled code.
RawParams = collections.namedtuple("RawParams", _FIELDS, defaults=[None] * len(_FIELDS))


@dataclasses.dataclass(frozen=True, eq=False)
class QuadrotorParams:
    """The physical parameters of a quadrotor, SI units, body frame x forward, y left, z up.

    Each field is a tensor that broadcasts over environments: the shape given below for one drone, or the same with a
    leading dimension of num_envs. A number without dimensions is stored as (1,). Gradients flow through every field.

    Raises:
        ValueError: a value has the wrong shape, is not finite, or breaks the rule of its field.
    """

    mass: Tensor  #: (1) [kg]
    inertia: Tensor  #: (3) [kg m2], principal axes
    rotor_positions: Tensor  #: (4, 2) [m], x and y of each rotor
    rotor_spin: Tensor  #: (4), sign of the yaw torque that each rotor exerts on the body
    yaw_torque_coefficient: Tensor  #: (1) [m], kappa, yaw torque per thrust
    thrust_map: Tensor  #: (3), k2 [N s2], k1 [N s] and k0 [N] of thrust = k2 w^2 + k1 w + k0
    rotor_speed_min: Tensor  #: (1) [rad/s]
    rotor_speed_max: Tensor  #: (1) [rad/s]
    motor_time_constant: Tensor  #: (1) [s], or (2) for rotors that speed up and slow down at a different pace
    linear_drag: Tensor  #: (3) [N s/m]
    quadratic_drag: Tensor  #: (3) [N s2/m2]
    rate_gain: Tensor  #: (3) [1/s], times the inertia
    rate_damping: Tensor  #: (3) [kg m2], on the angular acceleration
    max_body_rate: Tensor  #: (3) [rad/s], commanded at full stick
    max_thrust_to_weight: Tensor  #: (1), commanded at full stick
    gravity: Tensor  #: (1) [m/s2]
    drag_height: Tensor | float = 0.0  #: (1) [m], above the centre of mass, where the drag acts
    motor_command: MotorCommand | None = None  #: from motor commands of logs to rotor speeds; None where unknown

    def __post_init__(self) -> None:
        for name, value in self.fields().items():
            like = self.mass if isinstance(self.mass, Tensor) and self.mass.is_floating_point() else torch.empty(0)
            value = _tensor(name, value, like, "QuadrotorParams")
            value = value if value.dim() else value.reshape(1)
            object.__setattr__(self, name, value)
            _check(name, value, "QuadrotorParams")
        low, high = self.rotor_speed_min.detach(), self.rotor_speed_max.detach()
        if not (low < high).all():
            raise UserValueError(
                "QuadrotorParams: rotor_speed_min must be below rotor_speed_max, "
                f"got {low.tolist()} and {high.tolist()}."
            )

        k2, k1, _ = self.thrust_map.detach().split(1, -1)
        if not (k1 + 2.0 * k2 * low >= 0).all():
            raise UserValueError(
                "QuadrotorParams: thrust_map must not fall with rotor speed: k1 + 2 k2 rotor_speed_min must be zero "
                f"or positive, got {(k1 + 2.0 * k2 * low).tolist()}."
            )

    def fields(self) -> dict[str, Tensor]:
        """The fields by name, in the order of their declaration."""
        return {name: getattr(self, name) for name in _FIELDS}

    def plant(self) -> tuple[Tensor, ...]:
        """The fields of the drone that flies, in the order of ``PLANT_FIELDS``."""
        return tuple(getattr(self, name) for name in PLANT_FIELDS)

    def replace(self, **changes: Tensor | float | list) -> QuadrotorParams:
        """A copy with some fields changed: ``params.replace(mass=0.5)``.

        A tensor keeps its graph, so that a parameter can be fitted through the simulator.
        """
        unknown = sorted(set(changes) - set(_FIELDS))
        if unknown:
            raise UserValueError(f"QuadrotorParams has no field {unknown[0]!r}. Choose from: {', '.join(_FIELDS)}.")
        like = self.mass
        return dataclasses.replace(
            self, **{k: _tensor(k, v, like, "QuadrotorParams").to(like) for k, v in changes.items()}
        )

    def to(self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> QuadrotorParams:
        """A copy on another device or with another floating-point type; gradients flow through the copy."""
        return self._map(lambda value: value.to(device=device, dtype=dtype))

    def detach(self) -> QuadrotorParams:
        """A copy of the values, without gradient."""
        return self._map(lambda value: value.detach().clone())

    @property
    def requires_grad(self) -> bool:
        """Whether any field does."""
        return any(value.requires_grad for value in self.fields().values())

    @staticmethod
    def dim(name: str) -> int:
        """The number of dimensions of a field of a single drone."""
        return len(_FIELDS[name][0])

    def _map(self, function) -> QuadrotorParams:
        mapped = {name: function(value) for name, value in self.fields().items()}
        return QuadrotorParams(**mapped, motor_command=self.motor_command)


def load_drone(drone: str | Path | Mapping = "visfly", dtype: torch.dtype = torch.float32) -> QuadrotorParams:
    """Load a preset by name, a YAML file by path, or a mapping of field names to numbers.

    Args:
        drone: one of :func:`available_drones`, the path of a file that ends in .yaml, or a mapping.
        dtype: floating-point type of the fields.

    Raises:
        ValueError: the preset is unknown, a field is missing, unknown, of the wrong shape, or out of its range, or the
            dtype is none of floating point.
        FileNotFoundError: the path does not exist.
    """
    if not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
        raise UserValueError(f"load_drone: dtype must be torch.float32 or torch.float64, got {shown(dtype)}.")
    source, values = presets.read("drone", drone, _DRONES)
    values = {**_OPTIONAL, **values}
    motors = values.pop("motor_command", None)
    missing = [name for name in _FIELDS if name not in values]
    unknown = sorted(str(name) for name in values if name not in _FIELDS)
    if missing:
        required = ", ".join(name for name in _FIELDS if name not in _OPTIONAL)
        raise UserValueError(f"{source}: missing field {missing[0]!r}. Required: {required}.")
    if unknown:
        raise UserValueError(f"{source}: unknown field {unknown[0]!r}. Allowed: {', '.join(_FIELDS)}, motor_command.")
    fields = {}
    for name in _FIELDS:
        fields[name] = _tensor(name, values[name], torch.empty(0, dtype=torch.float64), source).to(torch.float64)
        _check(name, fields[name] if fields[name].dim() else fields[name].reshape(1), source)
    command = None if motors is None else MotorCommand.read(source, motors)
    return QuadrotorParams(**fields, motor_command=command).to(dtype=dtype)


def available_drones() -> list[str]:
    """The names of the presets that ship with the package."""
    return presets.names(_DRONES)


def _tensor(name: str, value: Any, like: Tensor, source: str) -> Tensor:
    """A value as a tensor: its own, with its graph, or one like another tensor."""
    if isinstance(value, Tensor) and value.dtype != torch.bool and not value.is_complex():
        return value
    try:
        parts = value if isinstance(value, Sequence) and any(isinstance(x, Tensor) for x in value) else None
        if parts is not None:
            return torch.stack([_tensor(name, x, like, source).to(like) for x in parts])
        return torch.from_numpy(np.asarray(presets.as_array(value))).to(like)
    except (ValueError, RuntimeError, RecursionError) as error:
        raise UserValueError(
            f"{source}: field {name!r} is not a number or a list of numbers: {shown(value)}."
        ) from error


def _check(name: str, value: Tensor, source: str) -> None:
    shape, low, high = _FIELDS[name]
    shapes = (shape, _OTHER_SHAPES.get(name))
    if value.shape not in shapes and value.shape[1:] not in shapes:
        batched = ("num_envs", *shape)
        raise UserValueError(
            f"{source}: field {name!r} has shape {tuple(value.shape)}; it must be {shape} for one drone, "
            f"or {batched} for one per environment."
        )
    with torch.no_grad():
        plain, value = value, value.float()  # which finds a limit fit that was rounded to float32 on its way
        fits, rule = (value >= low) & (value <= high), f"between {low:g} and {high:g}"
        if name == "rotor_spin":
            fits, rule = value.abs() == 1, "+1 or -1"
        if name == "thrust_map" and not (value[..., 0] > 0).all():
            fits, rule = value > 0, "rising at high speed, k2 above zero"
        if not fits.all():
            raise UserValueError(f"{source}: field {name!r} must be {rule}, in SI units; got {shown(plain.tolist())}.")
