"""One robot's findings: from learning what the error usually is to candidates for what the model lacks.

The last minutes of the robot are kept meanwhile: bounded, and cut into a run for a search.
"""

from __future__ import annotations

import json
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import FindingMessage, LatentMessage, StateMessage, VerdictMessage
from safedpa.dynamics import fingerprint, parse_model
from safedpa.live.named_candidate import named_candidate
from safedpa.live.watch import ModelMonitor, VerdictFacts
from safedpa.live.work import AbstractWorker, SearchJob, WorkOutcome
from safedpa.records.run import Run, Stretch
from safedpa.systems import System

__all__ = ["FIRST_SEARCH", "DriveHistory", "RobotDiagnosis"]


@final
class DriveHistory:
    """States and the actions that followed them, at most ``longest`` [s] of them."""

    def __init__(self, system: System, period: float, longest: float = 120.0) -> None:
        self._system = system
        self._period = period
        self._rows: deque[tuple[int, FloatArray, FloatArray]] = deque(maxlen=max(2, round(longest / period)))
        """Tick, state, and what was applied before it."""

    def add(self, tick: int, state: FloatArray, applied: FloatArray) -> None:
        """Keeps one tick; one that cannot be believed is left out, which makes a gap."""
        if self._system.is_plausible(state) and np.isfinite(applied).all():
            self._rows.append((tick, state, applied))

    def last(self, seconds: float) -> list[tuple[int, FloatArray, FloatArray]]:
        """Tick, state, and what was applied before it, of the newest rows."""
        return list(self._rows)[-max(1, round(seconds / self._period)) :]

    def seconds_since(self, tick: int) -> float:
        """How much of the time from a tick on is kept [s]."""
        return self._period * sum(row[0] >= tick for row in self._rows)

    def excerpt(self, first: int, name: str) -> Run:
        """The rows from tick ``first`` on as a run, cut where ticks are missing, its time the robot's."""
        rows = [row for row in self._rows if row[0] >= first]
        ticks = np.array([row[0] for row in rows], dtype=np.int64)
        states = np.array([row[1] for row in rows]).reshape(len(rows), len(self._system.state))
        before = np.array([row[2] for row in rows]).reshape(len(rows), len(self._system.action))
        # the action of a row holds until the next one: it is reported with the next tick
        known = np.append(np.diff(ticks) == 1, False)[: len(rows)]
        actions = np.where(known[:, None], np.roll(before, -1, axis=0), 0.0)
        t = np.asarray(ticks * self._period, dtype=np.float64)
        ends = np.flatnonzero(~known)
        starts = np.append(0, ends + 1)[: len(ends)]
        # a stretch ends before the row whose action is not known
        stretches = [Stretch(int(begin), int(end)) for begin, end in zip(starts, ends, strict=True) if end - begin > 1]
        for index in range(2, len(self._system.state)):
            if index in self._system.angles:
                states[:, index] = _unwrapped(states[:, index])
        return Run(name, self._system, t, states, actions, tuple(stretches))


def _unwrapped(angles: FloatArray) -> FloatArray:
    return np.asarray(np.unwrap(angles)) if len(angles) else angles


FIRST_SEARCH: Final = 15.0
"""s of driving after the change for the first search; each further one has twice as much."""
_LONGEST = 100.0
"""s; with more data nothing is searched again."""
_REPORT_EVERY = 10
"""Messages: a report is large, and who comes late gets it within ten seconds."""
_NONE = 1.0
"""Of the evidence: it does not fall to 0 even where nothing has ever happened."""
_REPLAYED = 3.0
"""Horizons of the past that a new model predicts at once."""
_REPORTED_SECONDS = 60.0
"""How long after a change of the model the error before is told next to the error now."""


@dataclass
class _Finding:
    """What is known of the finding that is open."""

    first: int
    """Tick from which on the data are of the changed robot alone."""
    seconds: float = FIRST_SEARCH
    """Data that the next search wants."""
    searching: bool = False
    outcome: WorkOutcome | None = None


@dataclass(frozen=True)
class _Adopted:
    at: float
    """s"""
    before: float
    """Error of the model that was replaced."""


