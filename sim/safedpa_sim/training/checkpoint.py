"""Interrupted training goes on where it was, to the same result bit for bit."""

from __future__ import annotations

from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import nn

from safedpa.errors import InputError
from safedpa.records.atomic import atomic_path

__all__ = ["read_checkpoint", "write_checkpoint"]


def write_checkpoint(
    path: Path,
    digest: str,
    done: int,
    module: nn.Module,
    optimiser: torch.optim.Optimizer,
    generator: torch.Generator,
    told: dict[str, list[Any]],
) -> None:
    """Everything that decides how training goes on after ``done`` steps, and what it has ``told`` so far.

    ``digest`` says of which configuration it is.
    """
    content = {
        "digest": digest,
        "done": done,
        "module": module.state_dict(),
        "optimiser": optimiser.state_dict(),
        "generator": generator.get_state(),
        "told": told,
    }
    with atomic_path(path) as unfinished:
        torch.save(content, unfinished)


def read_checkpoint(
    path: Path,
    digest: str,
    module: nn.Module,
    optimiser: torch.optim.Optimizer,
    generator: torch.Generator,
) -> tuple[int, dict[str, list[Any]]]:
    """Restores the three and returns the steps done and what was told.

    That is (0, {}) when there is no checkpoint, or one of another configuration.

    Raises InputError when the file is damaged.
    """
    if not path.exists():
        return 0, {}
    try:
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        if content["digest"] != digest:
            return 0, {}
        module.load_state_dict(content["module"])
        optimiser.load_state_dict(content["optimiser"])
        generator.set_state(content["generator"])
        return int(content["done"]), dict(content["told"])
    except (OSError, RuntimeError, EOFError, KeyError, ValueError, TypeError, UnpicklingError) as error:
        raise InputError(f"{path}: no usable checkpoint ({error}); remove it to train from the beginning") from error
