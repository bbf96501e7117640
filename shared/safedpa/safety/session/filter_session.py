"""``FilterSession``: a filter with what it knows of one robot between ticks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf, isfinite
from typing import Any, Final, cast, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.result import one_line
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.margins.error_clipping import ErrorClip
from safedpa.safety.margins.online import OnlineMarginMonitor
from safedpa.safety.session.function_model import FunctionModel, system_of_functions
from safedpa.safety.session.guarded_session import GuardedSession
from safedpa.safety.session.measurement import Measurement
from safedpa.safety.session.session_memory import LastDecision
from safedpa.safety.session.state_limits import SHIPPED_LIMITS, StateLimits, limits_for
from safedpa.safety.validation import checked_output
from safedpa.safety.verdict import Verdict
from safedpa.systems import System

__all__ = ["FilterSession"]

_REPORTED_AFTER: Final = 1.5
"""Time [s] after which a standstill is reported."""


_LONGEST_PAUSE: Final = 3600.0
"""Time [s] between two calls beyond which the clock must have been set."""


@final
class FilterSession(GuardedSession[Measurement]):
    """Decides for one robot, tick by tick, with what a filter must remember: call ``decide`` once per period.

    It keeps the commands that were sent (delays are compensated), widens the margin while its coverage is lost, reports
    a standstill, predicts a lost state, and brakes on a state that contradicts the ones before: see ``latched``. The
    services of this project use the same object.

    ``period`` [s] and ``states`` are needed for a filter of functions; ``system`` gives their units. ``margin`` is a
    calibration; default: the settings' margin. ``limits`` are the thresholds of an implausible state: by default those
    that ship for the robot, else those that its bounds imply; None switches the comparison off. ``can_stop``: whether
    the backup brings the robot to rest.

    Raises InputError for a filter of functions without a period, and for a margin of another kind.

    Example: a mass before a wall whose position jumps back by 0.8 m.

        >>> x = safedpa.Variable("x", "m", -5.0, 5.0), safedpa.Variable("v", "m/s", -2.0, 2.0)
        >>> mass = safedpa.System("mass", x, (safedpa.Variable("a", "m/s2", -1.0, 1.0),))
        >>> def affine(x):
        ...     return np.array([x[0] + 0.05 * x[1], x[1]]), np.array([[0.00125], [0.05]])
        >>> room = safedpa.FunctionBarrier(lambda x: 1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6, kind="wall")
        >>> settings = safedpa.FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon={"wall": 0.0})
        >>> safe = safedpa.SafetyFilter(affine, [room], settings, backup=lambda x: [0.0 if x is None else -20.0 * x[1]])
        >>> session = safedpa.FilterSession(safe, period=0.05, system=mass)
        >>> [session.decide(x, [0.0]).status.value for x in ([0.0, 0.4], [0.02, 0.4], [-0.76, 0.4])]
        ['passed', 'passed', 'fallback']
        >>> session.latched
        'it jumped by 0.8 m against the prediction (at most 0.1 m)'
        >>> session.confirm()
        >>> session.decide([-0.76, 0.4], [0.0]).status.value
        'passed'
    """

    def __init__(
        self,
        safe: SafetyFilter,
        *,
        period: float | None = None,
        states: int | None = None,
        system: System | None = None,
        margin: MarginCalibration | None = None,
        limits: StateLimits | str | None = SHIPPED_LIMITS,
        can_stop: bool = True,
    ) -> None:
        if not isinstance(safe, SafetyFilter):
            raise InputError(f"safe: got {type(safe).__name__}, wanted a SafetyFilter")
        model = _model_of(safe, period, states, system)
        settings = safe.settings
        known = margin or MarginCalibration(dict(settings.epsilon), 0.99, 1, "never", "")
        monitor = OnlineMarginMonitor(known.select(settings.margin), ErrorClip.of_settings(settings))
        if isinstance(limits, str):
            # Functions without a system have no units: nothing is known about how fast an entry may change.
            # A robot without a safe standstill cannot wait for a confirmation.
            known_system = bool(model.system.name) and can_stop
            limits = limits_for(model.system, model.period) if known_system else None
        super().__init__(model, safe, monitor, limits)
        self.can_stop = can_stop
        self.deadlock_detector.reported_after = _REPORTED_AFTER
        self._scene: tuple[AbstractBarrier, ...] = ()
        self._stationary = ""

    def __repr__(self) -> str:
        return one_line("FilterSession", {"filter": self.filter, "period": self.model.period, "latched": self.latched})

    @property
    def stationary_for(self) -> float:
        """Time [s] for which the robot has not moved although the nominal action asks it to."""
        return self.deadlock_detector.seconds

    @property
    def stationary_because(self) -> str:
        """Why the robot does not move although the nominal action asks it to; empty for the first 1.5 s."""
        return self._stationary

    def decide(
        self,
        state: ArrayLike | None,
        nominal: Any,
        latent: Any = None,
        *,
        time: float | None = None,
        arrived: float | None = None,
        applied: ArrayLike | None = None,
        barriers: Sequence[AbstractBarrier] | None = None,
        until_action: float = 0.0,
        epoch: int = 0,
        stop: str = "",
    ) -> Verdict:
        """Returns the verdict for this period, as ``SafetyFilter.decide`` does; raises nothing.

        ``state`` (states,): None or NaN if it is lost. ``time`` [s]: when it was measured, by the robot's clock;
        default: one period after the last. ``arrived`` [s]: when it arrived, by another clock. ``applied`` (actions,):
        what the robot applied since the last call; default: the action of the last verdict. ``until_action`` [s]: how
        much later than the measurement this action acts. ``epoch`` changes when the source of the state restarts.
        ``stop``: why the robot is to stop, for the backup action.
        """
        measured = self._measurement(state, time, applied, until_action, epoch)
        taken = self.accept(measured, arrived)
        self.model.clock.seconds = taken.robot_time
        self.barriers = make_barrier_set(self.filter.barriers if barriers is None else tuple(barriers))
        self.sync_actuators(taken)
        self.watch_margin(taken)
        self.deadlock_detector.update(taken.values, taken.period)
        free = self.believed_latent(_array_or_none(latent))
        verdict = self._decided(taken, nominal, latent if free is None else free, stop)
        self.decision = LastDecision(taken, free, verdict)
        self.watch_deadlock(taken, self.predict_states(taken, verdict, free))
        self._stationary = self.stationary_reason(verdict)
        return replace(verdict, reason=self._with_remarks(verdict.reason))

    def _decided(self, state: Measurement, nominal: Any, latent: Any, stop: str) -> Verdict:
        known: dict[str, Any] = {
            "memory": self.pending,
            "barriers": self.barriers,
            "epsilon": self.epsilon,
            "time": state.robot_time,
        }
        free = _array_or_none(latent)
        if self.braking:
            return self.brake(state, free, self.braking, **known)
        if stop:
            return self.filter.stop(stop, state.values, latent, can_stop=self.can_stop, **known)
        verdict = self.filter.decide(state.values, nominal, latent, **known, held_solution=self.held_solution)
        verdict = self.escape_boundary_layer(state, verdict, free)
        resting = self.filter.settings.resting_action
        return self.rest_in_dead_band(
            state, verdict, free, lambda: self.filter.decide(state.values, resting, latent, **known)
        )

    def _with_remarks(self, reason: str) -> str:
        remarks = [reason, self.margin.remark]
        if self.problem and not self.braking:
            remarks.append(f"The state is predicted for {self.lost * self.model.period:.2g} s: {self.problem}.")
        if self.decision is not None and self.until_action > self.decision.state.until_action:
            remarks.append(self.delay.remark(self.margin.coverage, self.margin.promised))
        if self._stationary:
            remarks.append(f"The robot has been stationary for {self.stationary_for:.1f} s. {self._stationary}.")
        return " ".join(text for text in remarks if text)

    def _measurement(
        self, state: ArrayLike | None, time: float | None, applied: ArrayLike | None, until_action: float, epoch: int
    ) -> Measurement:
        last, period = self.decision, self.model.period
        sent = self._resting if last is None else last.verdict.action.tolist()
        action = tuple(sent) if applied is None else _floats(applied)
        tick, seconds = 0, 0.0
        if last is not None:
            seconds = last.state.robot_time + period
            tick = last.state.tick + 1
        if isinstance(time, (int, float)) and isfinite(time):
            # Missed periods count; a clock that was set back or far ahead does not.
            missed = (time - seconds) / period if last is not None else 0.0
            tick += round(missed) if 0.0 <= missed < _LONGEST_PAUSE / period else 0
            seconds = float(time)
        by = "filter" if last is not None and action == tuple(sent) else "other" if last is not None else "none"
        delay = float(until_action) if isinstance(until_action, (int, float)) else inf
        return Measurement(tick, seconds, _floats(state), action, by, period, delay, epoch)


def _model_of(safe: SafetyFilter, period: float | None, states: int | None, system: System | None) -> PhysicsModel:
    """The model of a filter; of functions, one that predicts with them."""
    prediction = safe.tools.prediction
    if prediction.physics is not None:
        return prediction.physics if period is None else prediction.physics.with_period(period)
    if period is None or not 0.0 < period < inf:
        raise InputError(f"period: got {period!r}, wanted the seconds from one decision to the next")
    known = prediction.system or system
    if known is None:
        count = states if safe.tools.state_range is None else len(safe.tools.state_range.names)
        if count is None:
            raise InputError("states: got none, wanted the number of entries of the state, or its system")
        known = system_of_functions(safe.tools.state_range, count, len(safe.settings.action_low))
    # It has what a session uses of a model.
    return cast(PhysicsModel, FunctionModel(prediction, known, period))


def _floats(values: ArrayLike | None) -> tuple[float, ...]:
    """The entries as floats; empty for what is none."""
    try:
        return tuple(np.atleast_1d(checked_output("state", values)).ravel().tolist())
    except (InputError, TypeError, ValueError):
        return ()


def _array_or_none(values: Any) -> FloatArray | None:
    found = None if values is None else _floats(values)
    return None if not found else np.array(found)
