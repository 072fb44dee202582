"""What a log may be refused for, by name."""

from collections.abc import Mapping
from typing import Any

from torchrl_quad.errors import UserValueError

Remedy = Mapping[str, Any]  # see torchrl_quad.identification.remedies


def in_units(quantity: str, when: str, **units: float) -> list[Remedy]:
    """A remedy for each unit in which a quantity may be, by what turns it into ours."""
    return [{"quantity": quantity, "factor": x, "when": f"{when} {unit}"} for unit, x in units.items()]


class LogError(UserValueError):
    """A log cannot be used. Each of its classes names one reason, and each message what is odd; what it tells to write
    was tried on the log, and works."""

    def __init__(self, message: str, *remedies: Remedy) -> None:
        super().__init__(message)
        self.remedies = remedies  #: what may mend it, in this order


class UnreadableLog(LogError):
    """The file is empty, cut off, of no known kind, or needs a package that is missing."""


class MissingColumns(LogError):
    """The file lacks a column that was asked for, or no layout is known for its columns."""


class NotFiniteLog(LogError):
    """Fewer than two samples of a quantity are finite."""


class ClockJumpsBack(LogError):
    """Time runs backwards in a stream."""


class GapsTooLarge(LogError):
    """Gaps leave no piece of the flight that is long enough."""


class WrongUnit(LogError):
    """A column is not in the unit that it should have: degrees, millimetres, g, milliseconds, or counts of a motor."""


class WrongQuaternion(LogError):
    """Quaternions are in another order, turn the world to the body, or are not of unit length."""


class WrongFrame(LogError):
    """A quantity is in another frame: z down, body y right, a velocity of the body, rates of the world or of none."""


class WrongMotors(LogError):
    """The drone has other than four rotors, or its motors are named in another order."""


class NoFlight(LogError):
    """Nothing in the file flies: the motors stand, or the drone stays on the ground."""


class TooShort(LogError):
    """No piece of the flight is long enough to predict anything, or all are too short for so many unknowns."""


class NotOneDrone(LogError):
    """Flights are not of one drone in one air, or not of the drone that they are said to be of."""