@final
class RobotDiagnosis:
    """Follows one robot; ``observe`` once a tick. The work that takes seconds goes to the worker.

    ``document`` is the text of the model file in force, ``folder`` where the weights of a learned one are; ``period``
    [s] that of the robot's ticks, by default the model's; ``number`` that of the robot's last finding, before it
    restarted.
    """

    def __init__(
        self,
        robot: str,
        document: str,
        worker: AbstractWorker,
        *,
        folder: Path | None = None,
        period: float | None = None,
        horizon: float = 1.0,
        number: int = 0,
    ) -> None:
        self._robot = robot
        self._worker = worker
        self._horizon = horizon
        self._folder = folder
        self._document = document
        model = parse_model(document, folder)
        self.fingerprint = fingerprint(model)
        """Of the model in force."""
        self._period = model.period if period is None else period
        self.watch = ModelMonitor(model, horizon, period=self._period)
        self.history = DriveHistory(model.system, self._period)
        self.number = number
        """Of the newest finding; they are counted over all drives of the robot."""
        self._finding: _Finding | None = None
        self._adopted: _Adopted | None = None
        self.time = 0.0
        """s; of the newest tick, by the robot's clock."""
        self._reported: tuple[object, ...] = ()
        self._sent = 0

    @property
    def stage(self) -> str:
        """As in ``FindingMessage``."""
        finding = self._finding
        if finding is None:
            return "learning" if self.watch.band is None else "watching"
        if finding.outcome is not None:
            return "candidates" if finding.outcome.effects else "nothing"
        return "searching" if finding.searching else "raised"

    @property
    def outcome(self) -> WorkOutcome | None:
        """Of the newest search about the open finding."""
        return None if self._finding is None else self._finding.outcome

    def adopt(self, document: str) -> None:
        """From now on another model is in force: the finding is closed and the band learned again.

        The last seconds are predicted by the new model at once, so that its error is told without a gap.
        """
        model = parse_model(document, self._folder)
        self._adopted = _Adopted(self.time, self.watch.error)
        self._document, self.fingerprint = document, fingerprint(model)
        self.watch = ModelMonitor(model, self._horizon, self.watch.scale, self._period)
        for tick, state, applied in self.history.last(_REPLAYED * self._horizon):
            self.watch.observe(tick, state, applied, None)
        self._close()

    def dismiss(self) -> None:
        """What was found is not wanted: how the model errs now is what is usual from here on."""
        self.watch = ModelMonitor(self.watch.model, self._horizon, self.watch.scale, self._period)
        self._close()

    def pause(self) -> None:
        """Gives up a search that goes on: the worker is needed for something else."""
        if self._finding is not None and self._finding.searching:
            self._worker.cancel(self._robot)
            self._finding.searching = False

    def data(self) -> Run | None:
        """What the robot did since the change, up to now; None without an open finding."""
        return None if self._finding is None else self.history.excerpt(self._finding.first, self._robot)

    def observe(
        self, state: StateMessage, latent: LatentMessage | None, verdict: VerdictMessage | None
    ) -> FindingMessage | None:
        """Takes one tick; returns what is to be told, once a second and whenever something changes."""
        values, applied = np.array(state.values), np.array(state.applied)
        self.time = state.robot_time
        self.history.add(state.tick, values, applied)
        self.watch.observe(state.tick, values, applied, self._latent(latent))
        self.watch.judge_margin(state.tick, _decision(verdict), obeyed=state.applied_by == "filter")
        self._think(state)
        second = int(state.robot_time + 1e-9)
        news = (second, self.stage, self.number, id(self.outcome))
        if news == self._reported:
            return None
        fresh, self._reported = news[1:] != self._reported[1:], news
        return self._message(state, fresh)

    def _think(self, state: StateMessage) -> None:
        if self._finding is None:
            changed = self.watch.changed_at() if self.watch.evidence.raised else None
            if changed is None:
                return
            self.number += 1
            self._finding = _Finding(changed + round(self._horizon / state.period))
        if self.watch.evidence.value < _NONE:  # the error is back in its band
            self._close()
            return
        self._search(self._finding)

    def _search(self, finding: _Finding) -> None:
        if finding.searching:
            outcome = self._worker.outcome(self._robot)
            if outcome is not None:
                finding.searching, finding.outcome = False, outcome
                finding.seconds *= 2.0
        elif finding.seconds <= _LONGEST and self.history.seconds_since(finding.first) >= finding.seconds:
            if self._worker.busy(self._robot):
                return
            run = self.history.excerpt(finding.first, self._robot)
            self._worker.begin(
                self._robot, SearchJob("search", self._document, run, self._horizon, folder=self._folder)
            )
            finding.searching = True

    def _close(self) -> None:
        self.pause()
        self._finding = None

    def close(self) -> None:
        """The robot has left."""
        self._worker.cancel(self._robot)
        self._finding = None

    def _latent(self, latent: LatentMessage | None) -> FloatArray | None:
        """The latent if it belongs to the model; else the model's own values stand in."""
        names = self.watch.model.latent_names
        if latent is None or latent.model != self.fingerprint or len(latent.values) != len(names) or not names:
            return None
        return np.array(latent.values)

    def _message(self, state: StateMessage, fresh: bool) -> FindingMessage:
        watch, stage = self.watch, self.stage
        self._sent = 0 if fresh else self._sent + 1
        outcome = self.outcome
        with_report = outcome is not None and self._sent % _REPORT_EVERY == 0
        return FindingMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            model=self.fingerprint,
            stage=stage,
            sentence=self._sentence(stage),
            number=self.number,
            error=watch.error,
            band=0.0 if watch.band is None else watch.band.error,
            evidence=watch.evidence.value,
            threshold=watch.evidence.threshold,
            coverage=watch.coverage,
            where=watch.where,
            report=outcome.report if with_report and outcome is not None else "",
        )

    def _sentence(self, stage: str) -> str:
        watch, finding = self.watch, self._finding
        error = f"the error over {self._horizon:g} s is {watch.error:.3f}"
        if self._adopted is not None and self.time - self._adopted.at < _REPORTED_SECONDS and finding is None:
            error = f"{error}, {self._adopted.before:.3f} with the model before"
        if finding is None or watch.band is None:
            learned = f"still learning what is usual: {watch.seconds_to_learn:.0f} s of driving to go"
            return (
                f"{error}; {learned}"
                if watch.band is None
                else f"{error}, within its band up to {watch.band.error:.3f}"
            )
        left = f"finding {self.number}: {error}, its band ends at {watch.band.error:.3f}"
        if finding.outcome is not None:
            return f"{left}; {_reported_outcome(finding.outcome)}"
        seconds = self.history.seconds_since(finding.first)
        if finding.searching:
            return f"{left}; looking for the missing effect in {finding.seconds:.0f} s of driving"
        return f"{left}; {seconds:.0f} of {finding.seconds:.0f} s are recorded for the search"


def _reported_outcome(outcome: WorkOutcome) -> str:
    if outcome.failure:
        return f"the search failed: {outcome.failure}"
    if not outcome.effects:
        return "no effect of the library explains it"
    first, report = outcome.effects[0], json.loads(outcome.report)
    own = named_candidate(report["candidates"], first) or {}
    before, after = _error_reported(report["stages"][0]["heldout_error"]), _error_reported(own.get("heldout_error"))
    certain = "explains it" if outcome.documents else "may explain it, but unseen data do not confirm it"
    return f"{first} {certain}: held-out error {before} without, {after} with it"


def _error_reported(error: float | None) -> str:
    """Not every prediction stays a number, and not every candidate is tried on unseen data."""
    return "unknown" if error is None else f"{error:.3f}"


def _decision(verdict: VerdictMessage | None) -> VerdictFacts | None:
    """Of a verdict that rests on a prediction; a fallback predicts nothing."""
    if verdict is None or verdict.status not in ("passed", "corrected", "relaxed", "violated"):
        return None
    return VerdictFacts(verdict.h_now, verdict.h_next, verdict.margin)
