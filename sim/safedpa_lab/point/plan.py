"""What a baseline of the point robot is trained on, how its file is called, and which of its policies is kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

from safedpa.errors import InputError, did_you_mean

BASELINES: Final = ("ppo", "trpo", "ppo_lagrangian", "trpo_lagrangian", "cpo")
LIMITED: Final = ("ppo_lagrangian", "trpo_lagrangian", "cpo")
"""Those that heed a limit of the cost."""
INPUTS: Final = ("lidar", "latent", "equal")
"""The benchmark's sensors, goal and lidar; these and SafeDPA's latent; what SafeDPA's own policy is given."""
MULTIPLIERS: Final = ("waiting", "pid", "integral")
COST_LIMIT: Final = 25.0
"""Steps within hazards in an episode of 1000; the benchmark's limit."""


@final
@dataclass(frozen=True)
class Plan:
    """How long, with how many robots at once, in which winds [N], with which thrust, from which seed, and for what.

    Raises InputError for inputs or a multiplier that there are none of.
    """

    steps: int = 4_000_000
    robots: int = 128
    largest_force: float = 0.0
    stock: bool = False
    seed: int = 0
    inputs: str = "lidar"
    """Of ``INPUTS``. Other than the lidar: the reward is gained along the shortest way, as SafeDPA's policy's."""
    limit: float = COST_LIMIT
    """Of the cost of an episode, for those that heed one."""
    cap: float | None = None
    """Of the Lagrange multiplier; nothing: none."""
    multiplier: str = "waiting"
    """Of ``MULTIPLIERS``: how it follows the cost."""
    filtered: float = 0.0
    """Share of the steps, at the end, that are driven behind the filter with the simulated physics itself."""

    def __post_init__(self) -> None:
        for field, known in (("inputs", INPUTS), ("multiplier", MULTIPLIERS)):
            if getattr(self, field) not in known:
                raise InputError(f"{field} '{getattr(self, field)}': {did_you_mean(getattr(self, field), known)}")

    def key(self, name: str, task: str) -> str:
        """NAME_TASK, the inputs other than the lidar, a limit other than the benchmark's, and ``filtered``."""
        parts = [name, task]
        parts += [self.inputs] if self.inputs != "lidar" else []
        parts += [f"{self.limit:g}".replace(".", "_")] if name in LIMITED and self.limit != COST_LIMIT else []
        parts += ["filtered"] if self.filtered else []
        return "_".join(parts)


def score(name: str, figures: Mapping[str, Any], limit: float) -> float:
    """What the kept policy of a training is chosen by: return, less the cost above the limit where there is one.

    score = reward - max(cost - limit, 0); of PPO and TRPO, which heed no cost, the reward.
    """
    over = max(0.0, float(figures["cost"]) - limit) if name in LIMITED else 0.0
    return float(figures["reward"]) - over
