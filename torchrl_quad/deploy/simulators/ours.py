"""Fly the drone of a contract in the package's own simulator, which needs torch: the flight to compare others with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_quad.deploy.contract import Contract
from torchrl_quad.deploy.simulators import Simulator
from torchrl_quad.deploy.simulators.vehicle import Array
from torchrl_quad.dynamics import DYNAMICS, load_drone
from torchrl_quad.errors import UserValueError, shown


class Ours(Simulator):
    """The simulator of the contract."""

    loops = ("contract",)

    def __init__(self, contract: Contract, loop: str, motors: Sequence[int]) -> None:
        if list(motors) != sorted(motors):
            raise UserValueError("torchrl_quad flies motors as they are: swap them in another simulator.")
        about = contract["simulator"]
        self.version = contract["origin"]["package"]
        nominal, substeps = load_drone(contract["drone"]), round(contract["control_dt"] / about["dt"])
        if about["dynamics"] not in DYNAMICS:
            raise UserValueError(
                f"The simulator lacks the dynamics {shown(about['dynamics'])}. Known are {', '.join(DYNAMICS)}; "
                "register those of your own first."
            )
        kind: Any = DYNAMICS[about["dynamics"]]
        self.dynamics = kind(nominal, about["dt"], substeps, about["integrator"], "rates")
        flies = contract["drone"] | contract["plant"]
        self.params = load_drone(flies) if contract["plant"] else self.dynamics.nominal

    def reset(self, starts: Mapping[str, Array]) -> None:
        given = {name: torch.from_numpy(x).float() for name, x in starts.items()}
        self.now = {**self.dynamics.rest(given["position"]), **given}

    def state(self) -> dict[str, Array]:
        return {name: x.double().numpy() for name, x in self.now.items()}

    @torch.no_grad()
    def step(self, thrust: Array, rates: Array) -> None:
        command = torch.cat((torch.from_numpy(thrust)[:, None], torch.from_numpy(rates)), 1).float()
        action = self.dynamics.controller.encode(command)
        self.now = self.dynamics.control_step(self.now, action, self.params, None)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        self.now = {name: x[torch.from_numpy(chosen)] for name, x in self.now.items()}
