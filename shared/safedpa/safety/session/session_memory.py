"""What a session keeps of one robot between ticks: commands, actuators, margin, delay and standstill.

Each tick has three parts: ``sync_actuators`` and ``watch_margin`` with the measured state, the decision, and
``predict_states`` and ``watch_deadlock`` after the action was sent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from math import isfinite
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.recorded_step import rollout_held_action
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrierSet, Barriers
from safedpa.safety.deadlock.detector import DeadlockDetector, position_entries
from safedpa.safety.deadlock.escape import DeadlockEscape, TickContext
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.margins.online import OnlineMarginMonitor
from safedpa.safety.prediction.command_history import LONGEST_AGE, CommandHistory, DelayedPrediction
from safedpa.safety.prediction.delay_estimator import MAX_DELAY, DelayEstimator
from safedpa.safety.session.measurement import MeasuredState
from safedpa.safety.solver.candidates import HeldSolution
from safedpa.safety.verdict import Status, Verdict

__all__ = ["NO_BARRIERS", "LastDecision", "SessionMemory", "is_too_old"]

Rows = tuple[tuple[float, ...], ...]
StateT = TypeVar("StateT", bound=MeasuredState)

_PATH_STEPS: Final = 8
"""Predicted states in a verdict with the whole path, which is for display."""
_PATH_EVERY: Final = 4
"""Ticks between two such verdicts: saves 10 % of a fleet's CPU time. The first predicted state is computed always."""
NO_BARRIERS: Final = Barriers(())


class LastDecision(NamedTuple, Generic[StateT]):
    """The last decision with the state and latent that it was based on."""

    state: StateT
    latent: FloatArray | None
    verdict: Verdict


def is_too_old(state: MeasuredState) -> bool:
    """Whether the action of a state would act too long after it, or before it."""
    return not 0.0 <= state.until_action <= LONGEST_AGE


