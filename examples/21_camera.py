"""Film what a depth camera on a hovering drone measures: pillars, a wall and the ground, while it turns on the spot."""

import torch

from torchrl_quad import ActionSequence, DepthCamera, HoveringEnv, differentiable_rollout
from torchrl_quad.render import animate_flight

SCENE = {
    "ground": True,
    "walls": [{"point": [7.0, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}],
    "spheres": [{"centre": [4.0, -1.5, 1.8], "radius": 0.5}],
    "cylinders": [
        {"base": [4.0, 1.5, 0.0], "radius": 0.3, "height": 3.0},
        {"count": 6, "low": [-4, -4, 0], "high": [6, 4, 0], "radius": [0.1, 0.3], "height": [2, 4]},
    ],
}
CAMERA = DepthCamera(width=48, height=36, field_of_view=1.5, pitch=-0.1, range=12.0, rate=2, noise=0.01)
SHADES = "@%#*+=-. "  # from near to far


def draw(image, far):
    """An image (height, width) [m] as text, each second row of it."""
    shade = (image / far * (len(SHADES) - 1)).round().long().tolist()
    return "\n".join("".join(SHADES[k] for k in row) for row in shade[::2])


def look_around(steps=150, film=None):
    """Turn one drone on the spot; return the flight. With a path, film it with what the camera sees."""
    env = HoveringEnv(num_envs=1, scene=SCENE, camera=CAMERA, control="velocity", action_delay=0)
    actions = torch.zeros(steps, 1, 4)  # velocity along x, y, z, and yaw rate
    actions[..., 3] = 0.8
    flight, _ = differentiable_rollout(env, ActionSequence(actions), env.reset(), steps)
    if film:
        animate_flight(flight, film, env=env)
    return flight


if __name__ == "__main__":
    flight = look_around(film="camera.gif")
    for step in (0, 75, 149):
        print(f"after {0.02 * step:.1f} s")
        print(draw(flight["depth"][0, step, 0], CAMERA.range), "\n")
