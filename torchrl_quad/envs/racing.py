"""The racing task."""

import math
from typing import Annotated, Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from torchrl_quad.dynamics import quaternion
from torchrl_quad.engine.packing import Key
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs import terms
from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.gates import around, beyond_edges, least_distance, nearest_frame
from torchrl_quad.envs.guard import MAX_STEPS
from torchrl_quad.envs.markers import Markers, Shape, rims
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, first_episode, read
from torchrl_quad.envs.scenes import reach_of
from torchrl_quad.envs.track import MARGIN, Course, TrackOption, forward, load_track, starts_before
from torchrl_quad.errors import UserValueError
from torchrl_quad.options import Size, between

WEIGHTS = {  # of the reward's terms, by reward
    "position": {**terms.TARGET_WEIGHTS, "gate": 20.0},
    "velocity": {"towards": 0.02, "across": 0.02, "angular_velocity": 0.001, "gate": 5.0},
}
RELAXATION_WEIGHTS = {"log": {"gate": 5.0}, "reciprocal": {"gate": 1.0}}
GATES, ROTATIONS = ("track", "gates"), ("track", "rotations")  # in the state, where each episode has another track
FirstGate = Annotated[int, between(0, 999)]
START_ROOM = 0.05  # [m], to the sides of the box, at least
FUNNEL = 0.5  # how far before a gate the reward leads, as a share of the way to the axis of the gate
ROUND = 0.1  # [m], from the axis, where the way to it is rounded off
SLOW = 1.0  # [m/s], towards a gate: slower drones are led back before its plane, since they would hang at it
BRAKING, LEAST_ROOM = 15.0, 0.05  # [m/s2], what costs nothing; [m], below which nothing gets nearer
CLEARANCE = 2.0  # how far past obstacles the reward leads, in radii of the drone; at most as far as a gate allows


