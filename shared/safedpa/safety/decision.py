"""One decision: from inputs to a verdict, down the ladder of fallbacks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, nan
from typing import Any, Final, TypeAlias, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.stack import BarrierSetCache
from safedpa.safety.margins.active import ActiveMargins
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.settings import FilterSettings
from safedpa.safety.solver.candidates import NEARBY, HeldSolution, action_grid, grid_around
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa.safety.solver.least_violation import least_violation
from safedpa.safety.solver.maximin_lp import MaxMinProgram
from safedpa.safety.solver.qp import QuadraticProgram
from safedpa.safety.solver.qp_scaling import within
from safedpa.safety.solver.sqp import DecisionError, backtrack_towards, line_search
from safedpa.safety.solver.sqp import search as _search
from safedpa.safety.validation import InvalidInput, Plausible, checked_input, checked_names, checked_output
from safedpa.safety.verdict import Status, Verdict

__all__ = ["Backup", "Decision", "FilterContext", "FilterInput"]

Action: TypeAlias = tuple[float, ...]
Backup = Callable[[FloatArray | None], Any]
"""The backup action (actions,) at a state (states,); None when the state is not known."""

search: Callable[..., tuple[ActionCandidate, str]] = _search
"""Looked up at every call, compiled or not: tests put others in its place."""

_BINDING: Final = 0.02
"""A condition within this share of its scale of its limit is reported as active."""


_NAMED: Final = 3
"""Barriers that a sentence names at most."""

_STARTS: Final = 3
"""Actions that satisfy all conditions from which a nearer one is looked for."""


@final
@dataclass(frozen=True, eq=False)
class FilterContext:
    """What does not change from tick to tick."""

    settings: FilterSettings
    prediction: Prediction
    program: QuadraticProgram
    highest: MaxMinProgram
    stacks: BarrierSetCache
    margins: ActiveMargins
    backup: Backup | None
    resting_action: Action
    state_range: Plausible | None
    nominal_range: Plausible
    latent_range: Plausible | None
    clock: Callable[[], float]


@final
class FilterInput:
    """What one tick brings; nothing of it is trusted."""

    def __init__(
        self,
        state: Any,
        nominal: Any,
        latent: Any,
        memory: Any,
        barriers: Sequence[AbstractBarrier],
        epsilon: Mapping[str, float],
        stale: Sequence[str],
        time: Any = None,
        searched: Any = None,
    ) -> None:
        self.state, self.nominal, self.latent, self.memory = state, nominal, latent, memory
        self.barriers, self.epsilon, self.stale, self.time = barriers, epsilon, stale, time
        self.searched = searched if isinstance(searched, HeldSolution) else HeldSolution()


@final
class Decision:
    """What is known so far of one decision, so that a failure half way can still report it."""

    def __init__(self, tools: FilterContext, request: FilterInput) -> None:
        self._tools, self._request = tools, request
        self._start = tools.clock()
        stale = checked_names(request.stale)
        self._problems = ["stale is no list of names"] if stale is None else [f"{name} is stale" for name in stale]
        self._state = self._checked("state", request.state, tools.state_range)
        if stale is None or "state" in stale:
            self._state = None
        self._nominal = self._checked("nominal", request.nominal, tools.nominal_range)
        wanted = tools.latent_range
        self._needs_latent = wanted is not None and len(wanted.names) > 0
        given = self._needs_latent or request.latent is not None
        self._latent = self._checked("latent", request.latent, wanted) if given else None
        self._seconds = nan
        """Since the start of the run; NaN: not told."""
        self._report_time(request.time)
        self._margin = 0.0
        self._conditions: Constraints | None = None

    def _report_time(self, seconds: Any) -> None:
        """A model that depends on the time since the start is asked at that time, and not at all without it."""
        prediction = self._tools.prediction
        reported = float(seconds) if isinstance(seconds, (float, int)) else nan
        if 0.0 <= reported < inf:
            self._seconds = reported
            prediction.report_time(self._seconds)
        elif prediction.timed:  # to any other model the time says nothing
            self._problems.append(
                f"time: got {seconds!r}, wanted the seconds since the start of the run, on which the model depends"
            )

    def run(self) -> Verdict:
        """The verdict; raises DecisionError, or whatever a user's function raises, when there is none."""
        if self._problems:
            raise DecisionError("; ".join(self._problems))
        assert self._nominal is not None
        conditions = self._posed()
        clipped = self._within(self._nominal)
        unclipped = clipped == self._nominal
        asked = conditions.outcome(self._nominal if unclipped else clipped)  # bit for bit, -0.0 as well
        if not self._tools.settings.enabled:
            return self._verdict(Status.disabled, asked, "", "not run")
        if conditions.least_now < 0.0:
            return self._violated(conditions, asked)
        if asked.kept:
            if unclipped:
                return self._verdict(Status.passed, asked, "", "not needed")
            return self._verdict(
                Status.corrected, asked, "The nominal action lay outside the actuator limits.", "not needed"
            )
        return self._correct(conditions, self._nominal, asked)

    def fallback(self, reason: str, solver: str) -> Verdict:
        """The backup action, and of what it leads to whatever can still be computed; raises nothing."""
        action, status = self._backup_action(), Status.fallback
        if self._nominal is not None and not self._tools.settings.enabled:
            action, status = self._within(self._nominal), Status.disabled
        return self._unchecked(status, action, f"Reason: {reason}.", solver)

    def stopped(self, reason: str) -> Verdict:
        """The backup action because someone ordered it, and of what it leads to whatever can be computed."""
        return self._unchecked(Status.stopped, self._backup_action(), f"Reason: {reason}.", "not run")

    def _unchecked(self, status: Status, action: Action, reason: str, solver: str) -> Verdict:
        try:
            conditions = self._conditions or self._posed()
            return self._verdict(status, conditions.outcome(action), reason, solver)
        except Exception:  # noqa: BLE001 - the same failure may strike again; then h stays unknown
            return self._answer(status, action, reason, solver)

    def _checked(self, what: str, value: Any, plausible: Plausible | None) -> Action | None:
        checked = checked_input(what, value, plausible)
        if isinstance(checked, InvalidInput):
            self._problems.append(checked.reason)
            return None
        return checked

    def _posed(self) -> Constraints:
        """The conditions at this state; raises DecisionError when an input that they need is missing."""
        request, settings = self._request, self._tools.settings
        if self._state is None or (self._needs_latent and self._latent is None):
            raise DecisionError("state or latent unusable")
        barriers = self._tools.stacks.of(request.barriers, len(self._state))
        if not barriers.names:
            raise DecisionError("there is no barrier to keep")
        epsilon, self._margin = self._tools.margins.of(barriers, request.epsilon)
        self._conditions = Constraints(
            barriers,
            self._tools.prediction,
            self._state,
            self._latent,
            request.memory,
            settings.eta,
            epsilon,
            self._tools.program.sides,
        )
        return self._conditions

    def _correct(self, conditions: Constraints, nominal: Action, asked: ActionCandidate) -> Verdict:
        program, rounds = self._tools.program, self._tools.settings.relinearisations + 1
        found, solver = search(conditions, program, nominal, asked, rounds)
        if found.kept:
            return self._kept(conditions, nominal, found, "", solver)
        searched = self._request.searched
        held = searched.still(conditions, program.sides, self._seconds)
        if held is not None and not held.kept:
            notice = f"{self._worst(conditions, held)}{searched.notice} Found a moment ago, and no worse now."
            return self._verdict(Status.relaxed, held, notice, solver)
        backup = conditions.outcome(self._backup_action())
        spread = self._spread(conditions)
        other, solver = self._restart_from(conditions, nominal, asked, [backup, *spread])
        if other.kept:
            return self._kept(conditions, nominal, other, "Found from another start than the nominal action.", solver)
        nearby = self._coordinate_search(conditions, [backup, found, other, *spread])
        if nearby.kept:
            other, solver = self._restart_from(conditions, nominal, asked, [nearby])
            return self._kept(conditions, nominal, other, "Found next to the least broken of many actions.", solver)
        best, notice = self._least_violation(conditions, backup, [asked, found, other, nearby, *spread])
        if best.kept:
            other, solver = self._restart_from(conditions, nominal, asked, [best])
            return self._kept(conditions, nominal, other, "Found among the least-violation actions.", solver)
        searched.note(best, self._seconds, notice)
        return self._verdict(Status.relaxed, best, f"{self._worst(conditions, best)}{notice}", solver)

    def _kept(
        self, conditions: Constraints, nominal: Action, found: ActionCandidate, reason: str, solver: str
    ) -> Verdict:
        """Corrected to what was found, with no entry that might be a step nearer by itself; once posed from there."""
        program = self._tools.program
        back = backtrack_towards(conditions, program.sides, nominal, found)
        if back is not found:
            again, _ = search(conditions, program, nominal, back, 1)
            nearer = again.kept and program.distance(again.action, nominal) < program.distance(back.action, nominal)
            found = again if nearer else back
        return self._verdict(Status.corrected, found, reason, solver)

    def _restart_from(
        self, conditions: Constraints, nominal: Action, asked: ActionCandidate, known: Sequence[ActionCandidate]
    ) -> tuple[ActionCandidate, str]:
        """The best outcome found from the kept ones of ``known`` that are nearest to the nominal action, or the least broken."""
        program, rounds = self._tools.program, self._tools.settings.relinearisations + 1
        kept = sorted([one for one in known if one.kept], key=lambda one: program.distance(one.action, nominal))
        if not kept:
            return search(conditions, program, nominal, max(known, key=conditions.tightest), rounds)
        best, status = kept[0], "not needed"
        for start in kept[:_STARTS]:
            nearer = line_search(conditions, asked, start)
            found, solver = search(conditions, program, nominal, nearer, rounds)
            for one in (nearer, found):
                if one.kept and program.distance(one.action, nominal) < program.distance(best.action, nominal):
                    best, status = one, solver
        return best, status

    def _coordinate_search(self, conditions: Constraints, known: Sequence[ActionCandidate]) -> ActionCandidate:
        """The least broken that is found by moving the least broken of ``known`` one entry at a time, less and less.

        Where h bends, as at a standstill, no tangent tells what the other side is like.
        """
        sides = self._tools.program.sides
        best = max([one for one in known if one.usable] or known, key=conditions.tightest)
        most = conditions.tightest(best)
        for share in NEARBY:
            if best.kept:
                break
            for tried in [conditions.outcome(one) for one in grid_around(sides, best.action, share)]:
                if tried.usable and conditions.tightest(tried) > most:
                    best, most = tried, conditions.tightest(tried)
        if best.kept:
            return best
        found, _ = search(conditions, self._tools.program, best.action, best, 2)
        return found

    def _violated(self, conditions: Constraints, asked: ActionCandidate) -> Verdict:
        backup = conditions.outcome(self._backup_action())
        best, notice = self._least_violation(conditions, backup, [asked, *self._spread(conditions)])
        names, h_now = conditions.barriers.names, conditions.h_now
        below = ", ".join([names[row] for row in range(len(names)) if h_now[row] < 0.0])
        return self._verdict(Status.violated, best, f"Below 0: {below}.{notice}", "solved")

    def _spread(self, conditions: Constraints) -> list[ActionCandidate]:
        tools = self._tools
        return [conditions.outcome(one) for one in action_grid(tools.program.sides, affine=tools.prediction.affine)]

    def _least_violation(
        self, conditions: Constraints, backup: ActionCandidate, known: list[ActionCandidate]
    ) -> tuple[ActionCandidate, str]:
        """The least-violation outcome, and what is to be said of barriers that no action moves."""
        assert self._nominal is not None
        tools = self._tools
        best, stuck = least_violation(conditions, tools.program, tools.highest, self._nominal, backup, known)
        if not stuck:
            return best, ""
        return (
            best,
            f" No action moves {', '.join(stuck[:_NAMED])} within one step: the backup is taken for the nominal action.",
        )

    def _worst(self, conditions: Constraints, best: ActionCandidate) -> str:
        """Which conditions cannot be kept, in words."""
        names = conditions.active_names(best, 0.0)
        return f"Not kept: {', '.join(names[:_NAMED])}{', ...' if len(names) > _NAMED else ''}."

    def _backup_action(self) -> Action:
        """The user's backup within the bounds; the resting action where there is none or it fails."""
        if self._tools.backup is None:
            return self._tools.resting_action
        try:
            state = None if self._state is None else np.array(self._state)
            action = checked_output("backup", self._tools.backup(state))
        except Exception:  # noqa: BLE001 - the last resort must not depend on a user's function
            return self._tools.resting_action
        if action.shape != (len(self._tools.resting_action),) or not np.isfinite(action).all():
            return self._tools.resting_action
        return self._within(tuple(action.tolist()))

    def _within(self, action: Action) -> Action:
        return within(action, self._tools.program.sides)

    def _verdict(self, status: Status, outcome: ActionCandidate, reason: str, solver: str) -> Verdict:
        if not outcome.usable:
            return self._answer(status, outcome.action, reason, solver)
        conditions = self._conditions
        active = () if conditions is None else conditions.active_names(outcome, _BINDING)
        least = outcome.least
        if conditions is not None and conditions.least_pending < least:
            least = conditions.least_pending
            if least < 0.0 and status in (Status.passed, Status.corrected):
                status, reason = Status.relaxed, "Some h falls below 0 before this action can act."
        return self._answer(status, outcome.action, reason, solver, outcome.violation, active, least)

    def _answer(
        self,
        status: Status,
        action: Sequence[float],
        reason: str,
        solver: str,
        slack: float = 0.0,
        active: tuple[str, ...] = (),
        h_next: float | None = None,
    ) -> Verdict:
        taken = np.array(action)
        taken.setflags(write=False)
        conditions = self._conditions
        return Verdict.of(
            {
                "action": taken,
                "status": status,
                "reason": reason,
                "slack": slack,
                "active": active,
                "h_now": 0.0 if conditions is None else conditions.least_now,
                "h_next": 0.0 if h_next is None else h_next,
                "margin": self._margin,
                "solver": solver,
                "microseconds": 1e6 * (self._tools.clock() - self._start),
                "nominal": None if self._nominal is None else np.array(self._nominal),
                "known": conditions is not None and h_next is not None,
            }
        )
