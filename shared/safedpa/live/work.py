"""The slow part of a live diagnosis, as a task that any process can carry out: the search, and preparing a model."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, final

from safedpa.dynamics import PhysicsModel, parse_model, write_model
from safedpa.errors import SafedpaError
from safedpa.records.run import Run

if TYPE_CHECKING:
    from safedpa.diagnosis.report_schema import Candidate

__all__ = ["AbstractWorker", "Calibrate", "InlineWorker", "SearchJob", "WorkOutcome", "execute_job"]

_BETTER = 0.9
"""Times the error of what the search took."""

Calibrate = Callable[[PhysicsModel, Run, tuple[float, ...]], str]
"""The filter's margin for a model from a run of the robot with a given footprint, as the text that models are offered
with; empty where the model is none that the filter drives."""


@dataclass(frozen=True)
class SearchJob:
    """What is to be done, with all that it takes."""

    task: Literal["search", "prepare"]
    """``search``: which effects does the model lack? ``prepare``: the model with one of them, and its margin."""
    model: str
    """Text of the model file in force."""
    run: Run
    """What the robot did since the model's error left its band."""
    horizon: float = 1.0
    effect: str = ""
    """To prepare: which one."""
    document: str = ""
    """To prepare: the model with the effect as the search fitted it; empty: fit it now."""
    footprint: tuple[float, ...] = ()
    """To prepare: of the robot."""
    folder: Path | None = None
    """Where the weights of a learned model are."""


@dataclass(frozen=True)
class WorkOutcome:
    """What came of it. Texts, so that they pass from process to process."""

    report: str = ""
    """report.json of a search."""
    effects: tuple[str, ...] = ()
    """Of a search: what may be added, best first; what unseen data confirm has a document already."""
    documents: dict[str, str] = field(default_factory=dict)
    """Model file texts by the effect that they have beyond the one in force."""
    margin: str = ""
    failure: str = ""
    """Why nothing came of it, in one sentence."""


def execute_job(work: SearchJob, calibrate: Calibrate) -> WorkOutcome:
    """Does the work in this process; takes seconds. What goes wrong with data or model stands in the outcome."""
    try:
        return _searched(work) if work.task == "search" else _prepared(work, calibrate)
    except SafedpaError as error:
        return WorkOutcome(failure=" ".join(str(error).split()))


def _searched(work: SearchJob) -> WorkOutcome:
    from safedpa.diagnosis.diagnose import diagnose
    from safedpa.diagnosis.report_schema import as_document

    given = parse_model(work.model, work.folder)
    report = diagnose(given, [work.run], work.horizon)
    documents = {}
    if report.added:
        extra = report.models[1].effects[len(given.effects) :]
        documents[" + ".join(item.name for item in extra)] = write_model(report.models[1])
    effects = _in_order([item for item in report.candidates if item.stage == 0], set(documents))
    return WorkOutcome(json.dumps(as_document(report), allow_nan=False), effects, documents)


def _in_order(candidates: Sequence[Candidate], confirmed: set[str]) -> tuple[str, ...]:
    """What may be added: what is confirmed, what is suspected, and what cannot be told from the former; best first.

    With seconds of data many effects pass, and the search then takes the one with the fewest numbers. Anyone who predicts
    unseen data better by a tenth comes before it.
    """
    equal = {name for item in candidates if item.effect in confirmed for name in item.indistinguishable_from}
    errors = {
        item.effect: item.heldout_error
        for item in candidates
        if item.heldout_error is not None
        and (
            item.effect in confirmed
            or ("+" not in item.effect and (item.decision == "suspected" or item.effect in equal))
        )
    }
    own = min((error for effect, error in errors.items() if effect in confirmed), default=float("inf"))
    better = [effect for effect, error in errors.items() if error < _BETTER * own]
    ordered = [*sorted(better, key=errors.__getitem__), *(e for e in errors if e in confirmed), *errors]
    return tuple(dict.fromkeys(ordered))


def _prepared(work: SearchJob, calibrate: Calibrate) -> WorkOutcome:
    from safedpa.diagnosis.diagnose import add_effect

    if work.document:
        model = parse_model(work.document, work.folder)
    else:
        model = add_effect(parse_model(work.model, work.folder), work.effect, [work.run], work.horizon).model
    margin = calibrate(model, work.run, work.footprint)
    return WorkOutcome(documents={work.effect: write_model(model)}, margin=margin)


class AbstractWorker(ABC):
    """Carries out at most one work for each robot, next to whatever else goes on."""

    @abstractmethod
    def begin(self, robot: str, work: SearchJob) -> None:
        """Starts a work; one that the robot still has is cancelled."""

    @abstractmethod
    def outcome(self, robot: str) -> WorkOutcome | None:
        """What came of it, once; None while it goes on, and when there is none."""

    @abstractmethod
    def cancel(self, robot: str) -> None:
        """Gives up the robot's work, if it has one."""

    @abstractmethod
    def busy(self, robot: str) -> bool:
        """Whether a work of the robot was begun and its outcome not fetched."""


@final
class InlineWorker(AbstractWorker):
    """Does the work at once, in the caller's time: for experiments in lockstep, where no one waits."""

    def __init__(self, calibrate: Calibrate) -> None:
        self._calibrate = calibrate
        self._outcomes: dict[str, WorkOutcome] = {}

    def begin(self, robot: str, work: SearchJob) -> None:  # noqa: D102
        self._outcomes[robot] = execute_job(work, self._calibrate)

    def outcome(self, robot: str) -> WorkOutcome | None:  # noqa: D102
        return self._outcomes.pop(robot, None)

    def cancel(self, robot: str) -> None:  # noqa: D102
        self._outcomes.pop(robot, None)

    def busy(self, robot: str) -> bool:  # noqa: D102
        return robot in self._outcomes
