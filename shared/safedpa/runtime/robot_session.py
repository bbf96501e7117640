"""What the safety filter remembers of one robot between ticks."""

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
from safedpa.dynamics.straight import rollout_held_action
from safedpa.errors import InputError
from safedpa.runtime.calibrated_model import CalibratedModel
from safedpa.runtime.scene import AbstractScene, propagate_obstacles, scene_of
from safedpa.safety.barriers.base import AbstractBarrierSet, Barriers
from safedpa.safety.deadlock.detector import DeadlockDetector, places_of
from safedpa.safety.deadlock.escape import DeadlockEscape, TickContext
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.margins.error_clipping import ErrorClip
from safedpa.safety.margins.online import OnlineMarginMonitor
from safedpa.safety.margins.transition import MarginRamp
from safedpa.safety.prediction.command_history import LONGEST_AGE, CommandHistory
from safedpa.safety.prediction.delay_estimator import MOST, DelayEstimator
from safedpa.safety.settings import FilterSettings
from safedpa.safety.solver.candidates import HeldSolution
from safedpa.safety.validation import InvalidInput, checked_input
from safedpa.safety.verdict import Status, Verdict

__all__ = ["NO_BARRIERS", "LastDecision", "RobotSession", "state_too_old"]

Rows = tuple[tuple[float, ...], ...]

_LATENT_PATIENCE = 1.0
"""s; for so long the last latent stands in for a missing one: in a second a load does not change unnoticed."""
_PATH_STEPS, _PATH_EVERY = 8, 4
"""The path is for those who look on: told with every fourth tick, it costs a fleet a tenth less. The next state, which
the watch over the margin needs, is told with every tick."""
NO_BARRIERS = Barriers(())
_EARLY, _OLD = -1e-6, 1.0
"""s that a source's newest scan may be old, whatever perception allows: rounding, and as long as a latent."""


class LastDecision(NamedTuple):
    """The last decision."""

    state: StateMessage
    latent: FloatArray | None
    verdict: Verdict


def state_too_old(state: StateMessage) -> list[str]:
    """What is wrong with a state that is too old where its action acts."""
    if 0.0 <= state.until_action <= LONGEST_AGE:
        return []
    return [f"the state (its action acts {state.until_action:g} s later, wanted 0 to {LONGEST_AGE:g} s)"]


def _late(state: StateMessage, known: LatentMessage) -> bool:
    return (state.tick - known.tick) * state.period > _LATENT_PATIENCE + 0.5 * state.period


def _same_scene(one: StateMessage, other: StateMessage) -> bool:
    return not (one.sources or other.sources) and (
        (one.obstacles, one.field, one.footprint, one.corridor, one.towed)
        == (other.obstacles, other.field, other.footprint, other.corridor, other.towed)
    )


