"""Judge flights by the task's own rules, which a bundle has as graphs, as the package's own evaluation does."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_quad.deploy.bundle import Bundle
from torchrl_quad.deploy.contract import ENDS, MEASURED, Arrays
from torchrl_quad.errors import UserValueError


class Judge:
    """Follows the flights of n drones, step by step, and judges their first episodes.

    They begin in the states ``starts`` (n, ...): the drone's quantities, and the task's entries. ValueError where the
    task of the bundle cannot be judged without what a bundle lacks, such as obstacles.
    """

    def __init__(self, bundle: Bundle, starts: Arrays) -> None:
        contract = bundle.contract
        if why := contract["task"]["unjudged"]:
            raise UserValueError(f"Flights of the task {contract['task']['name']!r} cannot be judged here: {why}.")
        self.graphs, self.entries, self.dtype = bundle.graphs, [*contract["task"]["entries"]], contract["task"]["dtype"]
        n = len(starts["position"])
        hover = np.array(contract["output"]["hover_action"], self.dtype)
        self.queue = np.tile(hover, (n, contract["action_delay"], 1))
        self.state = self._drone(starts) | {name: starts[name] for name in self.entries}
        self.state["step"] = np.zeros((n, 1), np.int64)
        self.obstacles = {name: x for name, x in starts.items() if name.startswith("scene.")}
        self.states: list[Arrays] = [self.state]
        self.actions: list[NDArray[Any]] = []
        self.found: list[Arrays] = []

    def _drone(self, state: Arrays) -> Arrays:
        queue = {"action_queue": self.queue} if self.queue.shape[1] else {}
        return {name: np.asarray(state[name], self.dtype) for name in MEASURED} | queue

    def step(self, action: NDArray[Any], state: Arrays) -> NDArray[np.bool_]:
        """Where drones have ended an episode (n), that are in a state (n, ...) one step after actions (n, 4)."""
        if self.queue.shape[1]:
            self.queue = np.concatenate((self.queue[:, 1:], np.asarray(action, self.dtype)[:, None]), 1)
        before = {f"previous.{name}": x for name, x in self.state.items()}
        self.state = self.state | self._drone(state) | {"step": self.state["step"] + 1}
        if "advance" in self.graphs:
            self.state |= self.graphs["advance"](before | self.state)
        found = self.graphs["judge"](before | self.state | self.obstacles)
        found["done"] = found["terminated"] | found["truncated"]
        self.states.append(self.state)
        self.actions.append(np.asarray(action, self.dtype))
        self.found.append(found)
        return found["done"][:, 0]

    def flight(self) -> Arrays:
        """The task's entries (n, time + 1, ...), and how states end their episode (n, time)."""
        entries = {name: np.stack([x[name] for x in self.states], 1) for name in self.entries}
        return entries | {name: np.stack([x[name][:, 0] for x in self.found], 1) for name in (*ENDS, "done")}

    def metrics(self) -> Arrays:
        """What the first episodes come to, by name, each (n): ``solved`` and ``crash``, 0 or 1, and the task's metrics,
        in SI units."""
        flight = {"action": np.stack(self.actions, 1)}
        for name in self.state:
            whole = np.stack([x[name] for x in self.states], 1)
            flight |= {f"state.{name}": whole[:, :-1], f"next.state.{name}": whole[:, 1:]}
        flight |= {f"next.{name}": np.stack([x[name] for x in self.found], 1) for name in self.found[0]}
        return self.graphs["episode"](flight)


def judge(bundle: Bundle, flight: Arrays) -> Arrays:
    """Judge the first episodes of a flight: by name ``action`` (n, time, 4), the drone's quantities (n, time + 1, ...),
    of which the first are the start, and the task's entries and the obstacles (n, ...) that it starts with."""
    first = {name: flight[name][:, 0] for name in MEASURED}
    found = Judge(bundle, flight | first)
    for t in range(flight["action"].shape[1]):
        found.step(flight["action"][:, t], {name: flight[name][:, t + 1] for name in MEASURED})
    return found.metrics()
