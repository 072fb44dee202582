"""Several processes that train one policy, as torchrun starts them; everything here also works for a single one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import torch
import torch.distributed as dist
from omegaconf import DictConfig
from torch import Tensor, nn

from torchrl_quad.errors import UserValueError


@contextlib.contextmanager
def joined(cfg: DictConfig) -> Iterator[None]:
    """Join the processes that torchrun has started, and leave them at the end.

    Raises:
        ValueError: the configuration names one GPU for all of them.
    """
    if "RANK" in os.environ:
        if ":" in cfg.device:
            raise UserValueError(
                f"device={cfg.device}: under torchrun each process takes its own GPU. Write device=cuda."
            )
        gpu = cfg.device == "cuda"
        if gpu:
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group("nccl" if gpu else "gloo")
    yield
    if dist.is_initialized():  # after an error the others may wait for this one: torchrun ends them
        dist.destroy_process_group()


def rank() -> int:
    """Which of the processes this is; 0 logs, evaluates and saves."""
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    """How many processes train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def from_the_first(value: Any) -> Any:
    """The value of the first process, in all of them."""
    values = [value]
    if world_size() > 1:
        dist.broadcast_object_list(values)
    return values[0]


def gather(value: Any) -> list[Any]:
    """The values of all processes, in the first; the others get an empty list."""
    if world_size() == 1:
        return [value]
    values = [None] * world_size() if rank() == 0 else None
    dist.gather_object(value, values)
    return values or []


def wait_for_all() -> None:
    """Go on when every process has come this far."""
    if world_size() > 1:
        dist.barrier()


def cat_all(x: Tensor) -> Tensor:
    """The tensors of all processes, of one shape, concatenated along the first axis."""
    if world_size() == 1:
        return x
    parts = [torch.empty_like(x) for _ in range(world_size())]
    dist.all_gather(parts, x.contiguous())
    return torch.cat(parts)


def mean_of_all(x: Tensor) -> Tensor:
    """The mean of a scalar over the processes."""
    return cat_all(x.detach().view(1)).mean()


def backward(loss: Tensor, optimizer: torch.optim.Optimizer, max_grad_norm: float) -> tuple[Tensor, Tensor]:
    """Compute the gradient of a loss, average it over the processes, and clip that of each group of parameters.

    Returns:
        the loss and the norm of the gradient of the first group before clipping, both averaged over the processes.
    """
    optimizer.zero_grad()
    loss.backward()
    groups = [[p for p in group["params"] if p.grad is not None] for group in optimizer.param_groups]
    loss = loss.detach()
    if world_size() > 1:
        tensors = [loss, *(p.grad for group in groups for p in group)]
        flat = nn.utils.parameters_to_vector(tensors)
        dist.all_reduce(flat)
        nn.utils.vector_to_parameters(flat / world_size(), tensors)
    norms = [nn.utils.clip_grad_norm_(group, max_grad_norm, foreach=True) for group in groups]
    return loss, norms[0]
