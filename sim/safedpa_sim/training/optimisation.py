"""What the phases share in an optimisation by torch: the device, the learning rate, one step, and checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, TypeVar, final

import torch

from safedpa.errors import InputError
from safedpa.records.writers.tables import atomic_path

Used = TypeVar("Used")


def training_device(name: str) -> torch.device:
    """Returns the torch device of that name; raises InputError when this machine has no such device."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"--device {name}: no such kind of device; wanted cpu or cuda") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            f"--device {name}: torch finds no CUDA device here; leave --device out to train on the processor"
        )
    return device


def cosine_rate(first: float, last: float, done: float, steps: float = 1.0) -> float:
    """Returns the learning rate of a cosine schedule from ``first`` to ``last`` after ``done`` of ``steps``."""
    return last + (first - last) * (0.5 * (1.0 + math.cos(math.pi * done / steps)))


def descend(optimiser: torch.optim.Optimizer, loss: torch.Tensor, rate: float | None = None) -> torch.Tensor:
    """Runs one step of the optimiser, with another learning ``rate`` if one is given, and returns the detached loss."""
    if rate is not None:
        for group in optimiser.param_groups:
            group["lr"] = rate
    optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    optimiser.step()
    return loss.detach()


@final
@dataclass(frozen=True)
class Checkpoint:
    """The file from which an interrupted training resumes; ``digest`` identifies its settings and input weights."""

    path: Path
    digest: str

    def write(self, **content: Any) -> None:
        """Writes tensors, numbers and text by name, atomically."""
        with atomic_path(self.path) as unfinished:
            torch.save({"digest": self.digest, **content}, unfinished)

    def read(self, use: Callable[[dict[str, Any]], Used]) -> Used | None:
        """Returns what ``use`` makes of the content; None if there is no checkpoint, or one of another configuration.

        Raises InputError when the file is damaged.
        """
        if not self.path.exists():
            return None
        try:
            content: dict[str, Any] = torch.load(self.path, map_location="cpu", weights_only=True)
            return use(content) if content["digest"] == self.digest else None
        except (OSError, RuntimeError, EOFError, KeyError, ValueError, TypeError, UnpicklingError) as error:
            raise InputError(
                f"{self.path}: no usable checkpoint ({error}); remove it to train from the beginning"
            ) from error
