"""From flights to parameters: logs of real drones in one schema."""

from torchrl_quad.identification.errors import (
    ClockJumpsBack,
    GapsTooLarge,
    InconsistentRates,
    LogError,
    MissingColumns,
    NoFlight,
    NotFiniteLog,
    UnreadableLog,
    WrongFrame,
    WrongQuaternion,
    WrongUnit,
)
from torchrl_quad.identification.layouts import LAYOUTS, Columns, Layout
from torchrl_quad.identification.log import FlightLog, read_log

__all__ = [
    "LAYOUTS",
    "ClockJumpsBack",
    "Columns",
    "FlightLog",
    "GapsTooLarge",
    "InconsistentRates",
    "Layout",
    "LogError",
    "MissingColumns",
    "NoFlight",
    "NotFiniteLog",
    "UnreadableLog",
    "WrongFrame",
    "WrongQuaternion",
    "WrongUnit",
    "read_log",
]
