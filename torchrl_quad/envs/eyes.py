"""The camera in a task: when it takes images, when the policy sees them, and what of them is kept in the state."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_quad.dynamics.vector import is_traced
from torchrl_quad.engine import looks_are_free
from torchrl_quad.engine.simulation import State
from torchrl_quad.envs.disturbances import Disturbance
from torchrl_quad.envs.randomness import Randomness
from torchrl_quad.envs.scenes import Scene
from torchrl_quad.errors import UserValueError
from torchrl_quad.vision import DepthCamera


class Eye(Disturbance):
    """A camera in the scenes of a task: its images, and what it keeps of them.

    Entry of the state where images are noisy, or older than the state: ``images`` (k, height, width) [m], oldest first.
    """

    def __init__(self, camera: DepthCamera, scene: Scene) -> None:
        self.camera, self.scene = camera, scene
        self.is_compiled = False  # whether the environment is, so that its starts see what its steps see, bit for bit
        self.kept = math.ceil(camera.delay / camera.rate) + 1
        self.remembers = camera.is_noisy or camera.rate > 1 or camera.delay > 0
        reach = math.sqrt(sum(x * x for x in camera.position))
        if reach > scene.radius:
            raise UserValueError(
                f"camera: its position is {reach:.3g} m from the drone's centre, outside of the sphere of "
                f"{scene.radius:.3g} m that must not touch anything, so the camera could be inside an obstacle. Move "
                f"it, or give the scene a drone_radius of {math.ceil(100 * reach) / 100:g} m."
            )

    @property
    def noise_size(self) -> int:
        """A number for each pixel of a noisy camera."""
        return self.camera.pixels if self.camera.is_noisy else 0

    def start(self, random: Randomness, state: State) -> State:
        """As if the first image had been there for long."""
        if not self.remembers:
            return {}
        noise = random.normal(len(state["position"]), self.noise_size) if self.noise_size else None
        return {"images": self._look(state, noise).expand(-1, self.kept, -1, -1).clone()}

    def advance(self, state: State, noise: Tensor | None, dt: float) -> State:
        """Take another image where it is time, and forget the oldest."""
        if not self.remembers:
            return {}
        due = state["step"] % self.camera.rate == 0
        if looks_are_free(due.device) and not is_traced() and not due.any():
            return {}
        images = torch.cat((state["images"][:, 1:], self._look(state, noise)), 1)
        return {"images": torch.where(due[:, :, None, None], images, state["images"])}

    def image(self, state: State) -> Tensor:
        """What the policy sees, (n, 1, height, width) [m]."""
        if not self.remembers:
            return self._look(state, None)
        images, step, rate = state["images"], state["step"], self.camera.rate
        if self.kept == 1:
            return images
        seen = torch.div(step - self.camera.delay, rate, rounding_mode="floor").clamp_min(0)
        newer = torch.div(step, rate, rounding_mode="floor") - seen  # images that are on their way
        index = (self.kept - 1 - newer)[:, :, None, None].expand(-1, 1, *images.shape[2:])
        return images.gather(1, index)

    def _look(self, state: State, noise: Tensor | None) -> Tensor:
        solids, fused = self.scene.solids(state), self.is_compiled
        depth = self.camera.depth(solids, state["position"], state["quaternion"], fused=fused)
        return depth if noise is None else self.camera.measure(depth, noise)
