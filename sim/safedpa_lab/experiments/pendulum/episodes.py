"""One method on one set of episodes of the pendulum's questions; and both questions made harder step by step.

In the sweeps nothing is trained, tuned or calibrated again: each filter keeps the margin of the experiment's own
difficulty. Only RMA-P's penalty is chosen for each difficulty by itself, on the development seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.common.workers import Workers
from safedpa_lab.pendulum.difficulty import AXES, Axis, Difficulty, Episodes
from safedpa_lab.pendulum.margin import covered_share
from safedpa_lab.pendulum.methods import FILTERED, HAZARD_METHODS, PENALISED, Method, method_named
from safedpa_lab.pendulum.questions import balanced, balanced_account, crossed, crossed_account

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


BEST_PENALTY: Final = "rma_p"
"""RMA-P with the penalty that was chosen for the difficulty."""
_LEFT_OUT: Final = ("goal_seeker_unfiltered", "unfiltered", *(method.name for method in PENALISED))
_UNCHANGED: Final = tuple(method for method in HAZARD_METHODS if method.name not in _LEFT_OUT)
_RETAINED: Final = (
    "safe",
    "success",
    "both",
    "interval_safe",
    "interval_success",
    "interval_both",
    "covered",
    "relaxed",
)


@final
@dataclass(frozen=True)
class Sweeps:
    """What is to be run."""

    models: Path
    directions: int
    episodes: int
    seed: int
    margins: Mapping[str, float]
    """By name of method; 0 for one without a filter."""
    axes: tuple[Axis, ...] = AXES

    def cells(self, question: int) -> list[Difficulty]:
        """The difficulties of a question, each once."""
        return list(dict.fromkeys(at for axis in self._of(question) for at in map(axis.at, axis.values)))

    @property
    def size(self) -> int:
        """How many sets of episodes are to be run, without those on which RMA-P's penalty is chosen."""
        return len(self.cells(1)) * len(FILTERED) + len(self.cells(2)) * (len(_UNCHANGED) + 1)

    def _of(self, question: int) -> Iterator[Axis]:
        return (axis for axis in self.axes if question in axis.questions)


def swept(sweeps: Sweeps, workers: Workers, report_progress: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """By axis its values and, by question and method, what was counted at each value."""
    hard = sweeps.cells(2)
    choices = {}
    asked = (Choice(sweeps.models, sweeps.directions, sweeps.episodes, difficulty) for difficulty in hard)
    for difficulty, choice in zip(hard, workers.map(best_penalty, asked), strict=True):
        choices[difficulty] = choice
    work = [
        ((question, difficulty, name), Work(question, method, sweeps.margins.get(name, 0.0), episodes, sweeps.models))
        for question in QUESTIONS
        for difficulty in sweeps.cells(question)
        for name, method in _methods(question, choices.get(difficulty))
        for episodes in [Episodes(sweeps.seed, sweeps.directions, sweeps.episodes, difficulty)]
    ]
    found = {}
    for (key, _), account in zip(work, accounts((item for _, item in work), workers), strict=True):
        found[key] = account
        report_progress()
    return {axis.name: _along(axis, found, choices) for axis in sweeps.axes}


def _methods(question: int, choice: Mapping[str, Any] | None) -> list[tuple[str, Method]]:
    if question == 1:
        return [(method.name, method) for method in FILTERED]
    assert choice is not None
    rows = [(method.name, method) for method in _UNCHANGED]
    return [*rows, (BEST_PENALTY, method_named(2, choice["chosen"]))]


def _along(axis: Axis, found: Mapping[Any, Any], choices: Mapping[Difficulty, Any]) -> dict[str, Any]:
    reported: dict[str, Any] = {"label": axis.label, "values": list(axis.values), "shown": list(axis.ticks)}
    at = [axis.at(value) for value in axis.values]
    for question in axis.questions:
        rows: dict[str, Any] = {}
        for own, difficulty, name in found:
            if own == question and difficulty == at[0]:
                every = [found[question, one, name] for one in at]
                rows[name] = {"title": every[0]["title"], "episodes": every[0]["episodes"]}
                rows[name] |= {key: [row[key] for row in every] for key in _RETAINED if key in every[0]}
        if BEST_PENALTY in rows:
            rows[BEST_PENALTY] |= {"title": "RMA-P, best beta", "chosen": [choices[one]["chosen"] for one in at]}
        reported[QUESTIONS[question]] = rows
    return reported