class SessionMemory(Generic[StateT]):
    """Data of one robot between ticks, for as long as its model stays the same."""

    can_stop: bool = True
    """Whether the backup action brings the robot to rest."""
    quick: bool = False
    """Whether h is cheap enough to evaluate at hundreds of states per tick."""

    def __init__(self, model: PhysicsModel, safe: SafetyFilter, margin: OnlineMarginMonitor) -> None:
        self.model, self.filter, self.margin = model, safe, margin
        self.history = CommandHistory(model)
        self.tick = -1
        self.barriers: AbstractBarrierSet | str = NO_BARRIERS
        """Barriers of the current scene, or a description of what is wrong with it."""
        self.decision: LastDecision[StateT] | None = None
        self.memory: Any = None
        """Internal state of the actuators in the model."""
        self.former: CommandHistory | None = None
        """Commands sent under the previous model; None once they are taken over."""
        self.pending: Any = ()
        """Commands in flight; empty if actions act immediately."""
        self.expected_memory: Any = None
        """``memory`` predicted one period later, if the robot applies the action."""
        ranges = (safe.settings.high - safe.settings.low).tolist()
        self.delay = DelayEstimator(safe.tools.prediction, ranges, model.period)
        """Estimates the delay of commands beyond the reported one."""
        self.until_action = 0.0
        """Time in s from the newest state until its action acts: the larger of the reported and the estimated one."""
        self._reported_delay = 0.0
        self._follows = True
        """Whether the newest state was measured about one period after the one before."""
        self.possible_delays: tuple[float, ...] = ()
        """Other delays in s that are not ruled out, under which the constraints are imposed as well."""
        self.deadlock_detector = DeadlockDetector(position_entries(model.system))
        """Detects how long the robot has been stationary, and whether an action failed to move it."""
        self.escape = DeadlockEscape(safe.settings, safe.tools.program)
        self.held_solution = HeldSolution()
        """Result of the last complete search for the least-violation action, for periods too short to search every
        tick."""
        self._resting: list[float] = safe.settings.resting_action.tolist()
        """(actions,) the nominal action that requests no motion."""

    @property
    def speeds(self) -> tuple[int, ...]:
        """Indices of the speeds in the state, which are 0 once the robot has stopped; empty if it cannot stop."""
        if not self.can_stop:
            return ()
        return tuple(index for index, variable in enumerate(self.model.system.state) if variable.unit == "m/s")

    @property
    def delayed(self) -> str:
        """Why a robot that can stop has to: commands act later than any delay that is allowed for; else empty."""
        return self.delay.too_long(self._reported_delay) if self.speeds else ""

    def is_same_scene(self, state: StateT) -> bool:
        """Whether the barriers around ``state`` are those of the last decision."""
        del state
        return self.decision is not None

    def watch_margin(self, state: StateT) -> None:
        """Compares the last prediction with the measured state, and lets a new model's margin rise."""
        # The prediction is for the filter's own action over one tick; anything else says nothing about the model.
        if state.tick != self.tick + 1 or state.applied_by != "filter" or not self._follows:
            self.margin.expect(None)
        self.tick = state.tick
        barriers = NO_BARRIERS if isinstance(self.barriers, str) else self.barriers
        late, others = None, list[DelayedPrediction]()
        if self.pending and state.applied_by == "filter":
            late = self._delayed_prediction(self.until_action)
            possible = [self._delayed_prediction(delay) for delay in self.possible_delays]
            others = [prediction for prediction in possible if prediction is not None]
        same = self.is_same_scene(state)
        self.margin.observe(state.values, barriers, same_scene=same, late=late, others=others)
        if barriers.names:
            self.margin.rise(state.values, barriers, state.period)

    def _delayed_prediction(self, delay: float) -> DelayedPrediction | None:
        with suppress(InputError, ValueError, ArithmeticError):  # an invalid latent; the decision reports it
            return self.history.delayed_prediction(delay)
        return None

    def predict_states(self, state: StateT, verdict: Verdict, latent: FloatArray | None) -> Rows:
        """Predicts as ``predicted`` does, and stores the result for comparison in the next tick."""
        self.model.clock.seconds = state.robot_time  # robots of one model share its clock
        try:
            predicted, self.expected_memory = self.predicted(state, verdict, latent)
        except (InputError, ValueError, ArithmeticError):  # no prediction for these values
            predicted, self.expected_memory = (), None
        self._watch_delay(state, latent)
        if self.pending:
            self.history.mark_decided(None if latent is None else tuple(latent.tolist()))
        barriers = None if isinstance(self.barriers, str) else self.barriers
        self.margin.expect(predicted[0] if predicted else None, barriers)
        return predicted

    def _watch_delay(self, state: StateT, latent: FloatArray | None) -> None:
        passed = self.history.last_transition(MAX_DELAY) if state.applied_by == "filter" else None
        if passed is None:
            return
        stationary, known = passed.is_stationary(self.speeds), None if latent is None else tuple(latent.tolist())
        with suppress(InputError, ValueError, ArithmeticError):  # no prediction for these values: nothing to learn
            self.delay.observe(passed, known, stationary=stationary)

    def sync_actuators(self, state: StateT) -> None:
        """Updates the actuators' internal state: as predicted if the robot applied the action, else reconstructed."""
        if len(state.applied) != len(self.model.system.action):
            return  # the filter rejects such a state itself
        model, reported, expected = self.model, self.decision, self.expected_memory
        follows = reported is not None and (state.epoch, state.tick) == (reported.state.epoch, reported.state.tick + 1)
        if follows and expected is not None and state.applied_by == "filter":
            self.memory = expected
        elif follows and self.memory:
            # The watchdog chose the action, but the commands sent before are still in flight.
            self.memory = model.felt(state.applied, self.memory, period=state.period)[1]
        else:
            # The first state, or a gap: replay the known commands, or assume that the applied action was held for long.
            before = None if self.former is None else self.former.commands(state.tick, state.applied)
            oldest, *sent = before or (state.applied,)
            self.memory = model.initial_memory(np.array(oldest))
            for command in sent if self.memory else ():
                self.memory = model.felt(command, self.memory, period=state.period)[1]
        self.former = None
        self._follows = self.history.is_next(state.robot_time)
        self.history.add(state.tick, state.values, state.applied, self.memory, state.robot_time)
        self.until_action = min(self.delay.delay_to_compensate(state.until_action), LONGEST_AGE)
        # A robot that cannot stop could not keep its promise under every possible delay.
        self._reported_delay = state.until_action
        self.possible_delays = self.delay.possible_delays(state.until_action) if self.speeds else ()
        late = (self.memory or self.until_action > 0.0 or self.possible_delays) and not is_too_old(state)
        self.pending = self.history.pending(self.until_action, self.possible_delays) if late else ()

    def predicted(self, state: StateT, verdict: Verdict, latent: FloatArray | None) -> tuple[Rows, Any]:
        """Predicts the next states (steps, states) with the action held, and the actuators' state after one step.

        Most ticks predict one step, every fourth one the whole path.
        """
        model, steps = self.model, _PATH_STEPS if state.tick % _PATH_EVERY == 0 else 1
        # Without memory the robot has not reported an applied action yet.
        if len(state.values) != len(model.system.state) or self.memory is None:
            return (), None
        if self.pending and self.pending.queue:
            known, action = None if latent is None else tuple(latent.tolist()), tuple(verdict.action.tolist())
            ahead = self.history.predict(action, known, self.pending, steps)
            after = model.felt(action, self.memory, known, period=state.period)[1] if self.memory else self.memory
            return (tuple(map(tuple, ahead)), after) if np.isfinite(ahead).all() else ((), None)
        return self._rollout(state, verdict.action, latent, steps)

    def watch_deadlock(self, state: StateT, predicted: Rows) -> None:
        """Gives the deadlock detector the predictions under the nominal action and under the sent action."""
        assert self.decision is not None
        _, latent, verdict = self.decision
        nominal, nominal_next = verdict.nominal, predicted[:1]
        if verdict.status is Status.stopped or (nominal is not None and not predicted):
            self.deadlock_detector.interrupt()
            return
        if nominal is None:  # nothing to compare in this tick
            return
        if verdict.status not in (Status.passed, Status.disabled):
            nominal_next = self._next(
                state, np.clip(nominal, self.filter.settings.low, self.filter.settings.high), latent
            )
        if not nominal_next or nominal.tolist() == self._resting:
            self.deadlock_detector.interrupt()
        else:
            self.deadlock_detector.expect(state.values, nominal_next[0], predicted[0])

    def rest_in_dead_band(
        self, state: StateT, verdict: Verdict, latent: FloatArray | None, rest: Callable[[], Verdict]
    ) -> Verdict:
        """Replaces a correction inside the actuators' dead band by the resting action, if that is safe.

        ``rest`` decides about the resting action.
        """
        # An action that does not move the robot would make the adaptation estimate a wrong load.
        if verdict.status is not Status.corrected or self.deadlock_detector.failed_displacement == 0.0:
            return verdict
        predicted = self._next(state, verdict.action, latent)
        if not predicted or not self.deadlock_detector.is_inside_dead_band(
            self.deadlock_detector.displacement(state.values, predicted[0])
        ):
            return verdict
        resting = rest()
        if resting.status is not Status.passed:
            return verdict
        notice = "The correction was in the dead band, in which the robot did not move before: it rests instead."
        return replace(resting, status=Status.corrected, nominal=verdict.nominal, active=verdict.active, reason=notice)

    def escape_boundary_layer(self, state: StateT, verdict: Verdict, latent: FloatArray | None) -> Verdict:
        """Replaces the action by one that leads out of the boundary layer if no action satisfies every condition.

        See ``DeadlockEscape``. Evaluates from the state at which the action begins to act. Does nothing if an action
        acts over more than one period, because the next ticks then do not show its effect.
        """
        barriers, known = self.barriers, None if latent is None else tuple(latent.tolist())
        prediction, values = self.filter.tools.prediction, tuple(state.values)
        wanted = verdict.nominal is not None and self.escape.may_replace(verdict.status)
        wanted = wanted and not state.sources  # a manoeuvre of seconds assumes that nothing around moves
        # From where the action acts by the estimate: other delays that are possible limit the speed, not the escape.
        flying = self.pending._replace(alternatives=()) if self.pending else self.pending
        begin = None if isinstance(barriers, str) or not wanted else prediction.effect_start(values, known, flying)
        if isinstance(barriers, str) or not wanted or not (begin is None or begin.at_once):
            self.escape.reset()
            return verdict
        path: Rows = ()
        memory = self.memory
        if begin is not None:
            values, path, memory = begin.state_at_effect, begin.path, begin.memory

        def ahead(action: Sequence[float]) -> Iterator[list[float]]:
            reached: Sequence[float] = values
            with suppress(InputError, ValueError, ArithmeticError):  # ends the rollout at values without a prediction
                while isfinite(sum(reached := prediction.next_state_floats(tuple(reached), action, known, memory))):
                    yield barriers.h_floats(reached)

        def fails(action: Sequence[float]) -> bool:
            predicted = self._next(state, np.array(action), latent)
            return not predicted or self.deadlock_detector.is_inside_dead_band(
                self.deadlock_detector.displacement(values, predicted[0])
            )

        margins = barriers.per_row(self.margin.epsilon, 0.0)
        context = TickContext(state.tick, state.period, barriers.h_floats(values), margins, ahead, fails)
        found = self.escape.replace_verdict(verdict, context, self.deadlock_detector.seconds if self.quick else 0.0)
        if found is verdict or not path:
            return found
        lowest = min(min(barriers.h_floats(passed)) for passed in path)  # already determined by commands in flight
        return replace(found, h_next=min(found.h_next, lowest))

    def _next(self, state: StateT, action: FloatArray, latent: FloatArray | None) -> Rows:
        """Predicts one state under an action; empty if that is not possible."""
        known = len(state.values) == len(self.model.system.state)
        return self._rollout(state, action, latent, 1)[0] if known else ()

    def _rollout(self, state: StateT, action: FloatArray, latent: FloatArray | None, steps: int) -> tuple[Rows, Any]:
        model, free = self.model, self.model.latent if latent is None else latent
        step = model.scalar_step(state.period)
        if step is not None and (
            rows := rollout_held_action(step, state.values, action, free, state.robot_time, state.period, steps)
        ):
            return rows, self.memory
        values = np.array(state.values)
        found, memory = model.rollout_held(values, action, self.memory, latent, steps, period=state.period)
        return (tuple(map(tuple, found)), memory) if np.isfinite(found).all() else ((), None)

    def stationary_reason(self, verdict: Verdict) -> str:
        """Returns why the robot is stationary, once it has been for long; empty before."""
        eta = self.filter.settings.eta
        return self.deadlock_detector.reason(verdict.status.value, verdict.active, eta * verdict.h_now < verdict.margin)
