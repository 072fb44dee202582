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
from torchrl_quad.vision import DepthCamera, Primitives
from torchrl_quad.vision.primitives import SIZES, join


class Ours(Simulator):
    """The simulator of the contract."""

    loops, sees = ("contract",), True

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
        output, control = contract["output"], {"mode": contract["output"]["control"]}
        tilt = output["gains"].get("max_tilt", [output["range"][1][1]])[0]  # in attitude the range of roll
        control |= {"max_tilt": tilt} if "tilt_gain" in output["gains"] else {}
        control |= {"max_speed": output["range"][0][1]} if control["mode"] == "velocity" else {}
        self.dynamics = kind(nominal, about["dt"], substeps, about["integrator"], control)
        self.camera, self.fixed = contract["camera"], contract["obstacles"]
        flies = contract["drone"] | contract["plant"]
        self.params = load_drone(flies) if contract["plant"] else self.dynamics.nominal

    def reset(self, starts: Mapping[str, Array]) -> None:
        given = {name: torch.from_numpy(x).float() for name, x in starts.items()}
        self.now = {**self.dynamics.rest(given["position"]), **given}

    def place(self, obstacles: Mapping[str, Array]) -> None:
        def solids(n: int, given: Mapping[str, Any]) -> Primitives:
            kinds = (np.array(given.get(kind, ()), np.float32).reshape(n, -1, k) for kind, k in SIZES.items())
            return Primitives(*map(torch.from_numpy, kinds))

        self.solids = join(solids(1, self.fixed or {}), solids(len(self.now["position"]), obstacles))

    def look(self) -> Array:
        fields = {name: x for name, x in self.camera.items() if name not in ("rate", "delay", "noise", "dropout")}
        depth = DepthCamera(**fields).depth(self.solids, self.now["position"], self.now["quaternion"])
        return depth[:, 0].double().numpy()

    def state(self) -> dict[str, Array]:
        return {name: x.double().numpy() for name, x in self.now.items()}

    @torch.no_grad()
    def step(self, command: Array) -> None:
        action = self.dynamics.controller.encode(torch.from_numpy(command).float())
        self.now = self.dynamics.control_step(self.now, action, self.params, None)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        on, n = torch.from_numpy(chosen), len(chosen)
        self.now = {name: x[on] for name, x in self.now.items()}
        self.solids = Primitives(*(x[on] if len(x) == n else x for x in self.solids))
