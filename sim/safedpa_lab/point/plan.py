"""What a baseline of the point robot is trained on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

__all__ = ["BASELINES", "Plan"]

BASELINES: Final = ("ppo", "trpo", "ppo_lagrangian", "trpo_lagrangian", "cpo")


@final
@dataclass(frozen=True)
class Plan:
    """How long, with how many robots at once, in which winds [N], with which thrust, from which seed."""

    steps: int = 4_000_000
    robots: int = 128
    largest_force: float = 0.0
    stock: bool = False
    seed: int = 0
