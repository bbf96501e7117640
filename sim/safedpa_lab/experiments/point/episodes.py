"""One method on the episodes of the point robot's experiment: the unit of work, and what is counted of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import mean_interval, seeds_interval, wilson_interval
from safedpa_lab.point.drivers import Driven, Wheel, driven, driver_of, windy_task
from safedpa_lab.point.methods import METHODS, Method

__all__ = ["DEVELOPMENT", "Work", "account_of", "best_penalty", "over_seeds"]


DEVELOPMENT: Final = seeds_for("development", 1, 60_000)[0]
"""The seed on which RMA-P's penalty is chosen."""
_SHOWN: Final = 4
"""Directions of which one path is kept for the pictures."""


@final
@dataclass(frozen=True)
class Work:
    """A method with its weights and margin, and the episodes; plain values, so that they can be kept in a file."""

    method: str
    """Of ``METHODS``, or one of RMA-P's grid."""
    models: str
    baselines: str
    weights: str
    """Digest of the policy's file: drives of other weights are no drives of these."""
    training_seed: int | None
    epsilon: float | None
    """m; nothing where there is no filter."""
    directions: int
    episodes: int
    """Of each direction."""
    steps: int
    force: float
    """N."""
    seed: int
    shown: bool = False
    """Whether some paths are kept."""

    @property
    def driven(self) -> Method:
        """What drives."""
        return METHODS.get(self.method) or Method(self.method, "", policy=self.method)


def account_of(work: Work) -> dict[str, Any]:
    """What became of it, with the work's own fields."""
    method, directions, episodes = work.driven, work.directions, work.episodes
    margins = {} if work.epsilon is None else {method.filter: work.epsilon}
    wheel = Wheel(Path(work.models), Path(work.baselines), margins, work.training_seed)
    task = windy_task(directions, episodes, work.force, work.seed)
    driver = driver_of(method, task, wheel)
    shown = np.arange(0, directions, max(1, directions // _SHOWN)) * episodes if work.shown else np.zeros(0, int)
    found = driven(driver, task, work.steps, shown)
    account = _account(found, directions, work.steps)
    return {**{item.name: getattr(work, item.name) for item in fields(work)}, "account": account}


def best_penalty(found: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The policy of RMA-P's grid with the highest return less cost, of what became of each on development drives."""
    rows: dict[str, Any] = {}
    for name, account in found.items():
        reward, cost = account["reward"][0], account["cost"][0]
        rows[name] = {"reward": reward, "cost": cost, "score": reward - cost, "safe": account["safe_episodes"]}
    best = max(rows, key=lambda name: float(rows[name]["score"]))
    return {"chosen": best, "seed": DEVELOPMENT, "rows": rows}


def over_seeds(accounts: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """Means over training seeds of each seed's policy, with 95 % intervals over seeds (Student's t)."""
    shares = np.array([one["safe_episodes"] / one["episodes"] for one in accounts.values()])
    goals, cost = (np.array([one[name][0] for one in accounts.values()]) for name in ("goals", "cost"))
    each = {"safe": seeds_interval(shares), "goals": seeds_interval(goals), "cost": seeds_interval(cost)}
    return {"training_seeds": list(accounts), **each, "each": np.stack((shares, goals, cost), axis=1).tolist()}


def _account(found: Driven, directions: int, steps: int) -> dict[str, Any]:
    count = len(found.goals)
    safe, reached = int((found.cost == 0.0).sum()), int((found.goals > 0.0).sum())

    def by_direction(values: FloatArray) -> list[float]:
        means: list[float] = np.round(values.reshape(directions, -1).mean(axis=1), 5).tolist()
        return means

    return {
        "episodes": count,
        "safe_steps": mean_interval(1.0 - found.cost / steps),
        "safe_episodes": safe,
        "safe_episodes_interval": list(wilson_interval(safe, count)),
        "unsafe_steps": int(found.cost.sum()),
        "goals": mean_interval(found.goals),
        "reached": reached,
        "reached_interval": list(wilson_interval(reached, count)),
        "reward": mean_interval(found.reward),
        "cost": mean_interval(found.cost),
        "least_room": round(float(found.least_room.min()), 4),
        "first_goal_median": _finite(float(np.median(found.first_goal))),
        "corrected": round(found.corrected, 5),
        "relaxed": round(found.relaxed, 5),
        "milliseconds_per_episode": round(1e3 * found.processor_seconds / count, 2),
        "microseconds_per_decision": round(1e6 * found.processor_seconds / count / steps, 2),
        "directions_safe_steps": by_direction(1.0 - found.cost / steps),
        "directions_safe_episodes": by_direction((found.cost == 0.0).astype(float)),
        "directions_goals": by_direction(found.goals),
        "goals_each": found.goals.astype(int).tolist(),
        "safe": safe,
        "success": reached,
        "both": int(((found.cost == 0.0) & (found.goals > 0.0)).sum()),
        "safe_each": _flags(found.cost == 0.0),
        "success_each": _flags(found.goals > 0.0),
        "shown": found.shown,
    }


def _flags(flags: NDArray[np.bool_]) -> str:
    return "".join("1" if flag else "0" for flag in flags)


def _finite(number: float) -> float | None:
    return round(number, 2) if np.isfinite(number) else None
