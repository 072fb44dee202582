"""From flights to parameters: logs of real drones in one schema."""

from torchrl_quad.identification.errors import LogError
from torchrl_quad.identification.log import FlightLog, read_log
from torchrl_quad.identification.prediction import prediction_error

__all__ = ["FlightLog", "LogError", "prediction_error", "read_log"]
