"""Adaptation: from seconds of flight to a better policy."""

from torchrl_quad.adaptation.adapting import Adaptation, Adapter, adapt
from torchrl_quad.adaptation.fit import FlightFit, Flown, fit_flight, simulated_log
from torchrl_quad.adaptation.report import write_report

__all__ = ["Adaptation", "Adapter", "FlightFit", "Flown", "adapt", "fit_flight", "simulated_log", "write_report"]
