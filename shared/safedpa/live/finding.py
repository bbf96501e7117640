"""Live diagnosis of one robot: learns the usual error, raises a finding, and searches for the missing effect.

``DriveHistory`` keeps the last two minutes of states and actions for a search. ``RobotDiagnosis`` goes through the
stages of ``FindingMessage``: learning, watching, raised, searching, candidates or nothing.
"""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import FindingMessage, LatentMessage, StateMessage, VerdictMessage
from safedpa.bus.messages.messages import header
from safedpa.dynamics import fingerprint, parse_model
from safedpa.live.model_monitor import ModelMonitor
from safedpa.live.search_jobs import AbstractWorker, SearchJob, WorkOutcome, named_candidate
from safedpa.records.run import Run, Stretch
from safedpa.systems import System


@final
class DriveHistory:
    """The newest states and actions of a robot, at most ``longest`` [s] of them."""

    def __init__(self, system: System, period: float, longest: float = 120.0) -> None:
        self._system = system
        self._period = period
        self._rows: deque[tuple[int, FloatArray, FloatArray]] = deque(maxlen=max(2, round(longest / period)))
        """Tick, state, and the action applied before it."""

    def add(self, tick: int, state: FloatArray, applied: FloatArray) -> None:
        """Adds one tick; implausible values are left out and leave a gap."""
        if self._system.is_plausible(state) and np.isfinite(applied).all():
            self._rows.append((tick, state, applied))

    def last(self, seconds: float) -> list[tuple[int, FloatArray, FloatArray]]:
        """Returns tick, state and the action applied before it, for the last ``seconds``."""
        return list(self._rows)[-max(1, round(seconds / self._period)) :]

    def seconds_since(self, tick: int) -> float:
        """Returns the recorded time [s] since a tick."""
        return self._period * sum(row[0] >= tick for row in self._rows)

    def excerpt(self, first: int, name: str) -> Run:
        """Returns the rows from tick ``first`` on as a run, split into stretches at missing ticks."""
        rows = [row for row in self._rows if row[0] >= first]
        ticks = np.array([row[0] for row in rows], dtype=np.int64)
        states = np.array([row[1] for row in rows]).reshape(len(rows), len(self._system.state))
        before = np.array([row[2] for row in rows]).reshape(len(rows), len(self._system.action))
        # The action taken in a row is reported as "applied" with the next tick.
        known = np.append(np.diff(ticks) == 1, False)[: len(rows)]
        actions = np.where(known[:, None], np.roll(before, -1, axis=0), 0.0)
        t = np.asarray(ticks * self._period, dtype=np.float64)
        ends = np.flatnonzero(~known)
        starts = np.append(0, ends + 1)[: len(ends)]
        # A stretch ends before the row whose action is not known.
        stretches = [Stretch(int(begin), int(end)) for begin, end in zip(starts, ends, strict=True) if end - begin > 1]
        for index in range(2, len(self._system.state)):
            if index in self._system.angles and rows:
                states[:, index] = np.unwrap(states[:, index])
        return Run(name, self._system, t, states, actions, tuple(stretches))


FIRST_SEARCH: Final = 15.0
"""s of driving after the change that the first search uses; each further search uses twice as much."""
# s; no further search with more data than this.
_LONGEST = 100.0
# Messages between two with the report, which is large: a listener that joins later has it within ten seconds.
_REPORT_EVERY = 10
# The finding is closed below this evidence. It does not reach 0 even if the error was never outside its band.
_NO_EVIDENCE = 1.0
# Horizons of the past that a new model predicts immediately.
_REPLAYED = 3.0
# s after a model change during which the error of the previous model is shown next to the current one.
_COMPARISON_SECONDS = 60.0


@dataclass
class _Finding:
    """The open finding."""

    first: int
    """First tick whose data are entirely from after the change of the robot."""
    seconds: float = FIRST_SEARCH
    """Amount of data in s for the next search."""
    searching: bool = False
    outcome: WorkOutcome | None = None


