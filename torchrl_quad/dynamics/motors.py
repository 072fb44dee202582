"""From a motor command of a log to the rotor speed that it asks for: needed to replay flights, not to simulate."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any

from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import between, checked

SpeedPerVolt = Annotated[float, between(1e-3, 1e5)]
Voltage = Annotated[float, between(1e-1, 1e3)]
SpeedAtZero = Annotated[float, between(-1e4, 1e4)]
Lag = Annotated[float, between(-0.1, 0.5)]


@checked
@dataclasses.dataclass(frozen=True)
class MotorCommand:
    """The rotor speed that a motor command asks for: ``speed_at_zero + speed_per_volt * command * voltage``.

    The command is 0 to 1 of what the electronics can give. Environments command rotor speeds or thrusts, and do not
    read this; :func:`~torchrl_quad.identification.prediction_error` does.

    Args:
        speed_per_volt: of command times battery voltage, which is what the motor sees on average, 0.001 to 1e5 rad/s
            per V.
        nominal_voltage: where a log does not know the battery's, 0.1 to 1000 V.
        speed_at_zero: -1e4 to 1e4 rad/s.
        delay: from the command to the motor, -0.1 to 0.5 s.

    Raises:
        ValueError: a value is not a finite number in its range.
    """

    speed_per_volt: SpeedPerVolt
    nominal_voltage: Voltage
    speed_at_zero: SpeedAtZero = 0.0
    delay: Lag = 0.0

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
            raise UserValueError(f"{source}: motor_command: {error}") from None
