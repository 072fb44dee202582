"""From flights to parameters: logs of real drones in one schema."""

from torchrl_quad.identification.errors import LogError
from torchrl_quad.identification.log import FlightLog, read_log

__all__ = ["FlightLog", "LogError", "read_log"]