@dataclass
class RobotSession:
    """What is remembered of one robot between ticks, as long as its model stays."""

    held: CalibratedModel
    model: PhysicsModel
    """The held one, over the robot's own period."""
    filter: SafetyFilter
    scene: AbstractScene
    margin: OnlineMarginMonitor
    history: CommandHistory
    tick: int = -1
    changed_at: int = -1
    """First tick from which another model is to be used; -1: of none."""
    prepared: tuple[int, int] = (0, -1)
    """Epoch and tick of the state that the fields below belong to."""
    barriers: AbstractBarrierSet | str = NO_BARRIERS
    """Of the scene now, or what is wrong with it."""
    latent: LatentMessage | None = None
    decision: LastDecision | None = None
    ordered: str = ""
    """Why the robot was to stop at the last decision."""
    memory: Any = None
    """What the actuators remember, as the model has it."""
    former: CommandHistory | None = None
    """What was sent while another model was in force, until it was taken up."""
    pending: Any = ()
    """What is on its way; empty where an action acts at once."""
    expected_memory: Any = None
    """The same one period later, if the robot does what it is told."""
    delay: DelayEstimator = field(init=False)
    """By how much commands act later than told."""
    until_action: float = 0.0
    """s from the newest state until its action acts: what the robot tells, or what was found where that is longer."""
    standing: DeadlockDetector = field(init=False)
    """How long it has stood, and whether an action failed to move it."""
    sensed: tuple[int, frozenset[str]] = (-1, frozenset())
    """Epoch, and the sources that were named in it."""
    way_out: DeadlockEscape = field(init=False)
    _resting: list[float] = field(init=False)
    """(actions,) the nominal action of who requests nothing."""
    searched: HeldSolution = field(default_factory=HeldSolution)
    """What the last whole search for the least-violation action found, for periods too short to search in each."""
    rehearsed: bool = False
    """Whether all that a decision may need was gone through once, with this model."""

    def __post_init__(self) -> None:
        self.standing = DeadlockDetector(places_of(self.model.system))
        self.way_out = DeadlockEscape(self.filter.settings, self.filter.tools.program)
        self._resting = self.filter.settings.resting_action.tolist()
        ranges = (self.filter.settings.high - self.filter.settings.low).tolist()
        self.delay = DelayEstimator(self.filter.tools.prediction, ranges, self.model.period)

    @classmethod
    def begun(
        cls,
        held: CalibratedModel,
        settings: FilterSettings,
        before: Mapping[str, float] | None = None,
        period: float | None = None,
    ) -> RobotSession:
        """For a robot that was not filtered before, or not with this model: then ``before`` is the margin until now.

        ``period`` is the robot's own in s, over which the model has to predict, and the margin to hold.
        Raises InputError where the settings are another robot's, or no one wrote barriers for this one.
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
        """Which entries of the state are a speed that braking takes away; none of a robot that has no stand."""
        if not self.scene.stationary_for:
            return ()
        return tuple(index for index, variable in enumerate(self.model.system.state) if variable.unit == "m/s")

    def observe_state(self, state: StateMessage) -> None:
        """What a state tells before anything else is known."""
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
        self.standing.measure(state.values, state.period)
        self.prepared = (state.epoch, state.tick)

    def see(self, state: StateMessage, seen: SurroundingsMessage | Stale) -> None:
        """What is around a robot that names sources. What is amiss with one of them is told, and the backup acts."""
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
        """The barriers of what is seen; again where the margin widens by this very state, since more is near then.

        Five misses together widen it at once by any factor.
        """
        late, before = self.until_action + self._dead_time(), self.margin.epsilon
        ahead = propagate_obstacles(seen, late)
        self.barriers = self.scene.around(state, ahead, before, late)
        self.watch_margin(state)
        now = self.margin.epsilon
        if any(now[kind] > before.get(kind, 0.0) for kind in now):
            self.barriers = self.scene.around(state, ahead, now, late)

    def _dead_time(self) -> float:
        """s from where an action is put in force until it acts, by the model at the last latent."""
        known = None if self.latent is None else self.latent.values
        try:
            return self.filter.tools.prediction.dead_time(known)
        except (InputError, ValueError, ArithmeticError):  # the model refuses a number: the decision says so
            return 0.0

    def _lost(self, state: StateMessage) -> str:
        """Whether a robot that named sources names them no longer: what they saw is there all the same."""
        epoch, named = self.sensed
        gone = named - set(state.sources) if epoch == state.epoch else frozenset()
        self.sensed = state.epoch, frozenset(state.sources) | gone
        return f"surroundings (the sources {', '.join(sorted(gone))} are no longer named)" if gone else ""

    def watch_margin(self, state: StateMessage) -> None:
        """Holds the last prediction against the measured state, and lets a new model's margin rise."""
        if state.tick != self.tick + 1 or state.applied_by != "filter":
            self.margin.expect(None)  # what was predicted is not what was done
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
        """``predicted``, kept for the next tick."""
        self.model.clock.seconds = state.robot_time  # in between, another robot may have asked
        try:
            predicted, self.expected_memory = self.predicted(state, verdict, latent)
        except (InputError, ValueError, ArithmeticError):  # the model refuses a number: nothing is foreseen
            predicted, self.expected_memory = (), None
        self._watch_delay(state, latent)
        if self.pending:
            self.history.decided(None if latent is None else tuple(latent.tolist()))
        barriers = None if isinstance(self.barriers, str) else self.barriers
        self.margin.expect(predicted[0] if predicted else None, barriers)
        return predicted

    def _watch_delay(self, state: StateMessage, latent: FloatArray | None) -> None:
        passed = self.history.passed(MOST) if state.applied_by == "filter" else None
        if passed is None or (state.sources and passed.stood(self.speeds)):
            return
        with suppress(InputError, ValueError, ArithmeticError):  # the model refuses a number: nothing is learned
            self.delay.observe(passed, None if latent is None else tuple(latent.tolist()))

    def may_use_previous_model(self, state: StateMessage) -> bool:
        """Whether this model may decide although another one is in force: until a latent of that one comes."""
        return self.changed_at >= 0 and 0.0 <= (state.tick - self.changed_at) * state.period <= _LATENT_PATIENCE

    def usable_latent(self, state: StateMessage, inputs: Inputs) -> tuple[FloatArray | None, list[str]]:
        """The latent to use, and what is wrong with it."""
        message, own = inputs[LATENT], self.held.fingerprint
        if isinstance(message, LatentMessage):
            if message.model != own:
                return None, [f"the latent (of model {message.model}, the filter has {own})"]
            self.latent = message
        known = self.latent
        if known is None or known.epoch != state.epoch or _late(state, known):
            return None, ["the latent (none of the last second has arrived)"]
        latent = np.array(known.values)
        if not isinstance(checked_input("latent", latent, self.filter.tools.latent_range), InvalidInput):
            self.scene.learn(latent)  # what the filter refuses teaches the backup nothing either
        return latent, []

    def inherit_from(self, former: RobotSession | None) -> None:
        """How far the robot was driven backwards, and what was sent, do not depend on who held the model until now."""
        self.former = None if former is None else former.history
        if former is not None:
            self.sensed = former.sensed
            self.scene.remember(former.scene)

    def sync_actuators(self, state: StateMessage) -> None:
        """What the actuators remember now: as expected if the robot did what it was told, else as if at rest there."""
        if len(state.applied) != len(self.model.system.action):
            return  # the filter refuses such a state for its own reasons; nothing to learn here
        model, reported, expected = self.model, self.decision, self.expected_memory
        follows = reported is not None and (state.epoch, state.tick) == (reported.state.epoch, reported.state.tick + 1)
        if follows and expected is not None and state.applied_by == "filter":
            self.memory = expected
        elif follows and self.memory:  # the watchdog's action: what was sent before is still on its way
            self.memory = model.felt(state.applied, self.memory, period=state.period)[1]
        else:
            before = None if self.former is None else self.former.commands(state.tick, state.applied)
            oldest, *sent = before or (state.applied,)
            self.memory = model.initial_memory(np.array(oldest))
            for command in sent if self.memory else ():
                self.memory = model.felt(command, self.memory, period=state.period)[1]
        self.former = None
        self.history.add(state.tick, state.values, state.applied, self.memory)
        self.until_action = min(self.delay.beyond(state.until_action), LONGEST_AGE)
        late = (self.memory or self.until_action > 0.0) and not state_too_old(state)
        self.pending = self.history.pending(self.until_action) if late else ()

    def predicted(self, state: StateMessage, verdict: Verdict, latent: FloatArray | None) -> tuple[Rows, Any]:
        """The next states (steps, states) that the model expects under the action held; actuators' memory after one.

        One step, or the whole path where the tick is one of those that tell it.
        """
        model, steps = self.model, _PATH_STEPS if state.tick % _PATH_EVERY == 0 else 1
        if len(state.values) != len(model.system.state) or self.memory is None:  # no action in force was told yet
            return (), None
        if self.pending and self.pending.sent:
            known, action = None if latent is None else tuple(latent.tolist()), tuple(verdict.action.tolist())
            ahead = self.history.expected(action, known, self.pending, steps)
            after = model.felt(action, self.memory, known, period=state.period)[1] if self.memory else self.memory
            return (tuple(map(tuple, ahead)), after) if np.isfinite(ahead).all() else ((), None)
        step = model.straight(state.period)
        free = model.latent if latent is None else latent
        if step is not None and (
            rows := rollout_held_action(step, state.values, verdict.action, free, state.robot_time, state.period, steps)
        ):
            return rows, self.memory
        values = np.array(state.values)
        found, memory = model.held(values, verdict.action, self.memory, latent, steps, period=state.period)
        return (tuple(map(tuple, found)), memory) if np.isfinite(found).all() else ((), None)

    def watch_standing(self, state: StateMessage, predicted: Rows) -> None:
        """Keeps what the model promises under the nominal action, and under the action that went out."""
        assert self.decision is not None
        _, latent, verdict = self.decision
        nominal, nominal_next = verdict.nominal, predicted[:1]
        if verdict.status is Status.stopped or (nominal is not None and not predicted):
            self.standing.interrupted()
            return
        if nominal is None:  # nothing is promised in this tick
            return
        if verdict.status not in (Status.passed, Status.disabled):
            nominal_next = self._next(
                state, np.clip(nominal, self.filter.settings.low, self.filter.settings.high), latent
            )
        if not nominal_next or nominal.tolist() == self._resting:
            self.standing.interrupted()
        else:
            self.standing.promise(state.values, nominal_next[0], predicted[0])

    def out_of_dead_band(
        self, state: StateMessage, verdict: Verdict, latent: FloatArray | None, rest: Callable[[], Verdict]
    ) -> Verdict:
        """A correction that is known not to move the robot is given up for the resting action, if that is safe.

        What stands and is pushed in vain learns nothing but a wrong load. ``rest`` decides about the resting action.
        """
        if verdict.status is not Status.corrected or self.standing.failed == 0.0:
            return verdict
        predicted = self._next(state, verdict.action, latent)
        if not predicted or not self.standing.is_inside_dead_band(self.standing.way(state.values, predicted[0])):
            return verdict
        resting = rest()
        if resting.status is not Status.passed:
            return verdict
        notice = "The correction lay in the dead band, where the robot did not move before: it rests instead."
        return replace(resting, status=Status.corrected, nominal=verdict.nominal, active=verdict.active, reason=notice)

    def out_of_the_layer(self, state: StateMessage, verdict: Verdict, latent: FloatArray | None) -> Verdict:
        """Where no action satisfies every condition: what leads out of the margin's layer (``DeadlockEscape``).

        Judged from where the action begins to act. Nothing where it is felt over more periods than one: what the next
        ticks bring says nothing of it then.
        """
        barriers, known = self.barriers, None if latent is None else tuple(latent.tolist())
        prediction, values = self.filter.tools.prediction, tuple(state.values)
        wanted = verdict.nominal is not None and self.way_out.wanted(verdict.status)
        wanted = wanted and not state.sources  # a manoeuvre of seconds is judged among what is stationary
        begin = None if isinstance(barriers, str) or not wanted else prediction.begin(values, known, self.pending)
        if isinstance(barriers, str) or not wanted or not (begin is None or begin.at_once):
            self.way_out.forget()
            return verdict
        path: Rows = ()
        memory = self.memory
        if begin is not None:
            values, path, memory = begin.near, begin.path, begin.memory

        def ahead(action: Sequence[float]) -> Iterator[list[float]]:
            reached: Sequence[float] = values
            with suppress(InputError, ValueError, ArithmeticError):  # the model refuses a number: nothing is known then
                while isfinite(sum(reached := prediction.following(tuple(reached), action, known, memory))):
                    yield barriers.heights(reached)

        def fails(action: Sequence[float]) -> bool:
            predicted = self._next(state, np.array(action), latent)
            return not predicted or self.standing.is_inside_dead_band(self.standing.way(values, predicted[0]))

        margins = barriers.of_each(self.margin.epsilon, 0.0)
        here = TickContext(state.tick, state.period, barriers.heights(values), margins, ahead, fails)
        found = self.way_out.instead_of(verdict, here, self.standing.seconds if self.scene.quick else 0.0)
        if found is verdict or not path:
            return found
        lowest = min(min(barriers.heights(passed)) for passed in path)  # what no one can change any more
        return replace(found, h_next=min(found.h_next, lowest))

    def _next(self, state: StateMessage, action: FloatArray, latent: FloatArray | None) -> Rows:
        """One predicted state under an action; empty where there is none."""
        model = self.model
        if len(state.values) != len(model.system.state):
            return ()
        free = model.latent if latent is None else latent
        step = model.straight(state.period)
        if step is not None and (
            rows := rollout_held_action(step, state.values, action, free, state.robot_time, state.period, 1)
        ):
            return rows
        found, _ = model.held(np.array(state.values), action, self.memory, latent, 1, period=state.period)
        return tuple(map(tuple, found)) if np.isfinite(found).all() else ()

    def last_resort(self, state: StateMessage) -> FloatArray:
        """What is left where a step raised: the scene's own backup at the last state that was told, else the resting
        action, which lets a robot with a throttle roll."""
        settings = self.filter.settings
        try:
            self.scene.follow(state)
            action = None if self.scene.backup is None else np.asarray(self.scene.backup(None), dtype=np.float64)
        except Exception:  # noqa: BLE001  whatever broke the step may break this too
            action = None
        if action is None or action.shape != settings.resting_action.shape or not np.isfinite(action).all():
            return settings.resting_action
        return np.clip(action, settings.low, settings.high)

    def stationary_reason(self, verdict: Verdict) -> str:
        """Why it stands, once it has stood for long; empty before."""
        eta = self.filter.settings.eta
        return self.standing.reason(verdict.status.value, verdict.active, eta * verdict.h_now < verdict.margin)

    def try_out(self, decided: LastDecision, barriers: AbstractBarrierSet | str) -> None:
        """Decides again what another model decided. Raises InputError where only this one has to fall back."""
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
