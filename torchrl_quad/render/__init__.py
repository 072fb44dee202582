"""Pictures and films of flights, and of learning, with matplotlib (extra: ``render``)."""

from torchrl_quad.render.figures import animate_flight, plot_flight, plot_learning_curve

__all__ = ["animate_flight", "plot_flight", "plot_learning_curve"]
