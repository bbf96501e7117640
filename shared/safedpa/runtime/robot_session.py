"""The safety filter's session with one robot: everything it keeps between ticks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import LATENT, Inputs, LatentMessage, Stale, StateMessage, SurroundingsMessage
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.runtime.calibrated_model import CalibratedModel
from safedpa.runtime.scene import AbstractScene, propagate_obstacles, scene_of
from safedpa.safety.barriers.base import AbstractBarrierSet
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.margins.error_clipping import ErrorClip
from safedpa.safety.margins.online import OnlineMarginMonitor
from safedpa.safety.margins.transition import MarginRamp
from safedpa.safety.prediction.command_history import LONGEST_AGE
from safedpa.safety.session.guarded_session import GuardedSession
from safedpa.safety.session.session_memory import NO_BARRIERS, LastDecision, is_too_old
from safedpa.safety.session.state_limits import SHIPPED_LIMITS, StateLimits, limits_for
from safedpa.safety.settings import FilterSettings
from safedpa.safety.validation import InvalidInput, checked_input
from safedpa.safety.verdict import Status

__all__ = ["NO_BARRIERS", "SHIPPED_LIMITS", "LastDecision", "RobotSession", "state_too_old"]

# s for which the last latent replaces a missing one. A load does not change unnoticed within a second.
_LATENT_TIMEOUT = 1.0
# Accepted age of a source's newest scan in s, whatever perception allows: from a rounding error to the time-out of a
# latent.
_EARLY, _OLD = -1e-6, 1.0


def state_too_old(state: StateMessage) -> list[str]:
    """Describes the problem of a state whose action would act too long after it; empty if there is none."""
    if not is_too_old(state):
        return []
    return [f"the state (its action acts {state.until_action:g} s later, wanted 0 to {LONGEST_AGE:g} s)"]


def _same_scene(one: StateMessage, other: StateMessage) -> bool:
    return not (one.sources or other.sources) and (
        (one.obstacles, one.field, one.footprint, one.corridor, one.towed)
        == (other.obstacles, other.field, other.footprint, other.corridor, other.towed)
    )


class RobotSession(GuardedSession[StateMessage]):
    """Data of one robot of the service between ticks, for as long as its model stays the same."""

    def __init__(
        self,
        held: CalibratedModel,
        safe: SafetyFilter,
        model: PhysicsModel,
        scene: AbstractScene,
        margin: OnlineMarginMonitor,
        limits: StateLimits | None = None,
    ) -> None:
        super().__init__(model, safe, margin, limits)
        self.held, self.scene = held, scene
        # No properties: where these classes are compiled, they would be read as the attributes of the class above.
        self.can_stop, self.quick = scene.can_stop, scene.quick
        self.changed_at = -1
        """First tick at which another model is active; -1: none."""
        self.prepared = (0, -1)
        """Epoch and tick of the state that the fields below belong to."""
        self.latent: LatentMessage | None = None
        self.ordered = ""
        """Reason of the stop order at the last decision."""
        self.sensed: tuple[int, frozenset[str]] = (-1, frozenset())
        """Epoch, and all sources named by its states."""
        self.rehearsed = False
        """Whether the fallback path was warmed up with this model."""

    @classmethod
    def create(
        cls,
        held: CalibratedModel,
        settings: FilterSettings,
        before: Mapping[str, float] | None = None,
        period: float | None = None,
        limits: StateLimits | str | None = None,
    ) -> RobotSession:
        """Creates the session of a robot that is new, or that changes its model.

        ``before`` is the margin under the previous model, from which the margin changes gradually. ``period`` is the
        robot's period [s], over which the model predicts. ``limits`` are the thresholds of an implausible state;
        ``SHIPPED_LIMITS``: those that ship for the robot, else those that its bounds imply; None: none. A filter that
        is not enabled judges no state. Raises InputError if the settings are another robot's or there are no barriers
        for this one.
        """
        model = held.model if period is None else held.model.with_period(period)
        scene = scene_of(model, settings)
        scene.prepare()
        filtering = SafetyFilter.for_model(model, settings, backup=scene.backup)
        calibration, longer = held.margin_over(model.period, settings)
        phased = None if before is None else MarginRamp(before, calibration.epsilon, settings.eta)
        margin = OnlineMarginMonitor(calibration, ErrorClip.of_settings(settings), phased, longer)
        # A robot without a safe standstill cannot wait for a confirmation.
        shipped = limits_for(model.system, model.period) if scene.can_stop else None
        known = shipped if isinstance(limits, str) else limits
        known = known if settings.enabled else None
        return cls(held, filtering, model, scene, margin, known)

    def is_same_scene(self, state: StateMessage) -> bool:
        """Whether the scene around ``state`` is that of the last decision; never with sensors."""
        return self.decision is not None and _same_scene(self.decision.state, state)

    def observe_state(self, state: StateMessage) -> None:
        """Updates the session from a state, before the other inputs of the tick are known."""
        state = self.accept(state, None if state.lockstep else state.publish_time)
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
        latent = self.believed_latent(np.array(known.values))
        if not isinstance(checked_input("latent", latent, self.filter.tools.latent_range), InvalidInput):
            self.scene.learn(latent)  # the backup must not use a latent that the filter rejects
        return latent, []

    def inherit_from(self, former: RobotSession | None) -> None:
        """Takes over what does not depend on the model: commands sent, named sources, and the scene's odometry.

        From a session with the same model and period, also what was learned under them.
        """
        self.former = None if former is None else former.history
        if former is not None:
            same = former.held is self.held and former.model.period == self.model.period
            self.continue_from(former, same_model=same)
            self.latent = former.latent if same else None
            self.sensed = former.sensed
            self.scene.remember(former.scene)

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

    def check_decision(self, decided: LastDecision[StateMessage], barriers: AbstractBarrierSet | str) -> None:
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
