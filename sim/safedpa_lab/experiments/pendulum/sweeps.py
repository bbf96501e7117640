"""Both questions of the pendulum made harder step by step: where does each method break?

Nothing is trained, tuned or calibrated again: each filter keeps the margin of the experiment's own difficulty. Only
RMA-P's penalty is chosen for each difficulty by itself, on the development seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from safedpa_lab.experiments.common.workers import Workers
from safedpa_lab.experiments.pendulum.episodes import QUESTIONS, Choice, Work, accounts, best_penalty
from safedpa_lab.pendulum.difficulty import AXES, Axis, Difficulty, Episodes
from safedpa_lab.pendulum.methods import FILTERED, HAZARD_METHODS, PENALISED, Method, method_named

__all__ = ["BEST_PENALTY", "Sweeps", "swept"]

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
