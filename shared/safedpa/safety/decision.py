"""One decision: from inputs to a verdict, with every fallback in between.

Order of the fallbacks: the nominal action, the nearest feasible action (SQP), a feasible action from another start, the
least-violation action, the backup action, the resting action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, nan
from typing import Any, Final, TypeAlias, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.stack import BarrierSetCache
from safedpa.safety.compiled_decision import BELOW, OPEN, PASSED, CompiledDecisions, Found
from safedpa.safety.errors import OutOfBudgetError
from safedpa.safety.margins.active import ActiveMargins
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.settings import FilterSettings
from safedpa.safety.solver.budget import DecisionBudget
from safedpa.safety.solver.candidates import STEP_SHARES, HeldSolution, action_grid, grid_around
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa.safety.solver.feasibility import most_feasible
from safedpa.safety.solver.least_violation import least_violation
from safedpa.safety.solver.maximin_lp import MaxMinProgram
from safedpa.safety.solver.qp import QuadraticProgram
from safedpa.safety.solver.qp_scaling import clip_to_bounds
from safedpa.safety.solver.sqp import DecisionError, backtrack_towards, line_search
from safedpa.safety.solver.sqp import solve_sqp as _solve_sqp
from safedpa.safety.validation import InvalidInput, Plausible, checked_input, checked_names, checked_output
from safedpa.safety.verdict import OUTSIDE_LIMITS, TOO_LATE, Status, Verdict

__all__ = ["Backup", "Decision", "FilterContext", "FilterInput"]

Action: TypeAlias = tuple[float, ...]
Backup = Callable[[FloatArray | None], Any]
"""The backup action (actions,) at a state (states,); None when the state is not known."""

# A module attribute, so that tests can replace it.
solve_sqp: Callable[..., tuple[ActionCandidate, str]] = _solve_sqp

_BINDING: Final = 0.02
"""A condition whose residual is at most this share of its scale is reported as active."""


_NAMED: Final = 3
"""Largest number of barriers that a sentence names."""

_NO_WORSE: Final = " Found a moment ago, and no worse now."
_HOW: Final = (
    "Found from another start than the nominal action.",
    "Found by a search around the least-violation sample.",
    "Found among the least-violation actions.",
)
_STARTS: Final = 3
"""Number of feasible actions from which the search for a nearer one starts."""


@final
@dataclass(frozen=True, eq=False)
class FilterContext:
    """The parts of a filter that do not change from tick to tick."""

    settings: FilterSettings
    prediction: Prediction
    program: QuadraticProgram
    maximin_lp: MaxMinProgram
    barrier_sets: BarrierSetCache
    margins: ActiveMargins
    backup: Backup | None
    resting_action: Action
    state_range: Plausible | None
    nominal_range: Plausible
    latent_range: Plausible | None
    clock: Callable[[], float]
    compiled: CompiledDecisions | None = None
    """The compiled search; None: Python decides."""


@final
class FilterInput:
    """The inputs of one tick, all of them untrusted."""

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
        held_solution: Any = None,
        deadline: Any = None,
        evaluations: Any = None,
    ) -> None:
        self.deadline, self.evaluations = deadline, evaluations
        self.state, self.nominal, self.latent, self.memory = state, nominal, latent, memory
        self.barriers, self.epsilon, self.stale, self.time = barriers, epsilon, stale, time
        # A foreign object is replaced instead of refused: it can only save time, never change what is safe.
        self.held_solution = held_solution if isinstance(held_solution, HeldSolution) else HeldSolution()


@final
class Decision:
    """One decision. It keeps what is known so far, so that a failure half way can still report it."""

    def __init__(self, tools: FilterContext, request: FilterInput) -> None:
        self._tools, self._request = tools, request
        self._start = tools.clock()
        stale = checked_names(request.stale)
        # All problems are collected, not only the first: a user who fixes one should not find the next one by another
        # run.
        self._problems = ["stale is no list of names"] if stale is None else [f"{name} is stale" for name in stale]
        self._state = self._checked("state", request.state, tools.state_range)
        # An unreadable ``stale`` may have meant the state, so the state counts as stale too.
        if stale is None or "state" in stale:
            self._state = None
        self._nominal = self._checked("nominal", request.nominal, tools.nominal_range)
        wanted = tools.latent_range
        # A latent without a range is optional: it is checked only if the model needs it or the caller gave one.
        self._needs_latent = wanted is not None and len(wanted.names) > 0
        given = self._needs_latent or request.latent is not None
        self._latent = self._checked("latent", request.latent, wanted) if given else None
        self._seconds = nan
        """Seconds since the start of the run; NaN: not reported."""
        self._report_time(request.time)
        self._margin = 0.0
        self._constraints: Constraints | None = None
        self._budget: DecisionBudget | None = None
        self._names: tuple[str, ...] = ()
        self._held_solution_used = False
        if request.deadline is not None or request.evaluations is not None:
            self._limit(request.deadline, request.evaluations)

    def _limit(self, deadline: Any, evaluations: Any) -> None:
        """Sets the budget; a problem if a limit is no positive number."""
        limits: list[float] = []
        for what, limit in (("deadline", deadline), ("evaluations", evaluations)):
            if limit is not None and not (isinstance(limit, (int, float)) and limit > 0.0):
                self._problems.append(f"{what}: got {limit!r}, wanted a number > 0")
                return
            limits.append(inf if limit is None else float(limit))
        self._budget = DecisionBudget(self._tools.clock, self._start + limits[0], limits[1])

    def _report_time(self, seconds: Any) -> None:
        """Passes the time to the model; a problem if the model depends on time and none was given."""
        prediction = self._tools.prediction
        reported = float(seconds) if isinstance(seconds, (float, int)) else nan
        if 0.0 <= reported < inf:
            self._seconds = reported
            prediction.report_time(self._seconds)
        elif prediction.timed:  # any other model ignores the time
            self._problems.append(
                f"time: got {seconds!r}, wanted the seconds since the start of the run, on which the model depends"
            )

    def run(self) -> Verdict:
        """Returns the verdict. Raises DecisionError, or whatever a user's function raises, if there is none."""
        if self._problems:
            raise DecisionError("; ".join(self._problems))
        assert self._nominal is not None
        compiled = self._by_compiled_search(self._nominal)
        if compiled is not None:
            return compiled
        constraints = self._constraints or self._build_constraints()
        constraints.budget = self._budget
        try:
            return self._decide(constraints)
        except OutOfBudgetError:
            return self._best_in_time(constraints)

    def _by_compiled_search(self, nominal: Action) -> Verdict | None:
        """The same verdict by the compiled search; None: it declines."""
        tools, compiled, state = self._tools, self._tools.compiled, self._state
        whole = self._budget is None and tools.settings.enabled and (self._latent is not None or not self._needs_latent)
        if compiled is None or state is None or not whole:
            return None
        barriers = tools.barrier_sets.get(self._request.barriers, len(state))
        if not barriers.names:
            return None
        epsilon, self._margin = tools.margins.resolve(barriers, self._request.epsilon)
        self._names = barriers.names
        start = self._where_it_acts(state, epsilon)
        found = None if start is None else compiled.decide(barriers, nominal, self._latent, len(state), *start)
        if found is None:
            return None
        if found.kind in (OPEN, BELOW):
            return self._search_further(compiled, found)
        if found.kind == PASSED and self._clip(nominal) == nominal:
            return self._found(Status.passed, found, "", nominal)
        return self._found(Status.corrected, found, OUTSIDE_LIMITS if found.kind == PASSED else "")

    def _search_further(self, compiled: CompiledDecisions, found: Found) -> Verdict | None:
        """The verdict where no feasible action was found from the nominal one, or some h is below 0."""
        held_solution = self._request.held_solution
        if found.kind == OPEN:
            reused = compiled.reused(held_solution, self._seconds)
            self._held_solution_used = True
            if reused is not None and not reused.is_feasible:
                reason = f"{self._names_of(reused.violated)}{held_solution.notice}{_NO_WORSE}"
                return self._found(Status.relaxed, reused.found, reason)
        result = compiled.search(self._backup_action())
        if result is None:
            return None
        if result.candidate is None:
            return self._found(Status.corrected, result.found, _HOW[result.how])
        notice = _uncontrollable_notice([self._names[row % len(self._names)] for row in result.uncontrollable])
        if found.kind == OPEN:
            held_solution.store(result.candidate, self._seconds, notice)
            return self._found(Status.relaxed, result.found, f"{self._names_of(result.violated)}{notice}")
        h_now = compiled.h_now() if self._constraints is None else self._constraints.h_now
        below = ", ".join([name for name, h in zip(self._names, h_now, strict=True) if h < 0.0])
        return self._found(Status.violated, result.found, f"Below 0: {below}.{notice}")

    def _where_it_acts(self, state: Action, epsilon: Sequence[float]) -> tuple[Action, Sequence[float], float] | None:
        """States and margins (rows,) of the constraints, and the smallest h at the measured state if it is another.

        None: the action acts late.
        """
        memory, prediction = self._request.memory, self._tools.prediction
        if not memory or prediction.effect_start(state, self._latent, memory) is None:
            return state, epsilon, nan
        constraints = self._build_constraints()
        start = constraints.start
        return None if start is None else (start, constraints.margins, constraints.min_h_now)

    def _found(self, status: Status, found: Found, reason: str, action: Action | None = None) -> Verdict:
        names = self._names
        # Several rows may belong to one barrier; dict.fromkeys removes repeated names and keeps the order.
        active = tuple(dict.fromkeys([names[row % len(names)] for row in found.active])) if found.active else ()
        taken = found.action if action is None else action
        status, reason, h_next = self._with_in_flight(status, reason, found.h_next)
        return self._answer(status, taken, reason, found.solver, found.slack, active, h_next, found.h_now)

    def _with_in_flight(self, status: Status, reason: str, min_h_next: float) -> tuple[Status, str, float]:
        """The same with what happens while commands are in flight: then h may fall below 0 before an action acts."""
        constraints = self._constraints
        if constraints is None or not constraints.min_h_in_flight < min_h_next:
            return status, reason, min_h_next
        min_h_next = constraints.min_h_in_flight
        # The verdict must not say "passed".
        if min_h_next < 0.0 and status in (Status.passed, Status.corrected):
            status, reason = Status.relaxed, TOO_LATE
        return status, reason, min_h_next

    def _names_of(self, rows: Sequence[int]) -> str:
        names = self._names
        return _not_satisfied(tuple(dict.fromkeys([names[row % len(names)] for row in rows])))

    def _decide(self, constraints: Constraints) -> Verdict:
        """The verdict of a search without a limit of its own."""
        assert self._nominal is not None
        # Equal tuples may still differ in the sign of zero; the nominal action is then passed on bit for bit.
        clipped = self._clip(self._nominal)
        unclipped = clipped == self._nominal
        nominal_candidate = constraints.evaluate(self._nominal if unclipped else clipped)
        # A disabled filter still evaluates h, so that its verdict shows what the nominal action leads to.
        if not self._tools.settings.enabled:
            return self._verdict(Status.disabled, nominal_candidate, "", "not run")
        # Below 0 the condition (1 - eta) h + epsilon may itself be negative: satisfying it would not lead back to
        # safety.
        if constraints.min_h_now < 0.0:
            return self._violated(constraints, nominal_candidate)
        if nominal_candidate.is_feasible:
            if unclipped:
                return self._verdict(Status.passed, nominal_candidate, "", "not needed")
            return self._verdict(Status.corrected, nominal_candidate, OUTSIDE_LIMITS, "not needed")
        return self._correct(constraints, self._nominal, nominal_candidate)

    def _best_in_time(self, constraints: Constraints) -> Verdict:
        """The best candidate of a search that was cut off, or the backup, with the status that is true of it."""
        assert self._nominal is not None
        assert self._budget is not None
        constraints.budget = None
        if not self._tools.settings.enabled:
            return self._verdict(Status.disabled, constraints.evaluate(self._clip(self._nominal)), "", "not run")
        nominal, program, notice = self._nominal, self._tools.program, "The deadline ended the search."
        known = [*self._budget.candidates, constraints.evaluate(self._backup_action())]
        if constraints.min_h_now < 0.0:
            # Already unsafe: raising the smallest h is the aim, as after a complete search.
            best = max(known, key=lambda one: one.min_h_next)
            return self._verdict(Status.violated, best, notice, "out of time")
        feasible = [one for one in known if one.is_feasible]
        if feasible:
            best = min(feasible, key=lambda one: program.distance(one.action, nominal))
            status = Status.passed if best.action == nominal else Status.corrected
            return self._verdict(status, best, notice, "out of time")
        best = max(known, key=constraints.min_scaled_residual)
        return self._verdict(Status.relaxed, best, f"{self._violated_names(constraints, best)} {notice}", "out of time")

    def fallback(self, reason: str, solver: str) -> Verdict:
        """Returns the backup action with what can still be computed about it; raises nothing."""
        action, status = self._backup_action(), Status.fallback
        # A filter that is switched off must not take control because of a failure of its own.
        if self._nominal is not None and not self._tools.settings.enabled:
            action, status = self._clip(self._nominal), Status.disabled
        return self._unchecked(status, action, f"Reason: {reason}.", solver)

    def stopped(self, reason: str) -> Verdict:
        """Returns the backup action because of a stop order, with what can still be computed about it."""
        return self._unchecked(Status.stopped, self._backup_action(), f"Reason: {reason}.", "not run")

    def _unchecked(self, status: Status, action: Action, reason: str, solver: str) -> Verdict:
        try:
            constraints = self._constraints or self._build_constraints()
            return self._verdict(status, constraints.evaluate(action), reason, solver)
        except Exception:  # noqa: BLE001 - the same failure may occur again; then h stays unknown
            return self._answer(status, action, reason, solver)

    def _checked(self, what: str, value: Any, plausible: Plausible | None) -> Action | None:
        checked = checked_input(what, value, plausible)
        if isinstance(checked, InvalidInput):
            self._problems.append(checked.reason)
            return None
        return checked

    def _build_constraints(self) -> Constraints:
        """Builds the CBF constraints at this state. Raises DecisionError if an input that they need is missing."""
        request, settings = self._request, self._tools.settings
        if self._state is None or (self._needs_latent and self._latent is None):
            raise DecisionError("state or latent unusable")
        barriers = self._tools.barrier_sets.get(request.barriers, len(self._state))
        # Without this check every action would be feasible, and a forgotten barrier list would switch the filter off.
        if not barriers.names:
            raise DecisionError("there is no barrier to keep")
        epsilon, self._margin = self._tools.margins.resolve(barriers, request.epsilon)
        self._constraints = Constraints(
            barriers,
            self._tools.prediction,
            self._state,
            self._latent,
            request.memory,
            settings.eta,
            epsilon,
            self._tools.program.sides,
        )
        return self._constraints

    def _correct(self, constraints: Constraints, nominal: Action, nominal_candidate: ActionCandidate) -> Verdict:
        program, rounds = self._tools.program, self._tools.settings.relinearisations + 1
        found, solver = solve_sqp(constraints, program, nominal, nominal_candidate, rounds)
        if found.is_feasible:
            return self._finish_feasible(constraints, nominal, found, "", solver)
        # The remaining steps take some seventy evaluations; within 0.05 s of the last full search its result is reused.
        held_solution = self._request.held_solution
        reused = None
        if not self._held_solution_used:
            reused = held_solution.reuse_if_no_worse(constraints, program.sides, self._seconds)
        # A reused action that has become feasible must not be returned: the nearest feasible one is then found below.
        if reused is not None and not reused.is_feasible:
            names = self._violated_names(constraints, reused)
            notice = f"{names}{held_solution.notice}{_NO_WORSE}"
            return self._verdict(Status.relaxed, reused, notice, solver)
        backup = constraints.evaluate(self._backup_action())
        grid = self._evaluate_grid(constraints)
        # The SQP may fail although a feasible action exists: the tangent at the nominal action can point the wrong way.
        other, solver = self._restart_from(constraints, nominal, nominal_candidate, [backup, *grid])
        if other.is_feasible:
            return self._finish_feasible(constraints, nominal, other, _HOW[0], solver)
        nearby = self._coordinate_search(constraints, [backup, found, other, *grid])
        # One or two actions have an exact program, which uses no slack where none is needed.
        if not nearby.is_feasible and len(program.sides) > 2:
            nearby = most_feasible(constraints, program.sides, self._tools.maximin_lp, nearby)
        # A feasible action found by sampling is feasible, not nearest: the SQP restarts from it.
        if nearby.is_feasible:
            other, solver = self._restart_from(constraints, nominal, nominal_candidate, [nearby])
            return self._finish_feasible(constraints, nominal, other, _HOW[1], solver)
        best, notice = self._least_violation(constraints, backup, [nominal_candidate, found, other, nearby, *grid])
        if best.is_feasible:
            other, solver = self._restart_from(constraints, nominal, nominal_candidate, [best])
            return self._finish_feasible(constraints, nominal, other, _HOW[2], solver)
        held_solution.store(best, self._seconds, notice)
        return self._verdict(Status.relaxed, best, f"{self._violated_names(constraints, best)}{notice}", solver)

    def _finish_feasible(
        self, constraints: Constraints, nominal: Action, found: ActionCandidate, reason: str, solver: str
    ) -> Verdict:
        """Returns ``corrected`` after moving each entry back to the nominal action as far as the constraints allow."""
        program = self._tools.program
        back = backtrack_towards(constraints, program.sides, nominal, found)
        if back is not found:
            # One more program from there: the other entries may now come nearer as well.
            again, _ = solve_sqp(constraints, program, nominal, back, 1)
            nearer = again.is_feasible and program.distance(again.action, nominal) < program.distance(
                back.action, nominal
            )
            found = again if nearer else back
        return self._verdict(Status.corrected, found, reason, solver)

    def _restart_from(
        self,
        constraints: Constraints,
        nominal: Action,
        nominal_candidate: ActionCandidate,
        known: Sequence[ActionCandidate],
    ) -> tuple[ActionCandidate, str]:
        """The feasible action nearest to the nominal one, result from the nearest feasible of ``known``.

        If none of ``known`` is feasible, the search starts at the one with the largest scaled residual.
        """
        program, rounds = self._tools.program, self._tools.settings.relinearisations + 1
        feasible = sorted(
            [one for one in known if one.is_feasible], key=lambda one: program.distance(one.action, nominal)
        )
        if not feasible:
            return solve_sqp(constraints, program, nominal, max(known, key=constraints.min_scaled_residual), rounds)
        best, status = feasible[0], "not needed"
        for start in feasible[:_STARTS]:
            # The search starts at the boundary: a tangent drawn deep inside says little about where the boundary is.
            nearer = line_search(constraints, nominal_candidate, start)
            found, solver = solve_sqp(constraints, program, nominal, nearer, rounds)
            for one in (nearer, found):
                if one.is_feasible and program.distance(one.action, nominal) < program.distance(best.action, nominal):
                    best, status = one, solver
        return best, status

    def _coordinate_search(self, constraints: Constraints, known: Sequence[ActionCandidate]) -> ActionCandidate:
        """Moves the best of ``known`` one action entry at a time, by ever smaller steps; returns the best found.

        It needs no gradient: at a kink of h, such as zero speed, a tangent says nothing about the other side.
        """
        sides = self._tools.program.sides
        best = max([one for one in known if one.is_finite] or known, key=constraints.min_scaled_residual)
        most = constraints.min_scaled_residual(best)
        for share in STEP_SHARES:
            if best.is_feasible:
                break
            for tried in [constraints.evaluate(one) for one in grid_around(sides, best.action, share)]:
                if tried.is_finite and constraints.min_scaled_residual(tried) > most:
                    best, most = tried, constraints.min_scaled_residual(tried)
        if best.is_feasible:
            return best
        # Two rounds from the sample: coordinate steps alone stop short of a corner of two constraints.
        found, _ = solve_sqp(constraints, self._tools.program, best.action, best, 2)
        return found

    def _violated(self, constraints: Constraints, nominal_candidate: ActionCandidate) -> Verdict:
        backup = constraints.evaluate(self._backup_action())
        best, notice = self._least_violation(
            constraints, backup, [nominal_candidate, *self._evaluate_grid(constraints)]
        )
        names, h_now = constraints.barriers.names, constraints.h_now
        below = ", ".join([names[row] for row in range(len(names)) if h_now[row] < 0.0])
        return self._verdict(Status.violated, best, f"Below 0: {below}.{notice}", "solved")

    def _evaluate_grid(self, constraints: Constraints) -> list[ActionCandidate]:
        tools = self._tools
        return [constraints.evaluate(one) for one in action_grid(tools.program.sides, affine=tools.prediction.affine)]

    def _least_violation(
        self, constraints: Constraints, backup: ActionCandidate, known: list[ActionCandidate]
    ) -> tuple[ActionCandidate, str]:
        """The least-violation action, and a sentence about barriers that no action can influence."""
        assert self._nominal is not None
        tools = self._tools
        best, uncontrollable = least_violation(
            constraints, tools.program, tools.maximin_lp, self._nominal, backup, known
        )
        return best, _uncontrollable_notice(uncontrollable)

    def _violated_names(self, constraints: Constraints, best: ActionCandidate) -> str:
        """A sentence with the constraints that the action violates."""
        return _not_satisfied(constraints.active_names(best, 0.0))

    def _backup_action(self) -> Action:
        """The user's backup clipped to the bounds; the resting action if there is none or it fails."""
        if self._tools.backup is None:
            return self._tools.resting_action
        try:
            # A copy: the user's function may write into the state that it gets.
            state = None if self._state is None else np.array(self._state)
            action = checked_output("backup", self._tools.backup(state))
        except Exception:  # noqa: BLE001 - the last resort must not depend on a user's function
            return self._tools.resting_action
        if action.shape != (len(self._tools.resting_action),) or not np.isfinite(action).all():
            return self._tools.resting_action
        return self._clip(tuple(action.tolist()))

    def _clip(self, action: Action) -> Action:
        return clip_to_bounds(action, self._tools.program.sides)

    def _verdict(self, status: Status, candidate: ActionCandidate, reason: str, solver: str) -> Verdict:
        # Without finite predictions the verdict reports h as unknown instead of as infinite.
        if not candidate.is_finite:
            return self._answer(status, candidate.action, reason, solver)
        constraints = self._constraints
        active = () if constraints is None else constraints.active_names(candidate, _BINDING)
        status, reason, min_h_next = self._with_in_flight(status, reason, candidate.min_h_next)
        return self._answer(status, candidate.action, reason, solver, candidate.violation, active, min_h_next)

    def _answer(
        self,
        status: Status,
        action: Sequence[float],
        reason: str,
        solver: str,
        slack: float = 0.0,
        active: tuple[str, ...] = (),
        h_next: float | None = None,
        h_now: float | None = None,
    ) -> Verdict:
        # Read-only, so that no consumer of the verdict can change the action that the log and the robot share.
        taken = np.array(action)
        taken.setflags(write=False)
        if h_now is None and self._constraints is not None:
            h_now = self._constraints.min_h_now
        if h_now is not None and self._tools.margins.remark:
            reason = f"{reason} {self._tools.margins.remark}".strip()
        return Verdict.of(
            {
                "action": taken,
                "status": status,
                "reason": reason,
                "slack": slack,
                "active": active,
                "h_now": 0.0 if h_now is None else h_now,
                "h_next": 0.0 if h_next is None else h_next,
                "margin": self._margin,
                "solver": solver,
                "microseconds": 1e6 * (self._tools.clock() - self._start),
                "nominal": None if self._nominal is None else np.array(self._nominal),
                "known": h_now is not None and h_next is not None,
            }
        )


def _not_satisfied(names: Sequence[str]) -> str:
    return f"Not satisfied: {', '.join(names[:_NAMED])}{', ...' if len(names) > _NAMED else ''}."


def _uncontrollable_notice(names: Sequence[str]) -> str:
    """A sentence about barriers that no action can influence."""
    if not names:
        return ""
    listed = ", ".join(names[:_NAMED])
    return f" No action changes {listed} within one step: the backup is used as the nominal action."
