"""One method on one set of episodes of the pendulum's questions: the unit of work of the experiment."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.common.workers import Workers
from safedpa_lab.pendulum.balancing import balanced, balanced_account
from safedpa_lab.pendulum.crossing import crossed, crossed_account
from safedpa_lab.pendulum.difficulty import Difficulty, Episodes
from safedpa_lab.pendulum.margin import covered_share
from safedpa_lab.pendulum.methods import PENALISED, Method

__all__ = ["DEVELOPMENT", "QUESTIONS", "Choice", "Work", "accounts", "best_penalty"]

QUESTIONS: Final = {1: "balancing", 2: "hazard"}
"""By their numbers in the paper, as they are called in the results."""
DEVELOPMENT: Final = seeds_for("development", 1)[0]
"""The seed on which RMA-P's penalty is chosen."""
_SHOWN = 12
"""Swings of each method that are kept for the phase portraits."""


@final
@dataclass(frozen=True)
class Work:
    """A task, the method and margin, and the episodes."""

    question: int
    method: Method
    epsilon: float
    episodes: Episodes
    models: Path
    shown: bool = False
    """Whether some swings are kept."""

    @property
    def edges(self) -> tuple[float, float]:
        """Of the corridor that is to be kept."""
        difficulty = self.episodes.difficulty
        return difficulty.balancing if self.question == 1 else difficulty.long_way_round


def accounts(work: Iterable[Work], workers: Workers) -> Iterator[dict[str, Any]]:
    """What became of each, in order."""
    return workers.map(_account, work)


def _account(work: Work) -> dict[str, Any]:
    method, episodes = work.method, work.episodes
    if work.question == 1:
        swings = balanced(method, work.models, work.epsilon, episodes)
        account = balanced_account(swings, episodes)
    else:
        swings = crossed(method, work.models, work.epsilon, episodes)
        account = crossed_account(swings, episodes)
        if work.shown:
            shown = np.linspace(0, episodes.count - 1, _SHOWN).astype(int)
            account["shown"] = np.round(swings.states[::4, shown], 3).transpose(1, 0, 2).tolist()
    for outcome in ("safe", "success", "both"):
        if outcome in account:
            account[f"interval_{outcome}"] = list(wilson_interval(account[outcome], account["episodes"]))
    account |= {"title": method.title, "epsilon": None, "covered": None}
    if method.filter:
        reported = method, work.models, swings, episodes.winds(), work.edges, work.epsilon
        account |= {"epsilon": work.epsilon, "covered": covered_share(*reported)}
    return account


@final
@dataclass(frozen=True)
class Choice:
    """RMA-P's penalty for one difficulty, chosen on the development seed."""

    models: Path
    directions: int
    episodes: int
    difficulty: Difficulty


def best_penalty(choice: Choice) -> dict[str, Any]:
    """The penalty with the most episodes upright and safe; among equals the one that keeps the most room."""
    episodes = Episodes(DEVELOPMENT, choice.directions, choice.episodes, choice.difficulty)
    rows: dict[str, Any] = {}
    for method in PENALISED:
        account = crossed_account(crossed(method, choice.models, 0.0, episodes), episodes)
        rows[method.name] = {"both": account["both"], "least_room": min(account["least_room"])}
    best = max(rows, key=lambda name: (rows[name]["both"], rows[name]["least_room"]))
    return {"chosen": best, "episodes": episodes.count, "seed": DEVELOPMENT, "rows": rows}
