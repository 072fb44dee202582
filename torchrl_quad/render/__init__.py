"""Pictures of flights and of learning, with matplotlib (extra: ``render``)."""

from torchrl_quad.render.figures import plot_flight, plot_learning_curve

__all__ = ["plot_flight", "plot_learning_curve"]