class RacingEnv(QuadrotorEnv):
    """Fly through gates in their order, round after round (paper, table I and section V-E).

    ==========================================  ====  =============================================
    observation                                 size  unit
    ==========================================  ====  =============================================
    next gate - position                        3     m, world frame
    gate after that - position                  3     m, world frame
    10 directions of these two gates            6     world frame; with ``observe_directions``
    10 way to the planes of these two gates     2     m, at most 1 to both sides; with ``observe_directions``
    10 quaternion                               4     (w, x, y, z), body to world
    velocity                                    3     m/s, world frame
    angular velocity                            3     rad/s, body frame
    ==========================================  ====  =============================================

    Reward "velocity": 0.02 min(v_t, 15) - 0.02 |v_a| / (d + 1) - 0.001 |w|, and a gate bonus of 5, where v_t is the
    velocity towards the next gate, v_a the part of the velocity across that direction, and d the distance to the gate
    [m]. Reward "position": that of hovering, with the next gate as its target, and a gate bonus of 20. The binary bonus
    is paid in the step that passes a gate and carries no gradient; with ``event_discount`` the time at which the drone
    enters the gate's sphere, or crosses its plane, does. Two relaxations replace the bonus by one in each step: "log",
    -5 log(d + 0.01), and "reciprocal", 1 / (d + 0.05).

    Where gates have a direction, d and v_a are about a point on the axis of the gate, before it by half of the drone's
    distance from the axis, and by the drone's way beyond the gate, which for a drone slower than 1 m/s begins up to
    half of the smallest opening before the gate; v_t is how fast the way over that point gets shorter. Where that way
    passes an obstacle of the scene within two radii of the drone, v_t and v_a are about the direction that clears it. A
    step that crosses the plane of the gate elsewhere, or touches a frame and does not pass, takes up to a bonus away,
    tanh(m) of it at m [m] from half of the opening. A drone pays 0.5 log(a / 15) for each side of the box ahead, and
    for the nearest obstacle or frame, that takes a > 15 m/s2 to stop before, a = v^2 / (2 d) with the speed v towards
    it and the distance d, since a crash has no gradient; with spheres, too, by ``weights={"closing": 0.5}``.

    A point is passed when the straight line of a control step comes within 0.3 m of it, a gate with a direction when
    that line crosses its plane, from behind, within its opening; one gate at most counts in a step. The reward of that
    step is about the gate after it.

    Start: level and at rest before a gate drawn at random, uniformly within 0.2 m along each axis of its start point.
    State added: ``gate`` (1), the index of the next; ``target`` (3) [m], its centre; ``gate_passed`` (1), whether this
    step passed one; ``gates_passed`` (1) in this episode; ``pass_step`` (gates), when each was passed last, -1 for
    never; ``lap_time`` (1) [s], of the last full lap, 0 before; ``frame_touched`` (1), where gates have frames; and
    where each episode draws its gates, ``("track", "gates")`` (gates, 3) [m] and ``("track", "rotations")`` (gates, 4).

    End: crash when x or y leaves the gates behind by 4 m, outside 0 < z < 6 m, or when the drone touches a frame;
    truncated after ``max_episode_steps``, 512. Success of a state: 8 gates passed. Success of an episode: 8 gates,
    without a crash. A track that is not ``closed`` ends in success at its last gate.

    Metrics: ``gates_passed``; ``lap_time`` [s], from a gate to the same gate again (not ``closed``: from a start before
    the first to the last), NaN without a full lap; ``time_near_gate`` [s], within 1 m of the next gate.

    A track is a mapping, or a YAML file of one:

    .. code-block:: yaml

        gates:                                          # in the order of flight
          - {position: [4, 0, 2], yaw: 1.57}            # the direction of flight [rad]; with a pitch, if wanted
          - {position: [0, 4, 2], rotation: [0, 0, 0, 1]}  # or (w, x, y, z), whose x axis it is
        width: 1.5                                      # m, of openings; or a radius; or one for each gate
        height: 1.5
        frame: 0.1                                      # m, bars around them; the drone counts as a ball

    Gates of points are ``gates: [[4, 0, 2], [0, 4, 2]]``, with a ``gate_radius`` [m]. A track may also say:

    - ``starts``, a point before each gate [m], by default half way from the gate before, or up to 3 m before a gate
      with a direction; ``start``, only the first; ``start_range``, 0.2 m;
    - ``closed``, whether the first gate follows the last, true;
    - ``floor`` [m], 0; or ``box``, the lowest and the highest corner [m] of where drones may be, with its own floor,
      instead of 4 m of room;
    - ``position_jitter`` [m], ``rotation_jitter`` [rad], three numbers each: how far each episode moves gates;
    - ``random``, instead of gates: the rules (:class:`~torchrl_quad.envs.track.Course`) by which each episode draws
      other gates;
    - ``scene``, obstacles, as for :class:`~torchrl_quad.envs.QuadrotorEnv`.

    Args:
        track: "visfly", "six_gates", "time_optimal", "split_s", "alpha_pilot", "airsim", "lsy_level0", "random", the
            path of a file, or a mapping, with 2 to 1000 gates. ``{"file": PATH, "width": 1.5}`` adds to a file.
        reward: which of the two rewards above.
        gate_bonus: how gates are paid, as above.
        observe_directions: whether the policy observes the directions of gates.
        first_gate: the index of the gate before which all episodes start; by default any.
        **kwargs: as for :class:`~torchrl_quad.envs.QuadrotorEnv`.
    """

    start_range = 0.2  # [m], to both sides of the start
    box_margin = MARGIN  # [m], beyond the outermost gates
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
        observe_directions: bool = False,
        first_gate: FirstGate | None = None,
        max_episode_steps: Size = 512,
        **kwargs: Any,
    ) -> None:
        self.track, self.reward, self.gate_bonus = load_track(track), reward, gate_bonus
        self.observe_directions, self.first_gate = observe_directions, first_gate
        if first_gate is not None and first_gate >= len(self.track["gates"]):
            raise UserValueError(f"first_gate={first_gate}: the track has {len(self.track['gates'])} gates, from 0.")
        if observe_directions and "gate_radius" in self.track:
            raise UserValueError("observe_directions=True needs gates with a direction; this track has spheres.")
        self.is_closed, self.frame = self.track.get("closed", True), self.track.get("frame", 0.0)
        self.ends_on_success = not self.is_closed
        self.start_range = self.track.get("start_range", self.start_range)
        self.weights = {**WEIGHTS[reward], **RELAXATION_WEIGHTS.get(gate_bonus, {})}
        self.weights["closing"] = 0.0 if "gate_radius" in self.track else 0.5
        if "scene" in self.track:
            if kwargs.get("scene") is not None:
                why = "this track has obstacles, and scene has others"
                raise UserValueError(f"{why}. Write yours into the track: env.track={{file: ..., scene: ...}}.")
            kwargs["scene"] = self.track["scene"]
        super().__init__(num_envs, max_episode_steps=max_episode_steps, **kwargs)

    def set_up(self) -> None:
        track, gates = self.track, self.track["gates"]
        self.is_directed = "gate_radius" not in track
        self.rotations = self.openings = self.tensor([])  # half of widths and heights (k, 2), or radii (k, 1)
        if self.is_directed:
            sizes = [[g["radius"]] if "radius" in g else [0.5 * g["width"], 0.5 * g["height"]] for g in gates]
            self.rotations, self.openings = self.tensor([gate["rotation"] for gate in gates]), self.tensor(sizes)
            gates = [gate["position"] for gate in gates]
        self.gate_radius = self.openings.min().item() if self.is_directed else track["gate_radius"]
        self.gates, self.starts = self.tensor(gates), self.tensor(track["starts"])
        self.gate_indices = torch.arange(len(self.gates), device=self.device)
        self.course = Course(**track["random"]) if "random" in track else None
        self.moved, self.turned = (self.tensor(track.get(f"{x}_jitter", (0.0,) * 3)) for x in ("position", "rotation"))
        self.is_drawn = self.course is not None or bool(self.moved.any() or self.turned.any())
        self.drone_radius, self.floor = reach_of(self.nominal), track.get("floor", 0.0)
        low, high = self.gates.amin(0), self.gates.amax(0)
        if self.course is not None:
            reach, heights = self.course.reach, self.course.heights
            low, high = self.tensor([[-reach, -reach, min(heights)], [reach, reach, max(heights)]])
        low, high = low - self.moved, high + self.moved
        places = {f"gates stand from {_metres(low)} to {_metres(high)}": (low, high)}
        if self.course is None:  # else starts are put inside the box
            room = self.moved + self.start_range  # starts move with their gates
            for start, point in zip(self.starts, track["starts"], strict=True):
                places[f"drones start within {self.start_range} m of {point}"] = (start - room, start + room)
        self.half_width = 0.5 * (high - low)[:2] + self.box_margin
        self.ceiling = max(self.box_height, high[2].item() + self.box_margin)
        if "box" in track:
            low, high = self.tensor(track["box"])
            self.half_width, self.floor, self.ceiling = 0.5 * (high - low)[:2], low[2].item(), high[2].item()
        self.centre = 0.5 * (low + high)
        self.centre[2] = 0.5 * (self.floor + self.ceiling)
        self.half_box = torch.cat((self.half_width, self.centre[2:] - self.floor))
        for what, corners in places.items():
            if self.is_crash({"position": torch.stack(corners)}).any():
                low, high = (_metres(self.centre + sign * self.half_box) for sign in (-1.0, 1.0))
                raise UserValueError(
                    f"track: {what}, which is not all inside the box from {low} to {high} m. Move them, or give a "
                    "wider box, or less position_jitter or start_range."
                )

    def initial_state(self, n: int) -> State:
        gate = self.integers(len(self.gates), n, 1)
        if self.first_gate is not None:
            gate = torch.full_like(gate, self.first_gate)
        state = self.draw_track(n)
        target, starts = self.pose(state, gate)[0], self.starts[gate[:, 0]]
        if "position_jitter" in self.track:
            starts = starts + target - self.gates[gate[:, 0]]
        if self.course is not None:
            every = starts_before(state[GATES], state.get(ROTATIONS), self.floor)
            room = (self.half_box - self.start_range - START_ROOM).clamp_min(0.0)
            own = every[torch.arange(n, device=self.device), gate[:, 0]]
            starts = self.centre + torch.clamp(own - self.centre, -room, room)
        start, no = self.hover_state(starts + self.start_range * self.uniform(n, 3)), torch.zeros_like(gate).bool()
        return {
            **start,
            **state,
            **({"frame_touched": no} if self.frame else {}),
            "gate": gate,
            "target": target,
            "gate_passed": no.clone(),
            "gates_passed": torch.zeros_like(gate),
            "pass_step": torch.full_like(gate, -1).repeat(1, len(self.gates)),
            "lap_time": torch.zeros_like(start["position"][:, :1]),
        }

    def draw_track(self, n: int) -> State:
        """What stands in the state of n episodes, each with a track of its own; nothing where all share one."""
        if not self.is_drawn:
            return {}
        gates, rotations = (x.expand(n, *x.shape[1:]) for x in self.poses({}))
        if self.course is not None:
            gates, rotations = self.course.draw(n, self.uniform)
        gates = gates + self.moved * self.uniform(*gates.shape)
        if not self.is_directed:
            return {GATES: gates}
        turn = quaternion.from_axis_angle(self.turned * self.uniform(*gates.shape))
        return {GATES: gates, ROTATIONS: quaternion.multiply(rotations, turn)}

    def poses(self, state: State) -> tuple[Tensor, Tensor]:
        """Centres (n, k, 3) [m] and rotations (n, k, 4) of all gates; n is 1 where all episodes share a track."""
        return state.get(GATES, self.gates.unsqueeze(0)), state.get(ROTATIONS, self.rotations.unsqueeze(0))

    def pose(self, state: State, gate: Tensor) -> tuple[Tensor, Tensor]:
        """Centres (n, 3) [m] and, where gates have a direction, rotations (n, 4) of gates by their index (n, 1)."""
        own = self.poses(state) if self.is_directed else self.poses(state)[:1]
        if self.is_drawn:
            chosen = (gate == self.gate_indices).unsqueeze(-1)  # by weights: bundles know no gather along shapes
            found = [(x * chosen).sum(1) for x in own]
        else:
            found = [x[0, gate[:, 0]] for x in own]
        return found[0], found[-1]

    def crossing(self, previous: State, state: State) -> tuple[Tensor, Tensor]:
        """When a step crosses the plane of the gate that was next, as a fraction of the step with its gradient, (n, 1),
        and whether it does so in its direction and within its opening, (n, 1)."""
        centre, rotation = self.pose(previous, previous["gate"])
        start, end = (quaternion.rotate_inverse(rotation, x["position"] - centre) for x in (previous, state))
        time = terms.level_crossing(-start[:, :1], -end[:, :1], 0.0)
        off = beyond_edges(torch.lerp(start, end, time)[:, 1:], self.openings[previous["gate"][:, 0]])
        return time, (start[:, :1] < 0.0) & (end[:, :1] >= 0.0) & (off < 0.0).all(-1, keepdim=True)

    def obstacle(self, state: State) -> tuple[Tensor, Tensor]:
        """How far the drone's surface is from the nearest obstacle or frame, (n, 1) [m], and the way out (n, 3)."""
        found = [] if self.scene is None else [self.scene.nearest(state)]
        if self.frame:
            distance, away = nearest_frame(state["position"], *self.poses(state), self.openings, self.frame)
            found.append((distance - self.drone_radius, away))
        if len(found) == 1:
            return found[0]
        (distance, away), (other, away_from_it) = found
        return torch.minimum(distance, other), torch.where(distance < other, away, away_from_it)

    def advance(self, previous: State, state: State) -> State:
        gate, step = previous["gate"], state["step"]
        with torch.no_grad():  # how close to the gate the straight line between the two positions comes
            if self.is_directed:
                _, passed = self.crossing(previous, state)
            else:
                start, (centre, _) = previous["position"], self.pose(previous, gate)
                line = state["position"] - start
                along = ((centre - start) * line).sum(-1, keepdim=True)
                fraction = (along / line.square().sum(-1, keepdim=True).clamp_min(1e-12)).clamp(0.0, 1.0)
                passed = terms.norm(start + fraction * line - centre) < self.gate_radius
            more = {}
            if self.frame:
                start, end, poses = previous["position"], state["position"], self.poses(state)
                distance = least_distance(start, end, *poses, self.openings, self.frame)
                more = {"frame_touched": distance < self.drone_radius}
        this_gate = passed & (gate == self.gate_indices)
        last_pass = previous["pass_step"].gather(1, gate)
        lap, is_lap = (step - last_pass).to(self.dtype) * self.control_dt, last_pass >= 0
        if not self.is_closed:  # from the start of the episode, if that was before the first gate
            lap = step.to(self.dtype) * self.control_dt
            is_lap = (gate == len(self.gates) - 1) & (previous["gates_passed"] == gate)
        next_gate = torch.where(passed, (gate + 1) % len(self.gates), gate)
        return {
            **state,
            **more,
            "gate": next_gate,
            "target": self.pose(state, next_gate)[0],
            "gate_passed": passed,
            "gates_passed": previous["gates_passed"] + passed,
            "pass_step": torch.where(this_gate, step, previous["pass_step"]),
            "lap_time": torch.where(passed & is_lap, lap, previous["lap_time"]),
        }

    def events(self, previous: State, state: State) -> dict[str, terms.Event]:
        """``gate``: the drone crosses the plane, or enters the sphere, of the gate that it passes in this step."""
        if self.gate_bonus != "binary":
            return {}
        if self.is_directed:
            time, _ = self.crossing(previous, state)
        else:
            time = terms.ball_entry(previous["position"], state["position"], previous["target"], self.gate_radius)
        return {"gate": terms.Event(state["gate_passed"], time, self.weights["gate"])}

    def observe(self, state: State) -> Tensor:
        gate = state["gate"]  # any number, in environments that are not reset
        poses = [self.pose(state, k % len(self.gates)) for k in (gate, gate + 1)]
        parts = [centre - state["position"] for centre, _ in poses]
        if self.observe_directions:
            ahead = [forward(rotation) for _, rotation in poses]
            ways = zip(parts, ahead, strict=True)
            left = [(gap * along).sum(-1, keepdim=True).clamp(-1.0, 1.0) for gap, along in ways]
            parts += [10.0 * x for x in (*ahead, *left)]
        return torch.cat((*parts, *terms.body_observation(state)), -1)

    def observation_bounds(self) -> Tensor:
        width, depth = (2.0 * self.half_width).tolist()  # from one side of the box to the other
        directions = 8 * (10.0,) if self.observe_directions else ()
        return self.tensor((*2 * (width, depth, self.ceiling - self.floor), *directions, *terms.BODY_BOUNDS))

    def lead(self, state: State) -> tuple[State, Tensor, Tensor]:
        """Where the reward leads, to a gate with a direction: the state in the frame of that gate, x in its direction.

        The target is a point on its axis, before it by half of the way to the axis, and farther for a drone that is
        beyond it, or slow and nearly there: at the gate itself no way back would be rewarded. Then how fast that grows,
        (n, 1) [m/s]; and from 0 to 1 by how far a drone passes the gate that has just crossed its plane, (n, 1).
        """
        rotation, gap = self.pose(state, state["gate"])[1], state["position"] - state["target"]
        place, velocity = (quaternion.rotate_inverse(rotation, x) for x in (gap, state["velocity"]))
        along, aside, speed = place[:, :1], place[:, 1:], velocity[:, :1]
        off = (aside.square().sum(-1, keepdim=True) + ROUND**2).sqrt()
        back = self.gate_radius * (1.0 - speed / SLOW).clamp(0.0, 1.0)
        beyond = along + back - 2.0 * self.control_dt * speed.clamp_min(0.0)  # not in the step that crosses the plane
        before = FUNNEL * (off - ROUND) + beyond.clamp_min(0.0)
        growth = FUNNEL * (aside * velocity[:, 1:]).sum(-1, keepdim=True) / off + torch.where(beyond > 0.0, speed, 0.0)
        beside = beyond_edges(aside, 0.5 * self.openings[state["gate"][:, 0]]).amax(-1, keepdim=True).clamp_min(0.0)
        missed = (along >= 0.0) & (along < self.control_dt * speed)
        missed = missed | state["frame_touched"] if self.frame else missed
        missed = torch.where(missed & ~state["gate_passed"], beside.tanh(), 0.0)  # passed: when another was next
        return {**state, "position": place, "velocity": velocity, "target": pad(-before, (0, 2))}, growth, missed

    def reward_terms(self, state: State) -> State:
        bonus, growth, world = state["gate_passed"].to(self.dtype), None, state
        if self.is_directed:
            state, growth, missed = self.lead(state)
            bonus = bonus - missed
        gap, scene = terms.distance(state), self.scene
        if self.reward == "position":
            rewards = terms.target_reward(state, self.weights)
        else:
            direction = ahead = (state["target"] - state["position"]) / gap.clamp_min(1e-6)
            if growth is not None and scene is not None:
                rotation = self.pose(world, world["gate"])[1]
                clearance = min(CLEARANCE * self.drone_radius, self.gate_radius - self.drone_radius)
                way = world["position"], quaternion.rotate(rotation, ahead), gap
                turned = around(*way, clearance, lambda points: scene.nearest({**world, "position": points}))
                direction = quaternion.rotate_inverse(rotation, turned)
            towards = (state["velocity"] * direction).sum(-1, keepdim=True)
            across = terms.norm(state["velocity"] - towards * direction)
            if growth is not None:  # along the way over that point, which moves
                towards = towards - growth * (1.0 - ahead[:, :1])
            rewards = {
                "towards": self.weights["towards"] * towards.clamp_max(self.max_rewarded_speed),
                "across": -self.weights["across"] * across / (gap + 1.0),
                "angular_velocity": -self.weights["angular_velocity"] * terms.norm(state["angular_velocity"]),
            }
        if self.weights["closing"]:
            place, velocity = world["position"] - self.centre, world["velocity"]
            room, speed = self.half_box - torch.where(velocity > 0.0, place, -place), velocity
            if scene is not None or self.frame:
                distance, away = self.obstacle(world)
                closing = -(away * velocity).sum(-1, keepdim=True)
                room, speed = torch.cat((room, distance), -1), torch.cat((speed, closing.clamp_min(0.0)), -1)
            needed = speed.square() / (2.0 * BRAKING * room.clamp_min(LEAST_ROOM))
            rewards["closing"] = -self.weights["closing"] * needed.clamp_min(1.0).log().sum(-1, keepdim=True)
        if self.gate_bonus != "binary":
            bonus = -torch.log(gap + 0.01) if self.gate_bonus == "log" else 1.0 / (gap + 0.05)
        return {**rewards, "gate": self.weights["gate"] * bonus}

    def is_crash(self, state: State) -> Tensor:
        left = terms.outside(state["position"], self.centre, self.half_width, self.ceiling, self.floor)
        return left | state["frame_touched"] if "frame_touched" in state else left

    def is_success(self, state: State) -> Tensor:
        return state["gates_passed"] >= self.success_gates if self.is_closed else state["pass_step"][:, -1:] >= 0

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
        return self.markers_of({})

    def markers_of(self, drawn: State) -> Markers:
        """The gates of the episode in one environment, or of the track that all share."""
        success = self.success_gates if self.is_closed else len(self.gates)
        gates, rotations = (x[0] for x in self.poses(drawn))
        marked: dict[str, Any] = {"gates": gates, "gate_radius": self.gate_radius}
        if self.is_directed:
            marked["gate_rims"] = rims(gates, rotations, self.openings)
        if self.frame:
            outer = pad(rims(gates, rotations, self.openings + self.frame), (0, 0, 0, 1), value=math.nan)
            marked["shapes"] = [Shape.line(outer.flatten(0, 1))]
        return Markers("next gate", **marked, progress="gates_passed", success=success)


def _metres(point: Tensor) -> list[float]:
    return point.double().round(decimals=3).tolist()
