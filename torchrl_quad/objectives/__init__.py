"""First-order policy losses as TorchRL LossModules; they work on any differentiable environment."""

from torchrl_quad.objectives.abpt import ABPTLoss
from torchrl_quad.objectives.ahac import AHACLoss
from torchrl_quad.objectives.bptt import BPTTLoss
from torchrl_quad.objectives.critic import PathwiseCriticLoss
from torchrl_quad.objectives.hybrid import HybridLoss
from torchrl_quad.objectives.pathwise import PathwiseLoss
from torchrl_quad.objectives.pods import PODSLoss
from torchrl_quad.objectives.sapo import SAPOLoss
from torchrl_quad.objectives.shac import SHACLoss
from torchrl_quad.objectives.trust_region import TrustRegion

__all__ = [
    "ABPTLoss",
    "AHACLoss",
    "BPTTLoss",
    "HybridLoss",
    "PODSLoss",
    "PathwiseCriticLoss",
    "PathwiseLoss",
    "SAPOLoss",
    "SHACLoss",
    "TrustRegion",
]
