"""Everything random in an environment: one seed gives one flight, step by step or horizon by horizon."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchrl_quad.engine import flat, looks_are_free, nested

STEPS_PER_DRAW = 32


class Randomness:
    """The random numbers of an environment: its generator, noise for the next steps, and starts for the next episodes.

    Noise is drawn for 32 steps at once. Starts are drawn for all environments at once, when the first of them needs
    one. The others keep theirs until their episode ends, for the rest of the 32 steps; one that ends again takes the
    next draw. Single steps and whole horizons draw alike.

    On an accelerator, reading who needs a start would need a synchronisation. There the 32 steps have one draw of
    starts, made with their noise, and an episode that ends again takes the start of the environment after its own.
    """

    def __init__(self, device: torch.device, dtype: torch.dtype) -> None:
        self.device, self.dtype = device, dtype
        self.generator = torch.Generator(device)
        self.noise_shapes: dict[str, tuple[int, int]] = {}  # (n, k) by disturbance
        self.draw_start: Callable[[], dict[str, Any]] = dict  # entries of a reset of all environments, nested
        self.forget()

    def seed(self, seed: int | None) -> None:
        """Restart from a seed; None takes one from the operating system."""
        if seed is None:
            self.generator.seed()
        else:
            self.generator.manual_seed(seed)
        self.forget()

    def forget(self) -> None:
        """Throw away what was drawn in advance."""
        self._position, self._noise = STEPS_PER_DRAW, {}
        self.forget_starts()

    def forget_starts(self) -> None:
        """Throw away the starts that were drawn in advance, as when they come from elsewhere."""
        self._starts: list[dict[Any, Tensor]] = []
        self._used: Tensor | None = None  # how many of these starts each environment has used

    def uniform(self, *shape: int) -> Tensor:
        """Uniform numbers in [-1, 1]."""
        return torch.rand(shape, generator=self.generator, device=self.device, dtype=self.dtype) * 2.0 - 1.0

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers."""
        return torch.randn(shape, generator=self.generator, device=self.device, dtype=self.dtype)

    def integers(self, high: int, *shape: int) -> Tensor:
        """Uniform integers in [0, high)."""
        return torch.randint(high, shape, generator=self.generator, device=self.device)

    def tensor(self, values: Any) -> Tensor:
        """A tensor with the environment's device and floating-point type; nothing random."""
        return torch.tensor(values, device=self.device, dtype=self.dtype)

    def noise(self) -> dict[str, Tensor]:
        """Standard normal noise (n, k) of the next step, by disturbance."""
        if self._position == STEPS_PER_DRAW:
            self._position = 0
            self._noise = {name: self.normal(STEPS_PER_DRAW, *shape) for name, shape in self.noise_shapes.items()}
            self.forget_starts()
            if not looks_are_free(self.device):
                self._starts.append(flat(self.draw_start()))
        self._position += 1
        return {name: x[self._position - 1] for name, x in self._noise.items()}

    def starts(self, mask: Tensor | None) -> dict[str, Any]:
        """What a reset writes for the environments in the mask, bool (n), or for all; other rows mean nothing."""
        is_free = looks_are_free(self.device)
        if mask is None or (is_free and mask.all()):
            self.forget_starts()
            return self.draw_start()
        used = torch.zeros_like(mask, dtype=torch.int64) if self._used is None else self._used
        self._starts = self._starts or [flat(self.draw_start())]
        if not is_free:
            self._used = used + mask
            row = (torch.arange(len(mask), device=self.device) + used) % len(mask)
            return nested({key: x[row] for key, x in self._starts[0].items()})
        if not mask.any():
            return nested(self._starts[0])
        while len(self._starts) <= used[mask].max():
            self._starts.append(flat(self.draw_start()))
        self._used = used + mask
        if (used[mask] == used[mask][0]).all():
            return nested(self._starts[used[mask][0]])
        row = torch.arange(len(mask)), used.clamp_max(len(self._starts) - 1)
        return nested({key: torch.stack([x[key] for x in self._starts], 1)[row] for key in self._starts[0]})

    def state(self) -> dict[str, Any]:
        """Everything needed to resume: tensors and plain values."""
        drawn = {"position": self._position, "noise": self._noise, "starts": self._starts, "used": self._used}
        return {"generator": self.generator.get_state(), **copy.deepcopy(drawn)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Resume from what :meth:`state` returned."""
        self.generator.set_state(x if (x := state["generator"]).is_cpu else x.cpu())  # torch.func wraps any copy
        state = copy.deepcopy(state)
        self._position, self._used = state["position"], state["used"]
        self._used = None if self._used is None else self._used.to(self.device)
        self._noise = {name: x.to(self.device) for name, x in state["noise"].items()}
        self._starts = [{key: x.to(self.device) for key, x in start.items()} for start in state["starts"]]
