"""Read logs of real flights in one schema, and fit drones to them."""

from torchrl_quad.identification.errors import (
    ClockJumpsBack,
    GapsTooLarge,
    LogError,
    MissingColumns,
    NoFlight,
    NotFiniteLog,
    NotOneDrone,
    TooShort,
    UnreadableLog,
    WrongFrame,
    WrongMotors,
    WrongQuaternion,
    WrongUnit,
)
from torchrl_quad.identification.estimation import identify
from torchrl_quad.identification.layouts import LAYOUTS, Columns, Layout
from torchrl_quad.identification.log import FlightLog, read_log
from torchrl_quad.identification.parameters import FIELDS
from torchrl_quad.identification.prediction import prediction_error
from torchrl_quad.identification.result import IdentificationResult

__all__ = [
    "FIELDS",
    "LAYOUTS",
    "ClockJumpsBack",
    "Columns",
    "FlightLog",
    "GapsTooLarge",
    "IdentificationResult",
    "Layout",
    "LogError",
    "MissingColumns",
    "NoFlight",
    "NotFiniteLog",
    "NotOneDrone",
    "TooShort",
    "UnreadableLog",
    "WrongFrame",
    "WrongMotors",
    "WrongQuaternion",
    "WrongUnit",
    "identify",
    "prediction_error",
    "read_log",
]
