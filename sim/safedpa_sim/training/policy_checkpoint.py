"""An interrupted training of a policy goes on from the last evaluation, with new drives."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, final

import torch
from stable_baselines3 import PPO

from safedpa.errors import InputError
from safedpa.records.atomic import atomic_path

__all__ = ["PolicyCheckpoint"]


@final
@dataclass(frozen=True)
class PolicyCheckpoint:
    """Where a training stands: its file and the digest of what it is made from."""

    path: Path
    digest: str

    def write(self, algorithm: PPO, curve: list[dict[str, Any]]) -> None:
        """Networks, optimiser, steps so far and the learning curve; whole or not at all."""
        content = {
            "digest": self.digest,
            "steps": algorithm.num_timesteps,
            "policy": algorithm.policy.state_dict(),
            "optimiser": algorithm.policy.optimizer.state_dict(),
            "curve": json.dumps(curve),
        }
        with atomic_path(self.path) as unfinished:
            torch.save(content, unfinished)

    def read(self) -> dict[str, Any] | None:
        """What was written; None when there is nothing, or something of another configuration.

        Raises InputError when the file is damaged.
        """
        if not self.path.exists():
            return None
        try:
            content: dict[str, Any] = torch.load(self.path, map_location="cpu", weights_only=True)
            if content["digest"] != self.digest:
                return None
            return {**content, "curve": json.loads(content["curve"])}
        except (OSError, RuntimeError, EOFError, KeyError, ValueError, TypeError, UnpicklingError) as error:
            raise InputError(
                f"{self.path}: no usable checkpoint ({error}); remove it to train from the beginning"
            ) from error
