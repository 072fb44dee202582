"""The racing task."""

import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_quad.dynamics import presets
from torchrl_quad.engine.packing import Key
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs import terms
from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.guard import MAX_STEPS
from torchrl_quad.envs.markers import Markers
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, first_episode, read
from torchrl_quad.errors import UserValueError, shown
from torchrl_quad.options import Size, accepted, between, check_value

WEIGHTS = {  # of the reward's terms, by reward
    "position": {**terms.TARGET_WEIGHTS, "gate": 20.0},
    "velocity": {"towards": 0.02, "across": 0.02, "angular_velocity": 0.001, "gate": 5.0},
}
RELAXATION_WEIGHTS = {"log": {"gate": 5.0}, "reciprocal": {"gate": 1.0}}
MAX_GATES = 1_000
GateRadius = Annotated[float, between(0.01, 100.0)]
_TRACK = "the name of a track, the path of a YAML file, or a mapping"
TrackOption = Annotated[Any, accepted(lambda x: isinstance(x, str | Path | Mapping), _TRACK)]
_TRACKS = resources.files("torchrl_quad.envs") / "tracks"


class RacingEnv(QuadrotorEnv):
    """Fly through gates in their order, round after round (paper, table I and section V-E).

    ==========================================  ====  =============================================
    observation                                 size  unit
    ==========================================  ====  =============================================
    next gate - position                        3     m, world frame
    gate after that - position                  3     m, world frame
    10 quaternion                               4     (w, x, y, z), body to world
    velocity                                    3     m/s, world frame
    angular velocity                            3     rad/s, body frame
    ==========================================  ====  =============================================

    Reward "velocity": 0.02 min(v_t, 15) - 0.02 |v_a| / (d + 1) - 0.001 |w|, and a gate bonus of 5, where v_t is the
    velocity towards the next gate, v_a the part of the velocity across that direction, and d the distance to the gate
    [m]. Reward "position": that of hovering, with the next gate as its target, and a gate bonus of 20. The binary bonus
    is paid in the step that passes a gate and carries no gradient; with ``event_discount`` the time at which the drone
    enters the gate's sphere does. Two relaxations replace the bonus by one in each step: "log", -5 log(d + 0.01), and
    "reciprocal", 1 / (d + 0.05).

    A gate is passed when the straight line that the drone flew in a control step comes within 0.3 m of its centre. The
    reward of that step is already about the gate after it.

    Start: level and at rest, uniformly within 0.2 m of one of four points along each axis, each before another gate.
    State added: ``gate`` (1), the index of the next; ``target`` (3) [m], its centre; ``gate_passed`` (1), whether this
    step passed one; ``gates_passed`` (1) in this episode; ``pass_step`` (gates), when each was passed last, -1 for
    never; ``lap_time`` (1) [s], of the last full lap, 0 before.

    End: crash when x or y leaves the gates behind by 4 m, or outside 0 < z < 6 m; truncated after
    ``max_episode_steps``, 512. Success of a state: 8 gates passed. Success of an episode: 8 gates, without a crash.

    Metrics: ``gates_passed``; ``lap_time`` [s], from a gate to the same gate again, NaN for an episode without a full
    lap; ``time_near_gate`` [s], within 1 m of the next gate.

    Args:
        track: "visfly", "six_gates", the path of a YAML file, or a mapping, with ``gates``, a list of 2 to 1000 centres
            [m]; and, if wanted, ``starts``, as many points [m] (by default half way between gates), and
            ``gate_radius``, 0.01 to 100 m. Coordinates are within 10 km.
        reward: which of the two rewards above.
        gate_bonus: how gates are paid, as above.
        **kwargs: as for :class:`~torchrl_quad.envs.QuadrotorEnv`.
    """

    start_range = 0.2  # [m], to both sides of the start
    box_margin = 4.0  # [m], beyond the outermost gates
    box_height = 6.0  # [m]; a track that is higher has 4 m above it
    max_rewarded_speed = 15.0  # [m/s]
    success_gates = 8
    metric_info = {
        **EPISODE_METRICS,
        "gates_passed": Metric("gates passed", goal="max"),
        "lap_time": Metric("lap time", "s", goal="min"),
        "time_near_gate": Metric("time near a gate", "s"),
    }

    def __init__(
        self,
        num_envs: Size = 64,
        *,
        track: TrackOption = "visfly",
        reward: Literal["position", "velocity"] = "velocity",
        gate_bonus: Literal["binary", "log", "reciprocal"] = "binary",
        max_episode_steps: Size = 512,
        **kwargs: Any,
    ) -> None:
        self.track, self.reward, self.gate_bonus = load_track(track), reward, gate_bonus
        self.weights = {**WEIGHTS[reward], **RELAXATION_WEIGHTS.get(gate_bonus, {})}
        super().__init__(num_envs, max_episode_steps=max_episode_steps, **kwargs)

    def set_up(self) -> None:
        self.gates, self.starts = self.tensor(self.track["gates"]), self.tensor(self.track["starts"])
        self.gate_indices = torch.arange(len(self.gates), device=self.device)
        low, high = self.gates.amin(0), self.gates.amax(0)
        self.centre = 0.5 * (low + high)
        self.half_width = 0.5 * (high - low)[:2] + self.box_margin
        self.ceiling = max(self.box_height, high[2].item() + self.box_margin)
        for start, point in zip(self.starts, self.track["starts"], strict=True):
            corners = torch.stack((start - self.start_range, start + self.start_range))
            if self.is_crash({"position": corners}).any():
                raise UserValueError(
                    f"track: drones start within {self.start_range} m of {point}, which is not all inside the box: x "
                    f"and y at most {self.box_margin} m beyond the gates, 0 < z < {self.ceiling} m. Move that start."
                )

    def initial_state(self, n: int) -> State:
        gate = self.integers(len(self.gates), n, 1)
        start = self.hover_state(self.starts[gate[:, 0]] + self.start_range * self.uniform(n, 3))
        return {
            **start,
            "gate": gate,
            "target": self.gates[gate[:, 0]],
            "gate_passed": torch.zeros_like(gate, dtype=torch.bool),
            "gates_passed": torch.zeros_like(gate),
            "pass_step": torch.full_like(gate, -1).repeat(1, len(self.gates)),
            "lap_time": torch.zeros_like(start["position"][:, :1]),
        }

    def advance(self, previous: State, state: State) -> State:
        gate, step = previous["gate"], state["step"]
        with torch.no_grad():  # how close to the gate the straight line between the two positions comes
            start, centre = previous["position"], self.gates[gate[:, 0]]
            line = state["position"] - start
            along = ((centre - start) * line).sum(-1, keepdim=True)
            fraction = (along / line.square().sum(-1, keepdim=True).clamp_min(1e-12)).clamp(0.0, 1.0)
            passed = terms.norm(start + fraction * line - centre) < self.track["gate_radius"]
        this_gate = passed & (gate == self.gate_indices)
        last_pass = previous["pass_step"].gather(1, gate)
        lap = (step - last_pass).to(self.dtype) * self.control_dt
        next_gate = torch.where(passed, (gate + 1) % len(self.gates), gate)
        return {
            **state,
            "gate": next_gate,
            "target": self.gates[next_gate[:, 0]],
            "gate_passed": passed,
            "gates_passed": previous["gates_passed"] + passed,
            "pass_step": torch.where(this_gate, step, previous["pass_step"]),
            "lap_time": torch.where(passed & (last_pass >= 0), lap, previous["lap_time"]),
        }

    def events(self, previous: State, state: State) -> dict[str, terms.Event]:
        """``gate``: the drone enters the sphere of the gate that it passes in this step."""
        if self.gate_bonus != "binary":
            return {}
        ends = previous["position"], state["position"]
        time = terms.ball_entry(*ends, previous["target"], self.track["gate_radius"])
        return {"gate": terms.Event(state["gate_passed"], time, self.weights["gate"])}

    def observe(self, state: State) -> Tensor:
        gate = state["gate"][:, 0]  # any number, in environments that are not reset
        relative = [self.gates[k % len(self.gates)] - state["position"] for k in (gate, gate + 1)]
        return torch.cat((*relative, *terms.body_observation(state)), -1)

    def observation_bounds(self) -> Tensor:
        width, depth = (2.0 * self.half_width).tolist()  # from one side of the box to the other
        return self.tensor((*2 * (width, depth, self.ceiling), *terms.BODY_BOUNDS))

    def reward_terms(self, state: State) -> State:
        gap = terms.distance(state)
        if self.reward == "position":
            rewards = terms.target_reward(state, self.weights)
        else:
            direction = (state["target"] - state["position"]) / gap.clamp_min(1e-6)
            towards = (state["velocity"] * direction).sum(-1, keepdim=True)
            across = terms.norm(state["velocity"] - towards * direction)
            rewards = {
                "towards": self.weights["towards"] * towards.clamp_max(self.max_rewarded_speed),
                "across": -self.weights["across"] * across / (gap + 1.0),
                "angular_velocity": -self.weights["angular_velocity"] * terms.norm(state["angular_velocity"]),
            }
        bonus = state["gate_passed"].to(self.dtype)
        if self.gate_bonus != "binary":
            bonus = -torch.log(gap + 0.01) if self.gate_bonus == "log" else 1.0 / (gap + 0.05)
        return {**rewards, "gate": self.weights["gate"] * bonus}

    def is_crash(self, state: State) -> Tensor:
        return terms.outside(state["position"], self.centre, self.half_width, self.ceiling)

    def is_success(self, state: State) -> Tensor:
        return state["gates_passed"] >= self.success_gates

    def metrics(self, state: State) -> State:
        return {"gates_passed": state["gates_passed"].to(self.dtype), "lap_time": state["lap_time"]}

    def state_bounds(self) -> dict[Key, tuple[float, float]]:
        counts = {"gates_passed": (0, MAX_STEPS), "pass_step": (-1, MAX_STEPS)}
        return {"gate": (0, len(self.gates) - 1), "lap_time": (0, math.inf), **counts}

    def episode_metrics(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Gives a ``lap_time`` only to drones that flew a full lap; adds ``time_near_gate``, within 1 m of the next."""
        metrics = super().episode_metrics(rollout)
        lap_time = torch.where(metrics["lap_time"] > 0, metrics["lap_time"], torch.nan)
        far = terms.norm(read(rollout, "state", "position") - read(rollout, "state", "target"))
        near = (far < 1.0) & first_episode(rollout)
        return {**metrics, "lap_time": lap_time, "time_near_gate": self.control_dt * near.sum((1, 2)).to(self.dtype)}

    def markers(self) -> Markers:
        gates = {"gates": self.gates, "gate_radius": self.track["gate_radius"]}
        return Markers("next gate", **gates, progress="gates_passed", success=self.success_gates)


def load_track(track: str | Path | Mapping = "visfly") -> dict[str, Any]:
    """Read a track: the name of one in the package, the path of a YAML file, or a mapping.

    Returns:
        ``gates`` and ``starts``, equally long lists of points [m], and ``gate_radius`` [m].

    Raises:
        ValueError: a key is unknown or missing, or a value is not what :class:`RacingEnv` takes.
        FileNotFoundError: there is no such file.
    """
    source, values = presets.read("track", track, _TRACKS)
    for key in values.keys() - {"gates", "starts", "gate_radius"}:
        raise UserValueError(f"{source}: unknown key {shown(key)}. Allowed: gates, starts, gate_radius.")
    gates = _points(source, "gates", values.get("gates"))
    if not 2 <= len(gates) <= MAX_GATES:
        raise UserValueError(f"{source}: a track has 2 to {MAX_GATES} gates, got {len(gates)}.")
    before = [gates[-1], *gates[:-1]]
    halfway = [[0.5 * (p + q) for p, q in zip(a, b, strict=True)] for a, b in zip(before, gates, strict=True)]
    starts = _points(source, "starts", values.get("starts", halfway))
    if len(starts) != len(gates):
        raise UserValueError(f"{source}: there must be one start before each gate, got {len(starts)} for {len(gates)}.")
    radius = check_value(f"{source}: gate_radius", values.get("gate_radius", 0.3), GateRadius, "Of all gates [m].")
    return {"gates": gates, "starts": starts, "gate_radius": float(radius)}


def _points(source: str, name: str, value: Any) -> Any:
    try:
        points = presets.as_array(value.tolist() if isinstance(value, Tensor) else value)
    except (ValueError, RecursionError):
        points = np.zeros(0)
    is_list = points.ndim == 2 and points.shape[-1] == 3
    if not (is_list and (abs(points) < 1e4).all() and (points[..., -1] > 0).all()):
        raise UserValueError(
            f"{source}: {name} must be a list of points [x, y, z] in metres above ground, within 10 km; got "
            f"{shown(value)}."
        )
    return points.tolist()
