"""The slow jobs of a live diagnosis, which any process can run: the search, and the creation of a model."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

from safedpa.dynamics import PhysicsModel, parse_model, write_model
from safedpa.errors import SafedpaError
from safedpa.records.run import Run

if TYPE_CHECKING:
    from safedpa.diagnosis.report_schema import Candidate


# A candidate is listed before the one that the search accepted if its error is below this multiple of it.
_BETTER = 0.9

Calibrate = Callable[[PhysicsModel, Run, tuple[float, ...]], str]
"""(model, run, footprint of the robot) -> text of the filter's margin; empty for models that the filter does not
support."""


@dataclass(frozen=True)
class SearchJob:
    """A job with all its inputs."""

    task: Literal["search", "prepare"]
    """``search``: find the effects that the model lacks; ``prepare``: create the model with an effect, and its
    margin."""
    model: str
    """Text of the active model's file."""
    run: Run
    """Data since the model's error left its band."""
    horizon: float = 1.0
    effect: str = ""
    """For ``prepare``: the effect."""
    document: str = ""
    """For ``prepare``: the model with the effect as fitted by the search; empty: fit it now."""
    footprint: tuple[float, ...] = ()
    """For ``prepare``: footprint of the robot."""
    folder: Path | None = None
    """Folder with the weights of a learned model."""


@dataclass(frozen=True)
class WorkOutcome:
    """The result of a job, as texts that can be sent between processes."""

    report: str = ""
    """report.json of a search."""
    effects: tuple[str, ...] = ()
    """Candidates of a search, best first; those confirmed on unseen data have a document."""
    documents: dict[str, str] = field(default_factory=dict)
    """Model file texts by the added effect."""
    margin: str = ""
    failure: str = ""
    """Why the job failed, as one sentence."""


def execute_job(work: SearchJob, calibrate: Calibrate) -> WorkOutcome:
    """Runs the job in this process, for seconds. Problems with data or model are reported in the result."""
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
    """Returns the effects that may be added, best first: confirmed, suspected, and indistinguishable from confirmed.

    With only seconds of data many effects pass, and the search accepts the one with the fewest parameters. An effect
    that predicts unseen data better by at least 10 % comes before it.
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
    """Runs at most one job per robot in the background."""

    @abstractmethod
    def begin(self, robot: str, work: SearchJob) -> None:
        """Starts a job; cancels an earlier one of the robot."""

    @abstractmethod
    def outcome(self, robot: str) -> WorkOutcome | None:
        """Returns the result, once; None while the job is running and without a job."""

    @abstractmethod
    def cancel(self, robot: str) -> None:
        """Cancels the robot's job, if there is one."""

    @abstractmethod
    def busy(self, robot: str) -> bool:
        """Whether the robot has a job whose result was not fetched."""

    @abstractmethod
    def give_way(self) -> None:
        """Lets all jobs pause for a moment, because a drive misses ticks; at least half of the time they run."""


@final
class InlineWorker(AbstractWorker):
    """Runs jobs synchronously in ``begin``, for experiments in lockstep."""

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

    def give_way(self) -> None:
        """Does nothing: no job runs alongside the drive."""


def named_candidate(candidates: Iterable[Mapping[str, Any]], effect: str) -> Mapping[str, Any] | None:
    """Returns the entry of a report's ``candidates`` for an effect; None if there is none.

    An effect with and without a condition (below a speed, in a region) has the same name. Of the first stage's entries
    with that name this is the accepted one, otherwise the one with the lowest error on unseen data.
    """
    own = [item for item in candidates if item.get("stage", 0) == 0 and item["effect"] == effect]
    return min(own, key=_place, default=None)


def _place(item: Mapping[str, Any]) -> tuple[bool, bool, float]:
    """Sort key: accepted first, then by error."""
    # NaN is not ordered, so it counts as missing; entries that were not tried on unseen data have no error and come
    # last.
    reported = item.get("heldout_error")
    error = inf if reported is None or isnan(reported) else float(reported)
    return item.get("decision") != "accepted", error == inf, error