@final
class RobotDiagnosis:
    """Live diagnosis of one robot. Call ``observe`` once per tick; searches run in ``worker``.

    ``document`` is the text of the active model's file, ``folder`` has the weights of a learned model. ``period`` [s]
    is the robot's, by default the model's. ``number`` is the number of the robot's last finding before it restarted.
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
        """Fingerprint of the active model."""
        self._period = model.period if period is None else period
        self.watch = ModelMonitor(model, horizon, period=self._period)
        self.history = DriveHistory(model.system, self._period)
        self.number = number
        """Number of the newest finding, counted over all drives of the robot."""
        self._finding: _Finding | None = None
        self._adopted: tuple[float, float] | None = None
        """Time [s] of the last change of the model, and the error of the previous one."""
        self.time = 0.0
        """Time of the newest tick in s, by the robot's clock."""
        self._reported: tuple[object, ...] = ()
        self._sent = 0

    @property
    def stage(self) -> str:
        """The stage as in ``FindingMessage``."""
        finding = self._finding
        if finding is None:
            return "learning" if self.watch.band is None else "watching"
        if finding.outcome is not None:
            return "candidates" if finding.outcome.effects else "nothing"
        return "searching" if finding.searching else "raised"

    @property
    def outcome(self) -> WorkOutcome | None:
        """Result of the newest search for the open finding."""
        return None if self._finding is None else self._finding.outcome

    def adopt(self, document: str) -> None:
        """Switches to another active model: closes the finding and learns the error band again.

        Predicts the last seconds with the new model, so that its error is available immediately.
        """
        model = parse_model(document, self._folder)
        self._adopted = self.time, self.watch.error
        self._document, self.fingerprint = document, fingerprint(model)
        self.watch = ModelMonitor(model, self._horizon, self.watch.scale, self._period)
        for tick, state, applied in self.history.last(_REPLAYED * self._horizon):
            self.watch.observe(tick, state, applied, None)
        self._close()

    def dismiss(self) -> None:
        """Closes the finding after all candidates were rejected; learns the present error as the usual one."""
        self.watch = ModelMonitor(self.watch.model, self._horizon, self.watch.scale, self._period)
        self._close()

    def pause(self) -> None:
        """Cancels a running search, because the worker is needed for another job."""
        if self._finding is not None and self._finding.searching:
            self._worker.cancel(self._robot)
            self._finding.searching = False

    def data(self) -> Run | None:
        """Returns the data since the change of the robot; None without an open finding."""
        return None if self._finding is None else self.history.excerpt(self._finding.first, self._robot)

    def observe(
        self, state: StateMessage, latent: LatentMessage | None, verdict: VerdictMessage | None
    ) -> FindingMessage | None:
        """Handles one tick; returns the message to publish, once a second and on every change."""
        values, applied = np.array(state.values), np.array(state.applied)
        self.time = state.robot_time
        self.history.add(state.tick, values, applied)
        self.watch.observe(state.tick, values, applied, self._latent(latent))
        # Others, such as a fallback, have no prediction.
        predicts = verdict is not None and verdict.status in ("passed", "corrected", "relaxed", "violated")
        self.watch.judge_margin(state.tick, verdict if predicts else None, obeyed=state.applied_by == "filter")
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
            # A forecast that began before the change ends up to one horizon after it.
            self._finding = _Finding(changed + round(self._horizon / state.period))
        if self.watch.evidence.value < _NO_EVIDENCE:  # the error is back in its band
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
        """Ends the diagnosis of a robot that has left."""
        self._worker.cancel(self._robot)
        self._finding = None

    def _latent(self, latent: LatentMessage | None) -> FloatArray | None:
        """Returns the latent if it belongs to the model; None uses the model's own values."""
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
            **header(state),
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
        if not watch.is_measured:
            error = f"the error over {self._horizon:g} s is not measured yet"
        if self._adopted is not None and self.time - self._adopted[0] < _COMPARISON_SECONDS and finding is None:
            error = f"{error}, {self._adopted[1]:.3f} with the previous model"
        if finding is None or watch.band is None:
            learned = f"still learning the usual error: {watch.seconds_to_learn:.0f} s of driving to go"
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
    """Formats an error; it may be missing."""
    # A prediction may diverge, and not every candidate is tried on unseen data.
    return "unknown" if error is None else f"{error:.3f}"
