"""Draw flights as pictures, films and replays, and training as learning curves (extra: ``render``)."""

from torchrl_quad.render.figures import plot_episode, plot_flight, plot_learning_curve
from torchrl_quad.render.replay import Replay, write_replay
from torchrl_quad.render.video import animate_flight

__all__ = ["Replay", "animate_flight", "plot_episode", "plot_flight", "plot_learning_curve", "write_replay"]
