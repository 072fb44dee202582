"""From a motor command of a log to the rotor speed that it asks for: needed to replay flights, not to simulate."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from torchrl_quad.dynamics.presets import is_number
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import shown


@dataclasses.dataclass(frozen=True)
class MotorCommand:
    """The rotor speed that a motor command asks for: ``speed_at_zero + speed_per_volt * command * voltage``.

    The command is 0 to 1 of what the electronics can give. Environments command rotor speeds or thrusts, and do not
    read this; :func:`~torchrl_quad.identification.prediction_error` does.

    Raises:
        ValueError: a value is not a finite number in its range.
    """

    speed_per_volt: float  #: [rad/s per V] of command times battery voltage, which is what the motor sees on average
    nominal_voltage: float  #: [V], where a log does not know the battery's
    speed_at_zero: float = 0.0  #: [rad/s]
    delay: float = 0.0  #: [s], from the command to the motor

    def __post_init__(self) -> None:
        ranges = {
            "speed_per_volt": (1e-3, 1e5),
            "nominal_voltage": (1e-1, 1e3),
            "speed_at_zero": (-1e4, 1e4),
            "delay": (-0.1, 0.5),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not (is_number(value) and low <= value <= high):
                raise UserValueError(f"motor_command: {name} must be between {low:g} and {high:g}, got {shown(value)}.")

    @classmethod
    def read(cls, source: str, values: Any) -> MotorCommand:
        """From the section ``motor_command`` of a drone's file.

        Raises:
            ValueError: it is no mapping, or a key is missing or unknown, or a value is out of its range.
        """
        if isinstance(values, cls):
            return values
        names = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(values, Mapping):
            raise UserValueError(
                f"{source}: motor_command must be a mapping of {', '.join(names)}; got {shown(values)}."
            )
        for name in values:
            if name not in names:
                raise UserValueError(
                    f"{source}: motor_command: unknown key {shown(name)}. Allowed: {', '.join(names)}."
                )
        for name in names[:2]:
            if name not in values:
                raise UserValueError(
                    f"{source}: motor_command: missing key {name!r}. Required: {', '.join(names[:2])}."
                )
        try:
            return cls(**values)
        except ValueError as error:
            raise UserValueError(f"{source}: {error}") from error
