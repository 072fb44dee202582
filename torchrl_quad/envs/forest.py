"""The forest task."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import softplus

from torchrl_quad.dynamics import quaternion
from torchrl_quad.engine.packing import Key
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.base import QuadrotorEnv
from torchrl_quad.envs.config import CameraOption, SceneOption
from torchrl_quad.envs.markers import Markers
from torchrl_quad.envs.metrics import EPISODE_METRICS, Metric, first_episode, read
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.envs.scenes import ELSEWHERE, MAX_OBSTACLES, Scene, left_out
from torchrl_quad.envs.terms import norm, outside
from torchrl_quad.errors import UserTypeError, UserValueError
from torchrl_quad.options import Size, between, checked, entries

#: Trees per square metre, and the least gap between two of them [m].
DIFFICULTIES = {"easy": (0.04, 1.5), "middle": (0.08, 1.2), "hard": (0.12, 0.9)}
CAMERA = {"width": 16, "height": 12, "range": 10.0}
PLACES = 12  # that are tried for a tree before it is left out
Density = Annotated[float, between(0.0, 2.0)]
Gap = Annotated[float, between(0.1, 10.0)]
Length = Annotated[float, between(1.0, 1_000.0)]
Speed = Annotated[float, between(0.1, 30.0)]
Speeds = Annotated[Sequence[Speed], entries(2, 2)]


class ForestEnv(QuadrotorEnv):
    """Fly through a forest, from one side to the other, at a commanded speed, and touch nothing.

    =============================  ====  ====================================================================
    observation                    size  unit
    =============================  ====  ====================================================================
    velocity                       3     m/s, body frame; not with ``observe_velocity=False``
    10 up                          3     the world's z axis in the body frame
    command                        3     m/s, body frame: the commanded speed, in the direction of the target
    =============================  ====  ====================================================================

    The policy can also read ``"depth"`` (num_envs, 1, height, width) [m], the camera's image. The trees are upright
    cylinders, 6 m high, with radii from 0.1 to 0.4 m, on 30 m by 16 m of ground. Each episode draws new ones.

    Reward, with the velocity v, the command c, the distance d from the drone's surface to the nearest obstacle or the
    ground [m], the direction N away from that, and h(x) = (|x|^2 + 0.25)^(1/2) - 0.5:

    - speed: 0.1 (1 - h(v - c) / h(c)): nothing for a drone that stands still, the most for one that flies as commanded;
    - clearance: -0.1 log(1 + exp((0.3 - d) / 0.1));
    - closing: -0.15 max(-N v, 0) exp(-d / 0.5), the speed towards the nearest surface, where it is near;
    - smoothness: -0.005 |w|^2, with the angular velocity w;
    - heading: -0.05 (1 - cos), with the horizontal angle from the body's x axis to the command;
    - collision: -10 for a crash, and finish: 10 on the other side. These two carry no gradient.

    Start: level and at rest, 1 m to 2 m before the forest, within 4 m of its middle, 1.2 m to 1.8 m high. State added:
    ``target`` (3) [m], straight ahead, 2 m behind the forest and 1.5 m high; ``speed`` (1) [m/s], the commanded one.

    End: success on the other side of the forest; crash when the drone touches a tree or the ground, when it is 8 m from
    the middle, 5 m before the forest, or 4 m high; truncated after ``max_episode_steps``, 900. Success of an episode:
    that it ended in success.

    Metrics: ``distance``, how far the drone has come in the forest [m]; ``flown_speed``, towards the target [m/s], its
    mean over an episode; ``clearance``, d of the trees and the ground [m], the least of an episode.

    Args:
        difficulty: how dense the forest is: 0.04 trees per square metre, at least 1.5 m from each other, for "easy",
            0.08 and 1.2 m for "middle", 0.12 and 0.9 m for "hard".
        density: of trees, 0 to 2 per square metre; overrides the difficulty's. Trees that find no place are left out.
        gap: the least distance between the surfaces of two trees, 0.1 to 10 m; overrides the difficulty's. It is wider
            than the drone, so there always is a way through.
        speed: the least and the greatest commanded speed, 0.1 to 30 m/s, or one for all.
        observe_velocity: whether the policy observes its velocity.
        camera: as for :class:`~torchrl_quad.envs.QuadrotorEnv`; a mapping changes the camera of 16 x 12 pixels, 90
            degrees and 10 m. None flies without one.
        scene: replaces the random forest, as for :class:`~torchrl_quad.envs.QuadrotorEnv`; see that it leaves a way.
        **kwargs: as for :class:`~torchrl_quad.envs.QuadrotorEnv`.
    """

    length, half_width, ceiling = 30.0, 8.0, 4.0  # [m]
    run_up, run_out = (1.0, 2.0), 2.0  # [m], from the start to the forest, and from the forest to the target
    before = 4.0  # [m], before the forest
    start_half_width = 4.0  # [m]
    cruise_height, start_height = 1.5, 0.3  # [m], of the target, and how far from it drones start
    margin, softness, nearness = 0.3, 0.1, 0.5  # [m], of the rewards for clearance and for the closing speed
    weights = {"speed": 0.1, "clearance": 0.3, "closing": 0.15, "smoothness": 0.005, "heading": 0.05}
    weights |= {"collision": 10.0, "finish": 10.0}
    ends_on_success = True
    metric_info = {
        **EPISODE_METRICS,
        "distance": Metric("distance flown", "m"),
        "flown_speed": Metric("speed", "m/s"),
        "clearance": Metric("least clearance", "m"),
    }

    def __init__(
        self,
        num_envs: Size = 64,
        *,
        difficulty: Literal["easy", "middle", "hard"] = "middle",
        density: Density | None = None,
        gap: Gap | None = None,
        speed: Speed | Speeds = (2.0, 8.0),
        observe_velocity: bool = True,
        camera: CameraOption = CAMERA,
        scene: SceneOption = None,
        max_episode_steps: Size = 900,
        **kwargs: Any,
    ) -> None:
        preset = DIFFICULTIES[difficulty]
        density, gap = (own if own is not None else usual for own, usual in zip((density, gap), preset, strict=True))
        speeds = speed if isinstance(speed, Sequence) else [speed, speed]
        if speeds[0] > speeds[1]:
            raise UserValueError(f"speed must be one speed, or the least and then the greatest; got {speed!r}.")
        self.speeds, self.observe_velocity = tuple(speeds), observe_velocity
        if isinstance(camera, Mapping):
            camera = {**CAMERA, **camera}
        scene = Forest(density, gap, self.length, self.half_width) if scene is None else scene
        super().__init__(num_envs, camera=camera, scene=scene, max_episode_steps=max_episode_steps, **kwargs)

    def set_up(self) -> None:
        self.centre = self.tensor([0.5 * (self.length - self.before), 0.0, 0.0])
        self.extent = self.tensor([0.5 * (self.length + self.before) + 1.0, self.half_width])

    def initial_state(self, n: int) -> State:
        across, along, up = self.uniform(3, n, 1)
        x = -0.5 * (self.run_up[0] + self.run_up[1]) + 0.5 * (self.run_up[1] - self.run_up[0]) * along
        y, z = self.start_half_width * across, self.cruise_height + self.start_height * up
        ends = torch.full_like(x, self.length + self.run_out), y, torch.full_like(z, self.cruise_height)
        low, high = self.speeds
        speed = low + (high - low) * 0.5 * (self.uniform(n, 1) + 1.0)
        start = self.hover_state(torch.cat((x, y, z), -1))
        return {**start, "target": torch.cat(ends, -1), "speed": speed}

    @property
    def scene(self) -> Scene:
        """The obstacles, which a forest always has."""
        return cast(Scene, self.disturbances["scene"])  # a compiler cannot trace super().scene

    def command(self, state: State) -> Tensor:
        """The commanded velocity (n, 3) [m/s], world frame."""
        way = state["target"] - state["position"]
        return state["speed"] * way / norm(way).clamp_min(1.0)

    def observe(self, state: State) -> Tensor:
        q = state["quaternion"]
        command = quaternion.rotate_inverse(q, self.command(state))
        parts = 10.0 * quaternion.up_in_body(q), command
        if self.observe_velocity:
            parts = quaternion.rotate_inverse(q, state["velocity"]), *parts
        return torch.cat(parts, -1)

    def observation_bounds(self) -> Tensor:
        velocity = 3 * (50.0,) if self.observe_velocity else ()
        return self.tensor((*velocity, *3 * (10.0,), *3 * (self.speeds[1],)))

    def reward_terms(self, state: State) -> State:
        velocity, command, weights = state["velocity"], self.command(state), self.weights
        distance, away = self.scene.nearest(state)
        closing = (-(away * velocity).sum(-1, keepdim=True)).clamp_min(0.0)
        terms = {
            # 0.0099 is that of 0.1 m/s, the least command but for the last metre before the target, outside the forest.
            "speed": 1.0 - _gentle(velocity - command) / _gentle(command).clamp_min(0.0099),
            "clearance": -self.softness * softplus((self.margin - distance) / self.softness) / self.margin,
            "closing": -closing * torch.exp(-distance.clamp_min(0.0) / self.nearness),
            "smoothness": -state["angular_velocity"].square().sum(-1, keepdim=True),
            "heading": self.heading(state) - 1.0,
            "collision": -self.is_crash(state).to(self.dtype),
            "finish": self.is_success(state).to(self.dtype),
        }
        return {name: weights[name] * term for name, term in terms.items()}

    def heading(self, state: State) -> Tensor:
        """The cosine of the horizontal angle from the body's x axis to the target, (n, 1)."""
        ahead = torch.zeros_like(state["position"]) + self.tensor([1.0, 0.0, 0.0])
        nose = quaternion.rotate(state["quaternion"], ahead)[..., :2]
        way = (state["target"] - state["position"])[..., :2]
        return (nose * way).sum(-1, keepdim=True) / (norm(nose) * norm(way)).clamp_min(0.1)

    def is_crash(self, state: State) -> Tensor:
        position = state["position"]
        left = outside(position, self.centre, self.extent, self.ceiling)
        return left | (position[..., 2:] < self.scene.radius) | state["collided"]

    def is_success(self, state: State) -> Tensor:
        return (state["position"][..., :1] >= self.length) & ~self.is_crash(state)

    def metrics(self, state: State) -> State:
        command = self.command(state)
        along = (state["velocity"] * command).sum(-1, keepdim=True) / norm(command).clamp_min(1e-6)
        distance = state["position"][..., :1].clamp(0.0, self.length)
        return {"distance": distance, "flown_speed": along, "clearance": self.scene.nearest(state)[0]}

    def state_bounds(self) -> dict[Key, tuple[float, float]]:
        return {"speed": (0.1, 30.0)}

    def episode_metrics(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Takes ``flown_speed`` as the mean over the episode [m/s], and ``clearance`` as its least value [m]."""
        first = first_episode(rollout)
        speed = (read(rollout, "metrics", "flown_speed") * first).sum(1) / first.sum(1)
        clearance = torch.where(first, read(rollout, "metrics", "clearance"), math.inf).amin(1)
        own = {"flown_speed": speed.squeeze(-1), "clearance": clearance.squeeze(-1)}
        return {**super().episode_metrics(rollout), **own}

    def markers(self) -> Markers:
        return Markers(progress="distance", success=self.length)


@checked
class Forest(Scene):
    """A random forest on flat ground: a new one in each episode, whose trees keep a gap between each other.

    Trees are drawn uniformly over the ground. A tree is left out if none of 12 places is far enough from the trees
    before it. Since the gaps are wider than the drone, trees made thicker by its radius do not touch each other, and
    so enclose nothing: there is a way through.

    Args:
        density: trees per square metre, 0 to 2; at most 1000 in all.
        gap: the least distance between the surfaces of two trees, 0.1 to 10 m, more than the drone's diameter.
        length, half_width: of the forest, along x from 0, and to both sides of y = 0, 1 to 1000 m.
        radius: the least and the greatest radius of a tree, 0.01 to 10 m.
        height: of all trees, 0.1 to 100 m.
        **options: as for :class:`~torchrl_quad.Scene`, but for ground and source.
    """

    def __init__(
        self,
        density: Density,
        gap: Gap,
        length: Length = 30.0,
        half_width: Length = 8.0,
        *,
        radius: Annotated[Sequence[Annotated[float, between(0.01, 10.0)]], entries(2, 2)] = (0.1, 0.4),
        height: Annotated[float, between(0.1, 100.0)] = 6.0,
        **options: Any,
    ) -> None:
        if radius[0] > radius[1]:
            raise UserValueError(f"radius must be the least and then the greatest radius of a tree; got {radius!r}.")
        self.trees = round(density * 2.0 * half_width * length)
        if self.trees > MAX_OBSTACLES:
            raise UserValueError(f"density={density:g} makes {self.trees:,} trees; the maximum is {MAX_OBSTACLES:,}.")
        self.gap, self.length, self.half_width, self.tree_radius, self.height = gap, length, half_width, radius, height
        if fixed := sorted({"ground", "source"} & set(options)):
            raise UserTypeError(f"A forest has a {fixed[0]} of its own: leave it out.")
        super().__init__(ground=True, source="forest", **options)

    def bound(self, nominal: Any) -> Scene:
        own = super().bound(nominal)
        if self.gap <= 2.0 * own.radius:
            raise UserValueError(
                f"forest: a drone of radius {own.radius:.3g} m does not fit through gaps of {self.gap:g} m, so the "
                f"trees could leave no way through. Give a gap of more than {2.0 * own.radius:.3g} m."
            )
        return own

    def draw(self, random: Randomness, state: State) -> dict[str, Tensor]:
        n, m = len(state["position"]), self.trees
        if not m:
            return {}
        low, high = self.tree_radius
        radius = low + (high - low) * 0.5 * (random.uniform(n, m, 1) + 1.0)
        tries = random.uniform(n, m, PLACES, 2) * random.tensor([0.5 * self.length, self.half_width])
        x, y = (tries + random.tensor([0.5 * self.length, 0.0])).unbind(-1)  # (n, m, places)
        crowded = []
        for i in range(m):  # each takes the first of its places that is far enough from the trees before it
            apart = radius[:, :i] + radius[:, i : i + 1] + self.gap
            dx, dy = (u[:, i, None] - u[:, :i, :1] for u in (x, y))  # (n, i, places)
            is_free = (dx.square().add_(dy.square()) >= apart.square()).all(1)
            found = is_free.any(1, keepdim=True)
            place = is_free.to(torch.uint8).argmax(1, keepdim=True)
            for u in (x, y):
                u[:, i, :1] = torch.where(found, u[:, i].gather(1, place), ELSEWHERE)
            crowded.append(~found)
        place, rest = torch.stack((x[..., 0], y[..., 0]), -1), torch.full_like(radius, self.height)
        trees = torch.cat((place, torch.zeros_like(radius), radius, rest), -1)
        return {"cylinders": left_out(trees, torch.cat(crowded, 1))}


def _gentle(x: Tensor) -> Tensor:
    """h(x): the square of short vectors (n, 3), the length of long ones, (n, 1)."""
    return (x.square().sum(-1, keepdim=True) + 0.25).sqrt() - 0.5
