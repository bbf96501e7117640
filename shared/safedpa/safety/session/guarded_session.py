"""Which state a session decides with: the measured one if it can be believed, else the one that the model predicts.

A lost state (missing, or not a number) is predicted from the last believed one along the actions that were applied. The
margins grow with every lost period, since each prediction may err by one margin. After ``GRACE`` the robot brakes by
its backup at the predicted state. On a state that cannot be believed the robot brakes at once, with what is still
plausible of it (such as its speed, if only its position jumped), and stays stopped until ``confirm``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from math import ceil, isfinite, isnan
from typing import Any, Final, NamedTuple

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.margins.online import OnlineMarginMonitor
from safedpa.safety.prediction.command_history import LONGEST_AGE
from safedpa.safety.session.measurement import MeasuredState
from safedpa.safety.session.plausibility import NO_CONTRADICTION, ClockMonitor, Contradiction, StateMonitor
from safedpa.safety.session.session_memory import SessionMemory, StateT
from safedpa.safety.session.state_limits import Evidence, StateLimits
from safedpa.safety.validation import InvalidInput, checked_input, checked_output
from safedpa.safety.verdict import Status, Verdict

__all__ = ["GRACE", "GuardedSession"]

Plain = tuple[float, ...]

GRACE: Final = 0.2
"""Time [s] for which a robot without a state follows its nominal action, with a margin that grows."""
_LONGEST_LOSS: Final = 10.0
"""Time [s] after which a prediction says nothing any more; the robot is at rest by then, or cannot stop."""
_ALLOWED_DELAY: Final = 0.15
"""s by which commands may act later than known before a robot that does not move counts as frozen."""
_MOST_COMMANDS: Final = 256
"""Stored actions: a second at the shortest periods."""
_SAME_AGE: Final = 1e-6
"""Share of a period by which the ages of two states may differ by rounding."""
_LONGEST_SHARE: Final = 3.0
"""Periods between two measurements that are predicted by one step."""
_SERVO_LAG: Final = 0.1
"""s; a servo that the model does not have prolongs the delay of a command by so much before a jump contradicts it."""
_UNKNOWN_GROWTH: Final = 3
"""Lost states that a period counts as in which it is not even known what the robot applied."""
_LONGEST_JUMP: Final = 4.0
"""Largest jumps that are added to the motion during a pause."""
_REPEATED_SHARE: Final = 0.2
"""Share of the limit of a jump that a repeated state should have moved by its own rates before it counts as lost."""
_FROZEN_SHARE: Final = 0.5
"""The same before it counts as frozen."""
_FROZEN_COUNT: Final = 2
"""Repetitions before a state counts as frozen: one message may be sent twice."""
_MOST_BRAKED: Final = 60
"""Periods of a pause for which the braking of the robot by itself is predicted; it rests by then, or the last action
holds."""
_BELIEVED_SECONDS: Final = 1.0
"""s; a state that freezes is noticed within this time, and the latent of before is used from then on."""
_AT_REST: Final = 0.01
"""Share of the fastest motion since the state was lost below which the robot counts as stationary."""


class _Believed(NamedTuple):
    """The last state that was decided with, measured or predicted."""

    epoch: int
    tick: int
    values: Plain
    until_action: float
    """As in the state message [s]: how old the measurement was."""


class GuardedSession(SessionMemory[StateT]):
    """A session that decides only with states that it can believe; see ``accept``."""

    def __init__(
        self, model: PhysicsModel, safe: SafetyFilter, margin: OnlineMarginMonitor, limits: StateLimits | None
    ) -> None:
        super().__init__(model, safe, margin)
        self.limits = limits
        """Thresholds of the plausibility; None: any state within the bounds of the system is believed."""
        self.latched = ""
        """Why the robot stays stopped until ``confirm``; empty if it does not."""
        self.latch_ordered = False
        """Whether the latch was stored as a stop order, which then ends it."""
        self.problem = ""
        """Why the newest state is not used; empty if it is."""
        self.evidence: Evidence | None = None
        """What the newest state showed; None if it could not be compared."""
        self.lost = 0
        """Periods since the last believed state."""
        self._was_lost = False
        """Whether the state before was predicted."""
        self._monitor = StateMonitor(model.system, limits or StateLimits(), model.period)
        self._clock = ClockMonitor()
        self._trusted: frozenset[int] = frozenset()
        """Entries that are still measured while latched, such as the rates after a jump of the position."""
        self._measured: Plain = ()
        """The newest values as they were measured."""
        self._believed: _Believed | None = None
        self._free_memory: Any = None
        self._allowed_periods = ceil(_ALLOWED_DELAY / model.period)
        self._commands: deque[Plain] = deque(maxlen=_MOST_COMMANDS)
        """The actions that were applied, newest first."""
        self._fastest = 0.0
        self._same_seconds, self._same_count = 0.0, 0
        """Time [s] and states since the measured values last changed."""
        self._overbraked: dict[str, float] = {}
        """By how much the predicted rates may be too high, by unit: the robot may brake harder than its model."""
        self._gap = 0
        """Periods since the last believed measurement in which the filter was not asked."""
        self._unestimated: Plain = ()
        """The newest state (states,) as predicted with the latent of the model since ``_seen``; empty: as measured."""
        self._seen: _Believed | None = None
        """The last state that was measured and believed."""
        self._unasked = 0
        """Periods since ``_seen`` in which the filter was not asked, before the newest state."""
        self._fastest_rates: dict[str, float] = {}
        """The largest rates since ``_seen``, measured or predicted, by unit."""
        self._other_rate = ""
        """How the stamps differ from the arrivals for now; empty if they do not."""
        self._accepted: StateT | None = None
        self._valid_latent: FloatArray | None = None
        """(latents,) the last valid one that was decided with; None: that of the model."""
        self._believed_latents: deque[FloatArray] = deque(maxlen=max(1, round(_BELIEVED_SECONDS / model.period)))
        """Those of the last second in which the states were believed."""

    @property
    def epsilon(self) -> dict[str, float]:
        """The margins in force: the calibrated ones times the number of periods that are predicted."""
        # A stopped robot waits: its margin would grow without an end.
        if self.latched:
            return self.margin.epsilon
        return {kind: (1 + self.lost) * value for kind, value in self.margin.epsilon.items()}

    @property
    def braking(self) -> str:
        """Why the backup acts instead of a decision about the nominal action; empty if it does not."""
        if self.latched:
            reason = f"the state is implausible, {self.latched}"
            return f"{reason}; confirm where the robot is, by 'safedpa go' or confirm(), to let it drive"
        # Without a state to predict from, the filter itself refuses this one.
        if self._believed is None:
            return ""
        if self._other_rate:
            return f"the state is implausible, {self._other_rate}"
        if self.problem and (self.lost * self.model.period > GRACE or self.problem not in (_LOST, _REPEATS)):
            return f"{self.problem}; predicted for {self.lost * self.model.period:.2g} s"
        return self.delayed

    def confirm(self) -> None:
        """Lets the robot drive again: a person, or a localisation, vouches for the next state."""
        self.latched, self.latch_ordered, self.lost, self._believed = "", False, 0, None
        self._same_seconds, self._same_count, self._overbraked = 0.0, 0, {}
        self._seen, self._unasked, self._fastest_rates, self._unestimated = None, 0, {}, ()
        self._monitor.restart()

    def believed_latent(self, latent: FloatArray | None) -> FloatArray | None:
        """The latent (latents,) to decide with: the newest one, or while latched that of a second before.

        What was estimated since then is about states that are not believed: of frozen ones, that no command moves the
        robot, so that it would brake far too hard.
        """
        if latent is None or isinstance(checked_input("latent", latent, self.filter.tools.latent_range), InvalidInput):
            return latent
        if self.latched:
            latent = self._believed_latents[0] if self._believed_latents else np.array(self.model.latent)
        elif not self.lost:
            self._believed_latents.append(latent)
        self._valid_latent = latent
        return latent

    def continue_from(self, former: GuardedSession[StateT], *, same_model: bool) -> None:
        """Takes over what is known of the robot's state; with the ``same_model`` and period also what it taught."""
        self.latched, self.problem, self.lost = former.latched, former.problem, former.lost
        self._believed, self._clock = former._believed, former._clock
        self._commands, self._trusted, self._measured = former._commands, former._trusted, former._measured
        self._accepted, self.latch_ordered = former._accepted, former.latch_ordered
        self._same_seconds, self._same_count = former._same_seconds, former._same_count
        self._overbraked, self._other_rate = former._overbraked, former._other_rate
        self._seen, self._unasked, self._fastest_rates = former._seen, former._unasked, former._fastest_rates
        if same_model:
            # Without the actuators and the latent, the next state would be compared with another prediction.
            self.memory, self.until_action = former.memory, former.until_action
            self._valid_latent, self._unestimated = former._valid_latent, former._unestimated
            self._believed_latents.extend(former._believed_latents)
            self._monitor, self._free_memory, self._fastest = former._monitor, former._free_memory, former._fastest
            self.deadlock_detector = former.deadlock_detector
            self.history.continue_from(former.history)
            self.delay.continue_from(former.delay)

    def accept(self, state: StateT, arrived: float | None = None) -> StateT:
        """Returns the state to decide with: ``state``, or one with predicted values.

        ``arrived`` [s]: when it arrived by a clock other than its source's; None if that is not known.
        """
        before = self._accepted
        if before is not None and (before.epoch, before.tick) == (state.epoch, state.tick):
            return before
        raw, self._measured = self._measured, tuple(state.values)
        late = "" if arrived is None else self._clock.observe(state.robot_time, arrived)
        timed = arrived is not None and self.limits is not None and self.can_stop
        self._other_rate = (self._clock.behind or self._clock.ahead) if timed else ""
        self.problem = _problem_of(state.values, len(self.model.system.state)) or self._out_of_range(state.values)
        usable, known = not self.problem, self._believed
        self._was_lost, self._gap = self.lost > 0, 0
        self.evidence = None
        # What the robot applied by itself in a pause takes its time, too: older commands have acted by then.
        missing = 0 if before is None or before.epoch != state.epoch else state.tick - before.tick - 1
        self._commands.extendleft([tuple(state.applied)] * min(max(0, missing), _MOST_COMMANDS))
        self._commands.appendleft(self._applied(state))
        compared = not usable or bool(self.latched) or self.limits is not None
        predicted = self._predicted(state) if known is not None and compared else None
        if usable and not self.latched and self.limits is not None:
            self.latched = self._repeated(state, raw) or (
                "" if self.problem else self._implausible(state, predicted, late)
            )
            usable = not self.problem
            # A frozen state was believed for some periods: the robot is where the commands took it since.
            if self.latched and self._is_unanswered():
                predicted = self._since_moved(state) or predicted
        if usable and not self.latched:
            self._believe(state)
        elif predicted is not None and known is not None:
            state = self._predict_through(state, known, predicted, raw if usable else ())
        self._accepted = state
        return state

    def _believe(self, state: StateT) -> None:
        """Takes in a measured state."""
        if self._monitor.accept(state.values, self.evidence, self.lost + self._gap):
            self._free_memory = None
        self.lost, self._fastest, self._overbraked, self._unestimated = 0, 0.0, {}, ()
        self._believed = self._seen = _Believed(state.epoch, state.tick, state.values, state.until_action)
        self._unasked, self._fastest_rates = 0, self._monitor.rates(state.values)

    def _predict_through(self, state: StateT, known: _Believed, predicted: Plain, raw: Plain) -> StateT:
        """The state with predicted values, but for those that are still measured and plausible.

        ``raw``: the measured values of the state before; empty if those of this one are unusable.
        """
        # Values that do not change at all may be frozen: they would make the robot brake for ever.
        fresh = any(state.values[index] != raw[index] for index in self._trusted if index < len(raw))
        if not (fresh and len(self._trusted) == len(predicted)):
            self.lost += max(1, state.tick - known.tick) if state.epoch == known.epoch else 1
        self._unasked += _missing(known, state)
        self._advance_unestimated(state, known)
        for rate, size in self._monitor.rates(predicted).items():
            self._fastest_rates[rate] = max(size, self._fastest_rates.get(rate, 0.0))
        if fresh:
            pairs = enumerate(zip(state.values, predicted, strict=True))
            predicted = tuple([measured if at in self._trusted else guess for at, (measured, guess) in pairs])
            self._overbraked = {}
        elif self.limits is not None:
            for unit in self._monitor.falling(known.values, predicted):
                more = self.limits.overbraking.get(unit, 0.0)
                self._overbraked[unit] = self._overbraked.get(unit, 0.0) + more
        self._believed = _Believed(state.epoch, state.tick, predicted, state.until_action)
        # The fields of a state message are checked; only its values change.
        return replace(state, values=predicted)  # type: ignore[type-var]

    def watch_margin(self, state: StateT) -> None:
        """Compares the last prediction with the measured state; not with one that is itself predicted."""
        if self.lost or self._was_lost:
            self.margin.expect(None)
            self.margin.samples = {}
            self.tick = state.tick
        else:
            super().watch_margin(state)

    def _watch_delay(self, state: StateT, latent: FloatArray | None) -> None:
        if not (self.lost or self._was_lost):
            super()._watch_delay(state, latent)

    def brake(self, state: StateT, latent: FloatArray | None, reason: str, **known: Any) -> Verdict:
        """Returns the backup at the believed ``state`` because of ``reason``; at rest, the resting action."""
        verdict = self.filter.stop(reason, state.values, latent, can_stop=self.can_stop, **known)
        if (
            self.can_stop
            and self.lost
            and (self._has_turned_back(state) or self._is_at_rest(state, verdict.action, latent))
        ):
            verdict = replace(verdict, action=self.filter.settings.resting_action)
        return replace(verdict, status=Status.fallback) if verdict.status is Status.stopped else verdict

    def _repeated(self, state: StateT, raw: Plain) -> str:
        """Why a state that is exactly the one before contradicts its own rates; empty if it does not.

        At first it may be an old message: then it is ``problem``, and the state is predicted as if it were lost.
        """
        known = self._believed
        if known is None or tuple(state.values) != raw:
            self._same_seconds, self._same_count = 0.0, 0
            return ""
        ticks = max(1, state.tick - known.tick) if state.epoch == known.epoch else 1
        # A measurement that says that it has become older is no new one.
        self._same_seconds += max(0.0, ticks * self.model.period + known.until_action - state.until_action)
        self._same_count += 1
        share = max(self._monitor.claimed_motion(state.values, self._same_seconds).values(), default=0.0)
        if share > _REPEATED_SHARE:
            self.problem = _REPEATS
        if not (share > _FROZEN_SHARE and self._same_count >= _FROZEN_COUNT):
            return ""
        self._trusted = frozenset()
        return f"it does not change for {self._same_seconds:.2g} s, although its own rates say that it moves"

    def _implausible(self, state: StateT, predicted: Plain | None, late: str) -> str:
        """Why the state contradicts the ones before, or its clock (``late``); empty if it does not, or without any."""
        known = self._believed
        if predicted is None or known is None or len(predicted) != len(state.values):
            return ""
        gap = self._gap = self._unasked + _missing(known, state)
        # A robot without a safe standstill cannot wait for a confirmation: a source that pauses begins again.
        if gap and not self.can_stop:
            self._monitor.restart()
            return ""
        if gap * self.model.period > GRACE:
            return self._too_far(state, self._seen or known)
        found = self._contradiction(state, known, predicted, gap)
        if late and not found.text:
            found = Contradiction(late, tuple(range(len(state.values))))
        self._trusted = frozenset(found.trusted)
        again = ", after its source restarted" if found.text and state.epoch != known.epoch else ""
        return found.text + again

    def _contradiction(self, state: StateT, known: _Believed, predicted: Plain, gap: int) -> Contradiction:
        """What the state contradicts under each delay of the commands that a robot may have unknown to the filter."""
        free, lost = self._free(state), self.lost + _UNKNOWN_GROWTH * gap
        self.evidence = self._monitor.observe(state.values, known.values, predicted, free)
        unknown = self._unknown_motion(state, known, predicted, gap)
        found = self._monitor.problem(self.evidence, lost, unknown)
        if not found.text or gap or state.values == known.values:
            return found
        # After lost states, the prediction under another delay begins where the robot was last measured.
        begin, periods = (self._seen or known, self.lost + 1) if self.lost else (known, 1)
        earlier = self._along_commands(begin.values, state, periods, 0) if self.lost else predicted
        for late in range(1, self._allowed_periods + ceil(_SERVO_LAG / self.model.period) + 1):
            other = self._along_commands(begin.values, state, periods, late)
            if not other:
                break
            # A delay need not be a number of whole periods.
            nearest = self._monitor.nearest_between(earlier or other, other, state.values)
            self.evidence, earlier = self._monitor.observe(state.values, known.values, nearest, free), other
            if not self._monitor.problem(self.evidence, lost, unknown).text:
                return NO_CONTRADICTION
        self.evidence = self._monitor.observe(state.values, known.values, predicted, free)
        return found

    def _unknown_motion(self, state: StateT, known: _Believed, predicted: Plain, gap: int) -> dict[str, float]:
        """By how much a state may differ from its prediction, by unit, for reasons other than noise.

        A robot that was not asked for ``gap`` periods may have braked or driven on, as with any of its last commands,
        and one that brakes without a measured speed may brake harder than its model does.
        """
        found, period = dict[str, float](), self.model.period
        for rate, speed in self._monitor.rates(known.values).items() if gap or self._overbraked else ():
            less = self._overbraked.get(rate, 0.0)
            found[rate] = less + (speed if gap else 0.0)
            found[rate.removesuffix("/s")] = period * (self.lost * less + gap * speed)
        for late in range(1, self._allowed_periods + 1) if gap else ():
            # The commands before the pause.
            other = self._along_commands(known.values, state, gap + 1, gap + late, held=True)
            for unit, size in self._monitor.distances(other, predicted).items() if other else ():
                found[unit] = max(size, found.get(unit, 0.0))
        return found

    def _too_far(self, state: StateT, known: _Believed) -> str:
        """Whether the state is further from the last measured one than its rates explain; empty if it is not.

        What the robot applied while this filter was not asked is unknown; a robot without a filter brakes by itself. So
        it moved no further than at its largest rates since then, plus the largest jump: a source that restarts
        elsewhere is seen.
        """
        self._monitor.restart()
        moved = self._monitor.observe(state.values, known.values, known.values).jump
        jumps = StateLimits() if self.limits is None else self.limits
        periods = state.tick - known.tick if state.epoch == known.epoch else self.lost + 1
        seconds = max(1, periods) * self.model.period
        speeds = self._fastest_rates or self._monitor.rates(known.values)
        # A heading without a measured rate turns with a robot that moves, but not with one that rests.
        resting = all(seconds * speed <= jumps.jump.get(rate.removesuffix("/s"), 0.0) for rate, speed in speeds.items())
        for unit, size in moved.items():
            rate = speeds.get(f"{unit}/s", 0.0 if resting and speeds and "/s" not in unit else None)
            if rate is not None and unit in jumps.jump:
                limit = seconds * rate + _LONGEST_JUMP * jumps.jump[unit]
                if not size <= limit:
                    return f"it moved by {size:.2g} {unit} within {seconds:.2g} s (at most {limit:.2g} {unit})"
        return ""

    def _is_unanswered(self) -> bool:
        return self.evidence is not None and any(self.evidence.unanswered.values())

    def _predicted(self, state: StateT) -> Plain | None:
        """The believed state predicted to the time of ``state``; None if there is none, or it is too long ago."""
        known = self._believed
        assert known is not None
        ticks = state.tick - known.tick if state.epoch == known.epoch else 1
        if (self.lost + ticks) * self.model.period > _LONGEST_LOSS:
            return None
        values, memory = known.values, self.memory
        # A robot without a filter brakes by itself: what it applied since, it says only of the newest period.
        alone = ticks - 1 if self.can_stop and state.applied_by != "filter" else 0
        for index in range(max(1, ticks)):
            action = self._backup_at(values) if 0 < index < min(alone, _MOST_BRAKED) else None
            following = self._advanced(values, state, memory, action=action)
            if following is None:
                return None
            values, memory = following
        # A source that measures at other moments than the ticks: the time between two measurements is no period.
        later = (known.until_action - state.until_action) / self.model.period
        if self.lost or ticks != 1 or abs(later) <= _SAME_AGE:
            return values
        share = min(max(1.0 + later, 0.0), _LONGEST_SHARE)
        return tuple([before + share * (now - before) for before, now in zip(known.values, values, strict=True)])

    def _free(self, state: StateT) -> Plain:
        """The prediction since the position last changed, one period further; empty if there is none."""
        free, known = self._monitor.free, self._believed
        # The same measurement again, older by then: the robot had no time to answer.
        if known is not None and state.until_action - known.until_action > 0.5 * self.model.period:
            return free
        # A prediction that begins at the last state begins with its actuators.
        start = self.memory if self._free_memory is None else self._free_memory
        following = self._advanced(free, state, start, self._allowed_periods) if free else None
        if following is None:
            return ()
        self._free_memory = following[1]
        return following[0]

    def _since_moved(self, state: StateT) -> Plain:
        """The prediction from where the position last changed, along all commands since; empty if there is none."""
        values, periods = self._monitor.anchor
        return self._along_commands(values, state, periods, 0) if values else ()

    def _along_commands(self, values: Plain, state: StateT, periods: int, late: int, *, held: bool = False) -> Plain:
        """The prediction from ``values`` (states,) along the last commands, each ``late`` periods later, to now.

        ``held``: with that of ``late`` periods ago throughout. Empty if there is no prediction.
        """
        memory = self.memory
        for back in reversed(range(periods)):
            following = self._advanced(values, state, memory, late if held else late + back)
            if following is None:
                return ()
            values, memory = following
        return values

    def _backup_at(self, values: Plain) -> Plain | None:
        """The backup action (actions,) at a predicted state, within the bounds; None if there is none."""
        backup, settings = self.filter.tools.backup, self.filter.settings
        if backup is None:
            return None
        with suppress(Exception):  # the user's own function; the decision reports what it raises
            action = checked_output("backup", backup(np.array(values)))
            if action.shape == settings.low.shape and np.isfinite(action).all():
                return tuple(np.clip(action, settings.low, settings.high).tolist())
        return None

    def _advanced(
        self,
        values: Plain,
        state: StateT,
        memory: Any,
        late: int = 0,
        action: Plain | None = None,
        latent: FloatArray | None = None,
    ) -> tuple[Plain, Any] | None:
        """The state (states,) and actuators one period later under ``action``; None without one.

        Default: the action that acts, or one ``late`` periods before it; the last latent.
        """
        model, action = self.model, self._acting(state, late) if action is None else action
        if len(action) != len(model.system.action) or not all(map(isfinite, action)):
            return None
        latent = self._valid_latent if latent is None else latent
        with suppress(InputError, ValueError, ArithmeticError):  # values without a prediction
            step = model.scalar_step(model.period)
            if step is not None:
                found = step(values, action, (model.latent if latent is None else latent).tolist(), state.robot_time)
                return (tuple(found), memory) if all(map(isfinite, found)) else None
            held = np.array(action)
            start = model.initial_memory(held) if memory is None else memory
            after, memory = model.advance(np.array(values), held, start, latent)
            return (tuple(after.tolist()), memory) if np.isfinite(after).all() else None
        return None

    def _applied(self, state: StateT) -> Plain:
        """The action of the last period: that of the last decision, if the robot says that it applied it."""
        last = self.decision
        follows = last is not None and (state.epoch, state.tick) == (last.state.epoch, last.state.tick + 1)
        if last is not None and follows and state.applied_by == "filter":
            return tuple(last.verdict.action.tolist())
        return tuple(state.applied)

    def _acting(self, state: StateT, late: int) -> Plain:
        """The action that acted ``late`` periods before the last one ended: of a delayed robot, one sent earlier."""
        delay = max(self.until_action, state.until_action)
        known = round(delay / self.model.period) if 0.0 < delay <= LONGEST_AGE else 0
        # Before the first command the robot rested under the oldest one.
        return self._commands[min(known + late, len(self._commands) - 1)] if self._commands else state.applied

    def _advance_unestimated(self, state: StateT, known: _Believed) -> None:
        """Predicts on with the latent of the model, where another one was estimated."""
        values, memory = self._unestimated or known.values, self.memory
        ticks = state.tick - known.tick if state.epoch == known.epoch else 1
        for _ in range(min(max(1, ticks), _MOST_BRAKED)) if self._valid_latent is not None else ():
            following = self._advanced(values, state, memory, latent=self.model.latent)
            if following is None:
                return
            values, memory = following
            self._unestimated = values

    def _has_turned_back(self, state: StateT) -> bool:
        """Whether the latent of the model says that the robot no longer moves the way that the estimate says.

        The estimated latent may be wrong where the robot brakes: a throttle that hardly overcomes its friction looks
        weak. Without a measured speed, the robot would then brake until it drives the other way.
        """
        values, now = state.values, self._unestimated
        return bool(self.speeds and now) and sum(values[index] * now[index] for index in self.speeds) <= 0.0

    def _is_at_rest(self, state: StateT, action: FloatArray, latent: FloatArray | None) -> bool:
        following: Any = ()
        with suppress(InputError, ValueError, ArithmeticError):  # values without a prediction
            following = self._next(state, action, latent)
        if not following:
            return False
        motion = self.deadlock_detector.displacement(state.values, following[0])
        self._fastest = max(self._fastest, motion)
        return motion <= _AT_REST * self._fastest

    def _out_of_range(self, values: Plain) -> str:
        checked = checked_input("state", np.array(values), self.filter.tools.state_range)
        return checked.reason if isinstance(checked, InvalidInput) else ""


def _missing(known: _Believed, state: MeasuredState) -> int:
    """Periods between two states for which there is none."""
    return max(0, state.tick - known.tick - 1) if state.epoch == known.epoch else 0


_LOST: Final = "the state is lost"
_REPEATS: Final = "the state repeats the one before although it moves"


def _problem_of(values: Sequence[float], states: int) -> str:
    """Why the values are no measurement; empty if they are one."""
    if not len(values) or any(map(isnan, values)):
        return _LOST
    if len(values) != states:
        return f"the state has {len(values)} entries, wanted {states}"
    return ""
