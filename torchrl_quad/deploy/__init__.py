"""From a trained policy to a drone: export it as a folder, fly the folder without torch, and translate conventions.

Flying needs numpy, onnxruntime and jsonschema, :mod:`~torchrl_quad.deploy.frames` numpy; nothing here imports torch
until :func:`~torchrl_quad.deploy.export_policy` is asked for.
"""

from typing import TYPE_CHECKING, Any

from torchrl_quad.deploy import frames
from torchrl_quad.deploy.bundle import Bundle, load_bundle
from torchrl_quad.deploy.contract import (
    BrokenPolicy,
    Fault,
    MissingQuantity,
    NegativeDepth,
    NotFinite,
    NotUnitQuaternion,
    StaleState,
    TamperedBundle,
    UnknownContract,
    WrongActions,
)

if TYPE_CHECKING:
    from torchrl_quad.deploy.export import export_policy

__all__ = [
    "BrokenPolicy",
    "Bundle",
    "Fault",
    "MissingQuantity",
    "NegativeDepth",
    "NotFinite",
    "NotUnitQuaternion",
    "StaleState",
    "TamperedBundle",
    "UnknownContract",
    "WrongActions",
    "export_policy",
    "frames",
    "load_bundle",
]


def __getattr__(name: str) -> Any:
    """Import what exports, which needs torch, when it is first asked for."""
    if name == "export_policy":
        from torchrl_quad.deploy.export import export_policy

        return export_policy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
