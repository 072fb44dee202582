"""Draw flights as pictures, films and replays, and training as learning curves (extra: ``render``)."""

from torchrl_quad.render.figures import plot_episode, plot_flight
from torchrl_quad.render.frames import animate_flight
from torchrl_quad.render.learning import plot_learning_curve
from torchrl_quad.render.obstacles import plot_from_above
from torchrl_quad.render.replay import write_replay

__all__ = ["animate_flight", "plot_episode", "plot_flight", "plot_from_above", "plot_learning_curve", "write_replay"]
