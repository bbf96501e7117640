"""The safety filter's session with one robot: everything it keeps between ticks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import LATENT, Inputs, LatentMessage, Stale, StateMessage, SurroundingsMessage
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.recorded_step import rollout_held_action
from safedpa.errors import InputError
from safedpa.runtime.calibrated_model import CalibratedModel
from safedpa.runtime.scene import AbstractScene, propagate_obstacles, scene_of
from safedpa.safety.barriers.base import AbstractBarrierSet, Barriers
from safedpa.safety.deadlock.detector import DeadlockDetector, position_entries
from safedpa.safety.deadlock.escape import DeadlockEscape, TickContext
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.margins.error_clipping import ErrorClip
from safedpa.safety.margins.online import OnlineMarginMonitor
from safedpa.safety.margins.transition import MarginRamp
from safedpa.safety.prediction.command_history import LONGEST_AGE, CommandHistory
from safedpa.safety.prediction.delay_estimator import MAX_DELAY, DelayEstimator
from safedpa.safety.settings import FilterSettings
from safedpa.safety.solver.candidates import HeldSolution
from safedpa.safety.validation import InvalidInput, checked_input
from safedpa.safety.verdict import Status, Verdict

Rows = tuple[tuple[float, ...], ...]

# s for which the last latent replaces a missing one. A load does not change unnoticed within a second.
_LATENT_TIMEOUT = 1.0
# Number of predicted states in a verdict, and the ticks between verdicts with all of them. The path is for display;
# sending it only every fourth tick saves 10 % of a fleet's CPU time. The first predicted state, which the margin
# monitor needs, is computed every tick.
_PATH_STEPS, _PATH_EVERY = 8, 4
NO_BARRIERS = Barriers(())
# Accepted age of a source's newest scan in s, whatever perception allows: from a rounding error to the time-out of a
# latent.
_EARLY, _OLD = -1e-6, 1.0


class LastDecision(NamedTuple):
    """The last decision with the state and latent that it was based on."""

    state: StateMessage
    latent: FloatArray | None
    verdict: Verdict


def state_too_old(state: StateMessage) -> list[str]:
    """Describes the problem of a state whose action would act too long after it; empty if there is none."""
    if 0.0 <= state.until_action <= LONGEST_AGE:
        return []
    return [f"the state (its action acts {state.until_action:g} s later, wanted 0 to {LONGEST_AGE:g} s)"]


def _same_scene(one: StateMessage, other: StateMessage) -> bool:
    return not (one.sources or other.sources) and (
        (one.obstacles, one.field, one.footprint, one.corridor, one.towed)
        == (other.obstacles, other.field, other.footprint, other.corridor, other.towed)
    )


@dataclass
class RobotSession:
    """Data of one robot between ticks, for as long as its model stays the same."""

    held: CalibratedModel
    model: PhysicsModel
    """The model of ``held`` with the robot's own period."""
    filter: SafetyFilter
    scene: AbstractScene
    margin: OnlineMarginMonitor
    history: CommandHistory
    tick: int = -1
    changed_at: int = -1
    """First tick at which another model is active; -1: none."""
    prepared: tuple[int, int] = (0, -1)
    """Epoch and tick of the state that the fields below belong to."""
    barriers: AbstractBarrierSet | str = NO_BARRIERS
    """Barriers of the current scene, or a description of what is wrong with it."""
    latent: LatentMessage | None = None
    decision: LastDecision | None = None
    ordered: str = ""
    """Reason of the stop order at the last decision."""
    memory: Any = None
    """Internal state of the actuators in the model."""
    former: CommandHistory | None = None
    """Commands sent under the previous model; None once they are taken over."""
    pending: Any = ()
    """Commands in flight; empty if actions act immediately."""
    expected_memory: Any = None
    """``memory`` predicted one period later, if the robot applies the action."""
    delay: DelayEstimator = field(init=False)
    """Estimates the delay of commands beyond the reported one."""
    until_action: float = 0.0
    """Time in s from the newest state until its action acts: the larger of the reported and the estimated one."""
    deadlock_detector: DeadlockDetector = field(init=False)
    """Detects how long the robot has been stationary, and whether an action failed to move it."""
    sensed: tuple[int, frozenset[str]] = (-1, frozenset())
    """Epoch, and all sources named by its states."""
    escape: DeadlockEscape = field(init=False)
    _resting: list[float] = field(init=False)
    """(actions,) the nominal action that requests no motion."""
    held_solution: HeldSolution = field(default_factory=HeldSolution)
    """Result of the last complete search for the least-violation action, for periods too short to search every tick."""
    rehearsed: bool = False
    """Whether the fallback path was warmed up with this model."""

    def __post_init__(self) -> None:
        self.deadlock_detector = DeadlockDetector(position_entries(self.model.system))
        self.escape = DeadlockEscape(self.filter.settings, self.filter.tools.program)
        self._resting = self.filter.settings.resting_action.tolist()
        ranges = (self.filter.settings.high - self.filter.settings.low).tolist()
        self.delay = DelayEstimator(self.filter.tools.prediction, ranges, self.model.period)

    @classmethod
    def create(
        cls,
        held: CalibratedModel,
        settings: FilterSettings,
        before: Mapping[str, float] | None = None,
        period: float | None = None,
    ) -> RobotSession:
        """Creates the session of a robot that is new, or that changes its model.

        ``before`` is the margin under the previous model, from which the margin changes gradually. ``period`` is the
        robot's period [s], over which the model predicts. Raises InputError if the settings are another robot's or
        there are no barriers for this one.
        """
        model = held.model if period is None else held.model.with_period(period)
        scene = scene_of(model, settings)
        filtering = SafetyFilter.for_model(model, settings, backup=scene.backup)
        calibration, longer = held.margin_over(model.period, settings)
        phased = None if before is None else MarginRamp(before, calibration.epsilon, settings.eta)
        margin = OnlineMarginMonitor(calibration, ErrorClip.of_settings(settings), phased, longer)
        return cls(held, model, filtering, scene, margin, CommandHistory(model))

    @property
    def speeds(self) -> tuple[int, ...]:
        """Indices of the speeds in the state, which are 0 once the robot has stopped; empty if it cannot stop."""
        if not self.scene.can_stop:
            return ()
        return tuple(index for index, variable in enumerate(self.model.system.state) if variable.unit == "m/s")

    def observe_state(self, state: StateMessage) -> None:
        """Updates the session from a state, before the other inputs of the tick are known."""
        self.model.clock.seconds = state.robot_time
        self.sync_actuators(state)
        self.scene.follow(state)
        lost = self._lost(state)
        if state.sources or lost:
            self.barriers = lost or "surroundings (none has arrived)"
        else:
            self.barriers = self.scene.of(state)
        if not state.sources:
            self.watch_margin(state)
        self.deadlock_detector.update(state.values, state.period)
        self.prepared = (state.epoch, state.tick)

    def observe_surroundings(self, state: StateMessage, seen: SurroundingsMessage | Stale) -> None:
        """Updates the barriers of a robot with sensors from perception; on any problem the backup acts."""
        # Never falls back to older surroundings: something may have moved that no current message shows.
        old = [age for age in seen.ages if not _EARLY <= age <= _OLD] if isinstance(seen, SurroundingsMessage) else []
        if lost := self._lost(state):
            self.barriers = lost
        elif isinstance(seen, Stale):
            self.barriers = f"surroundings ({seen.sentence})"
        elif seen.problems:
            self.barriers = f"surroundings ({'; '.join(seen.problems)})"
        elif len(seen.ages) != len(state.sources):
            self.barriers = f"surroundings (got the ages of {len(seen.ages)} sources, wanted {len(state.sources)})"
        elif (seen.epoch, seen.tick) != (state.epoch, state.tick):
            self.barriers = f"surroundings (of tick {seen.tick} of another moment, wanted tick {state.tick})"
        elif old:
            self.barriers = f"surroundings (a source is {old[0]:.2f} s old, wanted 0 to {_OLD:g} s)"
        else:
            self._look_around(state, seen)
            return
        self.watch_margin(state)

    def _look_around(self, state: StateMessage, seen: SurroundingsMessage) -> None:
        """Builds the barriers from perception."""
        late, before = self.until_action + self._dead_time(), self.margin.epsilon
        ahead = propagate_obstacles(seen, late)
        self.barriers = self.scene.around(state, ahead, before, late)
        self.watch_margin(state)
        # This state may have widened the margin, by any factor after several misses. Barriers that were left out as too
        # far away may then matter, so they are built again.
        now = self.margin.epsilon
        if any(now[kind] > before.get(kind, 0.0) for kind in now):
            self.barriers = self.scene.around(state, ahead, now, late)

    def _dead_time(self) -> float:
        """Returns the model's dead time [s] of an action after it is applied, with the last latent."""
        known = None if self.latent is None else self.latent.values
        try:
            return self.filter.tools.prediction.dead_time(known)
        except (InputError, ValueError, ArithmeticError):  # an invalid latent; the decision reports it
            return 0.0

    def _lost(self, state: StateMessage) -> str:
        """Describes sources that earlier states of this epoch named and this one does not; empty without any."""
        # Obstacles seen by a sensor remain there when the robot stops naming it.
        epoch, named = self.sensed
        gone = named - set(state.sources) if epoch == state.epoch else frozenset()
        self.sensed = state.epoch, frozenset(state.sources) | gone
        return f"surroundings (the sources {', '.join(sorted(gone))} are no longer named)" if gone else ""

    def watch_margin(self, state: StateMessage) -> None:
        """Compares the last prediction with the measured state, and lets a new model's margin rise."""
        # The prediction is for the filter's own action over one tick; anything else says nothing about the model.
        if state.tick != self.tick + 1 or state.applied_by != "filter":
            self.margin.expect(None)
        self.tick = state.tick
        barriers = NO_BARRIERS if isinstance(self.barriers, str) else self.barriers
        last = None if self.decision is None else self.decision.state
        same = last is not None and _same_scene(last, state)
        late = (
            self.history.delayed_prediction(self.until_action)
            if self.pending and state.applied_by == "filter"
            else None
        )
        self.margin.observe(state.values, barriers, same_scene=same, late=late)
        if barriers.names:
            self.margin.rise(state.values, barriers, state.period)

    def predict_states(self, state: StateMessage, verdict: Verdict, latent: FloatArray | None) -> Rows:
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

    def _watch_delay(self, state: StateMessage, latent: FloatArray | None) -> None:
        passed = self.history.last_transition(MAX_DELAY) if state.applied_by == "filter" else None
        if passed is None or (state.sources and passed.is_stationary(self.speeds)):
            return
        with suppress(InputError, ValueError, ArithmeticError):  # no prediction for these values: nothing to learn
            self.delay.observe(passed, None if latent is None else tuple(latent.tolist()))

    def may_use_previous_model(self, state: StateMessage) -> bool:
        """Whether this model may still decide although another one is active, until a latent of that one arrives."""
        return self.changed_at >= 0 and 0.0 <= (state.tick - self.changed_at) * state.period <= _LATENT_TIMEOUT

    def usable_latent(self, state: StateMessage, inputs: Inputs) -> tuple[FloatArray | None, list[str]]:
        """Returns the latent to use, and a list of problems."""
        message, own = inputs[LATENT], self.held.fingerprint
        if isinstance(message, LatentMessage):
            if message.model != own:
                return None, [f"the latent (of model {message.model}, the filter has {own})"]
            self.latent = message
        known = self.latent
        timeout = _LATENT_TIMEOUT + 0.5 * state.period
        if known is None or known.epoch != state.epoch or (state.tick - known.tick) * state.period > timeout:
            return None, ["the latent (none of the last second has arrived)"]
        latent = np.array(known.values)
        if not isinstance(checked_input("latent", latent, self.filter.tools.latent_range), InvalidInput):
            self.scene.learn(latent)  # the backup must not use a latent that the filter rejects
        return latent, []

    def inherit_from(self, former: RobotSession | None) -> None:
        """Takes over what does not depend on the model: commands sent, named sources, and the scene's odometry."""
        self.former = None if former is None else former.history
        if former is not None:
            self.sensed = former.sensed
            self.scene.remember(former.scene)

    def sync_actuators(self, state: StateMessage) -> None:
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
        self.history.add(state.tick, state.values, state.applied, self.memory)
        self.until_action = min(self.delay.delay_to_compensate(state.until_action), LONGEST_AGE)
        late = (self.memory or self.until_action > 0.0) and not state_too_old(state)
        self.pending = self.history.pending(self.until_action) if late else ()

    def predicted(self, state: StateMessage, verdict: Verdict, latent: FloatArray | None) -> tuple[Rows, Any]:
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

    def watch_deadlock(self, state: StateMessage, predicted: Rows) -> None:
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
        self, state: StateMessage, verdict: Verdict, latent: FloatArray | None, rest: Callable[[], Verdict]
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

    def escape_boundary_layer(self, state: StateMessage, verdict: Verdict, latent: FloatArray | None) -> Verdict:
        """Replaces the action by one that leads out of the boundary layer if no action satisfies every condition.

        See ``DeadlockEscape``. Evaluates from the state at which the action begins to act. Does nothing if an action
        acts over more than one period, because the next ticks then do not show its effect.
        """
        barriers, known = self.barriers, None if latent is None else tuple(latent.tolist())
        prediction, values = self.filter.tools.prediction, tuple(state.values)
        wanted = verdict.nominal is not None and self.escape.may_replace(verdict.status)
        wanted = wanted and not state.sources  # a manoeuvre of seconds assumes that nothing around moves
        begin = (
            None if isinstance(barriers, str) or not wanted else prediction.effect_start(values, known, self.pending)
        )
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
        found = self.escape.replace_verdict(
            verdict, context, self.deadlock_detector.seconds if self.scene.quick else 0.0
        )
        if found is verdict or not path:
            return found
        lowest = min(min(barriers.h_floats(passed)) for passed in path)  # already determined by commands in flight
        return replace(found, h_next=min(found.h_next, lowest))

    def _next(self, state: StateMessage, action: FloatArray, latent: FloatArray | None) -> Rows:
        """Predicts one state under an action; empty if that is not possible."""
        known = len(state.values) == len(self.model.system.state)
        return self._rollout(state, action, latent, 1)[0] if known else ()

    def _rollout(
        self, state: StateMessage, action: FloatArray, latent: FloatArray | None, steps: int
    ) -> tuple[Rows, Any]:
        model, free = self.model, self.model.latent if latent is None else latent
        step = model.scalar_step(state.period)
        if step is not None and (
            rows := rollout_held_action(step, state.values, action, free, state.robot_time, state.period, steps)
        ):
            return rows, self.memory
        values = np.array(state.values)
        found, memory = model.rollout_held(values, action, self.memory, latent, steps, period=state.period)
        return (tuple(map(tuple, found)), memory) if np.isfinite(found).all() else ((), None)

    def last_resort(self, state: StateMessage) -> FloatArray:
        """Returns the action after a failed step: the scene's backup at this state, otherwise the resting action.

        The resting action lets a robot with a throttle roll.
        """
        settings = self.filter.settings
        try:
            self.scene.follow(state)
            action = None if self.scene.backup is None else np.asarray(self.scene.backup(None), dtype=np.float64)
        except Exception:  # noqa: BLE001  the cause of the failed step may make this fail, too
            action = None
        if action is None or action.shape != settings.resting_action.shape or not np.isfinite(action).all():
            return settings.resting_action
        return np.clip(action, settings.low, settings.high)

    def stationary_reason(self, verdict: Verdict) -> str:
        """Returns why the robot is stationary, once it has been for long; empty before."""
        eta = self.filter.settings.eta
        return self.deadlock_detector.reason(verdict.status.value, verdict.active, eta * verdict.h_now < verdict.margin)

    def check_decision(self, decided: LastDecision, barriers: AbstractBarrierSet | str) -> None:
        """Repeats a decision of another model with this one. Raises InputError if only this one needs a fallback."""
        if isinstance(barriers, str) or decided.verdict.status is Status.fallback:
            return
        state, latent = decided.state, self.model.latent
        verdict = self.filter.decide(
            state.values,
            decided.verdict.action if decided.verdict.status is Status.stopped else decided.verdict.nominal,
            latent,
            memory=self.pending,
            barriers=barriers,
            epsilon=self.margin.epsilon,
            time=state.robot_time,
        )
        predicted, _ = self.predicted(state, verdict, latent)
        if verdict.status is Status.fallback or not predicted:
            raise InputError(f"the filter cannot decide with it: {verdict.sentence}")
