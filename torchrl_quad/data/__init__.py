"""Experience: differentiable horizons, the states they visited, and normalised observations.

Everything here, the losses and the networks work on any TorchRL environment. They read three attributes of the
environment under all transforms; the first is TorchRL's, the other two are optional.

==================  ==================================================================================================
attribute           meaning
==================  ==================================================================================================
``state_keys``      TorchRL's own: the entries of the ``state_spec``, which make up the Markov state. Visited states
                    and restarts keep them whole, by their first names: ``("state",)`` for the tasks of this package,
                    ``("th", "thdot", "params")`` for TorchRL's PendulumEnv.
``sample_start``    ``env.sample_start(n)`` draws n fresh starts, a tensordict of batch size (n) with these entries,
                    from the task's own starts. Without it fresh starts come from ``env.reset()``.
``neutral_action``  the action (k), or (num_envs, k), that a new policy begins with. Without it a new policy begins
                    with the middle of the action's range.
==================  ==================================================================================================
"""

from torchrl_quad.data.normalizer import ObservationNormalizer
from torchrl_quad.data.rollout import DifferentiableCollector, differentiable_rollout
from torchrl_quad.data.transforms import FlightMode, flight_mode
from torchrl_quad.data.unwrap import base_env
from torchrl_quad.data.visited_states import VisitedStateBuffer, restart

__all__ = [
    "DifferentiableCollector",
    "FlightMode",
    "ObservationNormalizer",
    "VisitedStateBuffer",
    "base_env",
    "differentiable_rollout",
    "flight_mode",
    "restart",
]
