"""What a drone is: its physical parameters, and the presets that ship with the package."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from torch import Tensor

from torchrl_quad.airframe import JUDGED, contradictions
from torchrl_quad.dynamics import presets
from torchrl_quad.dynamics.vector import is_traced
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import between, build, checked

_DRONES = resources.files("torchrl_quad.dynamics") / "drones"
# The fields that only the flight controller reads, from its nominal drone.
CONTROLLER_FIELDS = ("rate_gain", "rate_damping", "max_body_rate", "max_thrust_to_weight")
_OTHER_SHAPES = {"motor_time_constant": (2,), "rotor_positions": ("n", 3)}  # which a field may have as well
_OPTIONAL = {"drag_height": 0.0, "rotor_direction": None, "rotor_effectiveness": None}


def _field(shape: tuple[int | str, ...], low: float, high: float, unit: str = "", **default: Any) -> Any:
    """A field with the shape of one drone's value, its unit, and limits, beyond which numbers could overflow."""
    return dataclasses.field(metadata={"shape": shape, "low": low, "high": high, "unit": unit}, **default)


@checked
@dataclasses.dataclass(frozen=True)
class MotorCommand:
    """The rotor speed that a motor command asks for: ``speed_at_zero + speed_per_volt * command * voltage``.

    The command is 0 to 1 of what the electronics can give. It is needed to replay flights
    (:func:`~torchrl_quad.identification.prediction_error`).

    Args:
        speed_per_volt: of command times battery voltage, what the motor gets on average, 0.001 to 1e5 rad/s per V.
        nominal_voltage: where a log has no battery voltage, 0.1 to 1000 V.
        speed_at_zero: -1e4 to 1e4 rad/s.
        delay: from the command to the motor, -0.1 to 0.5 s.
    """

    speed_per_volt: Annotated[float, between(1e-3, 1e5)]
    nominal_voltage: Annotated[float, between(1e-1, 1e3)]
    speed_at_zero: Annotated[float, between(-1e4, 1e4)] = 0.0
    delay: Annotated[float, between(-0.1, 0.5)] = 0.0


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class QuadrotorParams:
    """The physical parameters of a drone with n rotors, in any order, SI units, body frame x forward, y left, z up.

    Each field is a tensor that broadcasts over environments: the shape given below for one drone, or the same with a
    leading dimension of num_envs. A number without dimensions is stored as (1,). Gradients flow through every field.

    Raises:
        ValueError: a value has the wrong shape, is not finite, or breaks the rule of its field.
    """

    mass: Tensor = _field((1,), 1e-3, 1e3, "kg")  #: (1) [kg]
    inertia: Tensor = _field((3,), 1e-8, 1e3, "kg m2")  #: (3) [kg m2], principal axes
    #: (n, 2) [m], x and y of each rotor, or (n, 3) with z, which counts where rotors are tilted; 4 rotors are usual
    rotor_positions: Tensor = _field(("n", 2), -1e1, 1e1, "m")
    #: (n), sign of the torque that each rotor exerts on the body, about the direction of its thrust
    rotor_spin: Tensor = _field(("n",), -1.0, 1.0)
    yaw_torque_coefficient: Tensor = _field((1,), 1e-5, 1e1, "m")  #: (1) [m], kappa, yaw torque per thrust
    #: (3), k2 [N s2], k1 [N s] and k0 [N] of thrust = k2 w^2 + k1 w + k0, which rises from rotor_speed_min to
    #: rotor_speed_max; w may be another measure of speed, such as the motor command
    thrust_map: Tensor = _field((3,), -1e3, 1e3, "N s2, N s, N")
    rotor_speed_min: Tensor = _field((1,), 0.0, 1e5, "rad/s")  #: (1) [rad/s]
    rotor_speed_max: Tensor = _field((1,), 1e0, 1e5, "rad/s")  #: (1) [rad/s]
    #: (1) [s], or (2) for rotors that speed up and slow down at a different pace
    motor_time_constant: Tensor = _field((1,), 1e-4, 1e1, "s")
    linear_drag: Tensor = _field((3,), 0.0, 1e2, "N s/m")  #: (3) [N s/m]
    quadratic_drag: Tensor = _field((3,), 0.0, 1e2, "N s2/m2")  #: (3) [N s2/m2]
    rate_gain: Tensor = _field((3,), 1e-3, 1e4, "1/s")  #: (3) [1/s], times the inertia
    rate_damping: Tensor = _field((3,), 0.0, 1e3, "kg m2")  #: (3) [kg m2], on the angular acceleration
    max_body_rate: Tensor = _field((3,), 1e-2, 1e2, "rad/s")  #: (3) [rad/s], commanded at full stick
    max_thrust_to_weight: Tensor = _field((1,), 1e-1, 1e2)  #: (1), commanded at full stick
    gravity: Tensor = _field((1,), 1e-2, 1e3, "m/s2")  #: (1) [m/s2]
    #: (1) [m], above the centre of mass, where the drag acts
    drag_height: Tensor = _field((1,), -1e0, 1e0, "m", default=0.0)
    #: (n, 3), along the thrust of each rotor, body frame; its length does not count. All upright where None
    rotor_direction: Tensor | None = _field(("n", 3), -1e1, 1e1, default=None)
    #: (n), a factor on thrust and torque of each rotor, 0 for a dead one, 1 where None; the controller does not use it
    rotor_effectiveness: Tensor | None = _field(("n",), 0.0, 1e1, default=None)
    motor_command: MotorCommand | None = None  #: from motor commands of logs to rotor speeds; None if unknown

    def __post_init__(self) -> None:
        like = self.mass if isinstance(self.mass, Tensor) and self.mass.is_floating_point() else torch.empty(0)
        fields = self.fields()
        for name, value in fields.items():
            object.__setattr__(self, name, _checked(name, value, like, fields["rotor_positions"]))
        if not is_traced():
            for broken in contradictions({name: getattr(self, name).detach().cpu().numpy() for name in JUDGED}):
                raise UserValueError(f"QuadrotorParams: {broken}.")

    def __repr__(self) -> str:
        """A table with units."""
        rows = {"motor_command": str(self.motor_command)} if self.motor_command else {}
        for name, value in reversed(self.fields().items()):
            unit = FIELDS[name]["unit"]
            rows = {f"{name} [{unit}]" if unit else name: _table(value, self.dim(name)), **rows}
        width = max(map(len, rows))
        return "\n  ".join(["QuadrotorParams", *(f"{label:{width}}  {value}" for label, value in rows.items())])

    def fields(self) -> dict[str, Tensor]:
        """The fields by name, in the order of their declaration, without those that are None."""
        return {name: x for name in FIELDS if (x := getattr(self, name)) is not None}

    def value(self, name: str) -> Tensor:
        """A field by its name; of one that is None, the tensor that it stands for."""
        if (value := getattr(self, name)) is not None:
            return value
        shape = self.rotor_spin.shape[-1:]
        up = self.mass.new_tensor([0.0, 0.0, 1.0]).expand(*shape, 3)
        return up if name == "rotor_direction" else self.mass.new_ones(shape)

    def replace(self, **changes: Any) -> QuadrotorParams:
        """A copy with some fields changed, to tensors (with their graph), numbers, lists: ``replace(mass=0.5)``."""
        for unknown in (name for name in changes if name not in FIELDS):
            raise UserValueError(f"QuadrotorParams has no field {unknown!r}. Choose from: {', '.join(FIELDS)}.")
        none = {k: None for k, v in changes.items() if v is None and _OPTIONAL.get(k, 0.0) is None}
        changes = {k: v for k, v in changes.items() if k not in none}
        changed = {k: _tensor(k, v, self.mass, "QuadrotorParams").to(self.mass) for k, v in changes.items()}
        return dataclasses.replace(self, **changed, **none)

    def to(self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> QuadrotorParams:
        """A copy on another device or with another floating-point type; gradients flow through the copy."""
        return dataclasses.replace(self, **{k: x.to(device=device, dtype=dtype) for k, x in self.fields().items()})

    def detach(self) -> QuadrotorParams:
        """A copy of the values, without gradient."""
        return dataclasses.replace(self, **{name: value.detach().clone() for name, value in self.fields().items()})

    @property
    def requires_grad(self) -> bool:
        """Whether any field does."""
        return any(value.requires_grad for value in self.fields().values())

    @staticmethod
    def dim(name: str) -> int:
        """The number of dimensions of a field of a single drone."""
        return len(FIELDS[name]["shape"])


FIELDS = {field.name: field.metadata for field in dataclasses.fields(QuadrotorParams) if field.metadata}
LIMITS = {name: (about["low"], about["high"]) for name, about in FIELDS.items()}
PLANT_FIELDS = tuple(name for name in FIELDS if name not in CONTROLLER_FIELDS)  # of the drone that flies

if TYPE_CHECKING:

    class RawParams(QuadrotorParams):
        """See below."""

        def __init__(self, **fields: Tensor) -> None: ...
        def _asdict(self) -> dict[str, Tensor]: ...

else:
    # As QuadrotorParams, but unchecked and of any form: for drones that are drawn at random, and for compiled code.
    RawParams = collections.namedtuple("RawParams", FIELDS, defaults=[None] * len(FIELDS))


def read_drone(values: Mapping, dtype: torch.dtype = torch.float32, source: str = "drone") -> QuadrotorParams:
    """A drone from a mapping of fields to numbers; errors name the source, and what to write."""
    if not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
        raise UserValueError(f"load_drone: dtype must be torch.float32 or torch.float64, got {shown(dtype)}.")
    motors, values = values.get("motor_command"), {**_OPTIONAL, **values}
    required = [name for name in FIELDS if name not in _OPTIONAL]
    for missing in (name for name in required if name not in values):
        raise UserValueError(f"{source}: missing field {missing!r}. Required: {', '.join(required)}.")
    for unknown in (name for name in values if name not in (*FIELDS, "motor_command")):
        raise UserValueError(f"{source}: unknown field {shown(unknown)}. Allowed: {', '.join(FIELDS)}, motor_command.")
    like = torch.empty(0, dtype=torch.float64)
    given = {k: values[k] for k in FIELDS if values[k] is not None or k not in _OPTIONAL}
    fields = {name: _tensor(name, x, like, source).to(torch.float64) for name, x in given.items()}
    command = None if motors is None else build(MotorCommand, f"{source}: motor_command", motors)
    try:
        return QuadrotorParams(**fields, motor_command=command).to(dtype=dtype)
    except UserValueError as error:
        raise UserValueError(str(error).replace("QuadrotorParams", source, 1)) from None


def read_fields(drone: str | Path | Mapping) -> tuple[str, Mapping[str, Any]]:
    """What the file of a drone, a preset's or another, or a mapping says, and its name in errors."""
    return presets.read("drone", drone, _DRONES)


def available_drones() -> list[str]:
    """The names of the presets that ship with the package."""
    return presets.names(_DRONES)


def _table(value: Tensor, dim: int) -> str:
    if value.dim() > dim:
        return f"{value.min():.5g} to {value.max():.5g} over {len(value)} drones"
    if dim == 2:
        return ", ".join(f"({_table(row, 1)})" for row in value)
    return ", ".join(f"{x:.5g}" for x in value.tolist())


def _tensor(name: str, value: Any, like: Tensor, source: str) -> Tensor:
    """A value as a tensor: its own, with its graph, or one like another tensor."""
    if isinstance(value, Tensor) and value.dtype != torch.bool and not value.is_complex():
        return value
    try:
        if isinstance(value, Sequence) and any(isinstance(x, Tensor) for x in value):
            return torch.stack([_tensor(name, x, like, source).to(like) for x in value])
        return torch.from_numpy(np.asarray(presets.as_array(value))).to(like)
    except (ValueError, RuntimeError, RecursionError) as error:
        what = f"field {name!r} is not a number or a list of numbers: {shown(value)}"
        raise UserValueError(f"{source}: {what}.") from error


def _checked(name: str, value: Any, like: Tensor, places: Any) -> Tensor:
    value = _tensor(name, value, like, "QuadrotorParams")
    value = value if value.dim() else value.reshape(1)
    shape, low, high, _ = FIELDS[name].values()
    rotors = places.shape[-2] if isinstance(places, Tensor) and places.dim() > 1 else 4
    shapes = [tuple(rotors if k == "n" else k for k in x) for x in (shape, _OTHER_SHAPES.get(name)) if x]
    if value.shape not in shapes and value.shape[1:] not in shapes:
        one = " or ".join(map(str, shapes)) if name == "rotor_positions" else str(shapes[0])
        why = f" with the {rotors} rotors of rotor_positions" if "n" in shape and name != "rotor_positions" else ""
        raise UserValueError(
            f"QuadrotorParams: field {name!r} has shape {tuple(value.shape)}; it must be {one} for one drone{why}, or "
            f"{('num_envs', *shapes[0])} for one per environment."
        )
    numbers = value.detach().float()  # which finds a limit fit that was rounded to float32 on its way
    fits, rule = (numbers >= low) & (numbers <= high), f"between {low:g} and {high:g}"
    if name == "rotor_spin":
        fits, rule = numbers.abs() == 1, "+1 or -1"
    if name == "rotor_direction" and not (numbers.norm(dim=-1) > 1e-3).all():
        fits, rule = numbers.norm(dim=-1) > 1e-3, "a direction for each rotor, such as [0, 0, 1] for up"
    if not fits.all():
        rule += "; of a matrix give the diagonal" if name == "inertia" and value.shape[-2:] == (3, 3) else ""
        got = shown(value.tolist())
        raise UserValueError(f"QuadrotorParams: field {name!r} must be {rule}, in SI units; got {got}.")
    return value
