"""Pictures, films and replays of flights, and pictures of learning (extra: ``render``)."""

from torchrl_quad.render.figures import animate_flight, plot_episode, plot_flight, plot_learning_curve
from torchrl_quad.render.replay import write_replay

__all__ = ["animate_flight", "plot_episode", "plot_flight", "plot_learning_curve", "write_replay"]
