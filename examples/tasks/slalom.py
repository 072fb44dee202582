"""Fly around five posts, left and right in turn, and hover behind them."""

import torch

from torchrl_quad import HoveringEnv
from torchrl_quad.envs.terms import penalties

GAP, WAVE, ASIDE = 1.5, torch.pi / 1.5, 0.6  # [m] from post to post; [rad/m] and [m] of a wave that leads around them
POSTS = [{"base": (GAP * i, 0, 0), "radius": 0.1, "height": 3} for i in range(5)]


class Slalom(HoveringEnv):
    """Solved as hovering is, within 0.2 m; a post that is touched, or passed on the wrong side, is a crash."""

    defaults = {"scene": {"cylinders": POSTS}, "max_episode_steps": 400}
    target, success_radius, box_half_width, box_height = (4.5 * GAP, 0.0, 1.5), 0.2, 9.0, 3.0
    weights = {"survival": 0.1, "slip": 0.03, "spin": 0.002}

    def initial_state(self, n):
        start = self.hover_state(self.tensor([-1.5, 0.0, 1.5]) + 0.5 * self.uniform(n, 3))
        return {**super().initial_state(n), **start, "post": self.integers(1, n, 1)}

    def advance(self, previous, state):
        (x, y, _), post = state["position"].split(1, -1), state["post"]
        return {**state, "post": post + ((x > GAP * post) & (y * (1 - 2 * (post % 2)) > 0.0))}

    def slip(self, state):  # from the velocity along the wave, and back to it
        x, y, z = state["position"].split(1, -1)
        back = torch.cat((0.0 * x, ASIDE * (WAVE * x).cos() - y, 1.5 - z), -1)
        along = torch.cat((torch.ones_like(x), -ASIDE * WAVE * (WAVE * x).sin(), 0.0 * x), -1)
        return state["velocity"] - (2.0 * (4.5 * GAP - x)).clamp(-1.5, 1.5) * along - 2.0 * back

    def observe(self, state):
        return torch.cat((self.slip(state), super().observe(state)), -1)

    def reward_terms(self, state):
        return penalties(self.weights, slip=self.slip(state), spin=state["angular_velocity"])

    def is_crash(self, state):  # a post behind a drone, and still its next one: passed on the wrong side
        return super().is_crash(state) | (state["position"][..., :1] > GAP * state["post"])
