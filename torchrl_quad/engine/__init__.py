"""The engine: a pure control step, a :class:`Simulation` of anything, becomes a fast horizon with its graph."""

from torchrl_quad.engine.horizon import can_fly, flies_inside, fly
from torchrl_quad.engine.packing import flat, looks_are_free, nested
from torchrl_quad.engine.policy import ActionSequence, PlainPolicy
from torchrl_quad.engine.program import has_compiler
from torchrl_quad.engine.simulation import Simulation, Transition
from torchrl_quad.engine.stepper import Stepper

__all__ = [
    "ActionSequence",
    "PlainPolicy",
    "Simulation",
    "Stepper",
    "Transition",
    "can_fly",
    "flat",
    "flies_inside",
    "fly",
    "has_compiler",
    "looks_are_free",
    "nested",
]
