"""Deadlock detection: a robot does not move although the nominal action asks it to, and why.

It works for any model, since the model says what should move. From the state x0 where a robot became stationary,

    expected = sum over ticks of |x(t+1 predicted under the nominal action) - x(t)|,   moved = |x(t) - x0|,

both over the position entries of the state: those in m, else those that are no rates. The robot is stationary while
moved is below a tenth of expected. The same sum is kept for the action that was sent: if it is large, the model says
that the robot is driven although it does not move, so the action lies in a dead band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import hypot
from typing import Any, Final, Protocol

from safedpa.systems import System

__all__ = [
    "DEAD_BAND_SECONDS",
    "REPORTED_SECONDS",
    "DeadlockDetector",
    "Stand",
    "StandReport",
    "position_entries",
    "record_deadlock",
    "what_to_do",
]

Stand = dict[str, Any]
"""``from`` [s, robot time], ``seconds``, ``reason``, and ``reasons``: the seconds of each reason."""


class StandReport(Protocol):
    """The fields of a verdict message about a stationary robot."""

    @property
    def stationary_reason(self) -> str:
        """Why it is stationary; empty while it moves."""

    @property
    def stationary_for(self) -> float:
        """Time [s] for which it has been stationary."""

    @property
    def robot_time(self) -> float:
        """Robot time [s]."""


REPORTED_SECONDS: Final = 5.0
"""Time [s] after which the verdict reports a stationary robot."""
DEAD_BAND_SECONDS: Final = 0.5
"""Time [s] after which an action that should move the robot, but does not, counts as inside a dead band."""
_MIN_MOVED_SHARE: Final = 0.1
"""Share of the expected displacement below which the robot counts as stationary."""
_GRACE_SECONDS: Final = 0.5
"""Longest time [s] without an expectation, such as ticks with a late nominal action, that does not end a stand."""
_MIN_DRIVEN_SHARE: Final = 0.02
"""Share of the nominal displacement below which the action sent is not meant to move the robot."""
_MIN_NET_SHARE: Final = 0.1
"""Share of the path of the nominal displacements that their vector sum has where a motion is requested. Below it they
cancel out: the policy holds the robot in place, as that of a boat at its buoy."""


_REMEDIES: Final = {
    "dead band": "Free it if something blocks it, or give the model what holds it: a dead zone of its drive, or a "
    "force such as a slope, wind or current.",
    "no decision": "An input of the filter is missing or refused, or it was ordered to stop: it drives on when all is "
    "back, or after 'safedpa go'.",
    "margin": "Give it another goal or more room, roll back to a model with a narrower margin, or calibrate again.",
    "boxed in": "Give it another goal or more room, or drive it out by hand.",
}
"""What a person can do, by the first word of the reason."""


def what_to_do(reason: str) -> str:
    """What a person can do about a robot that is stationary for this reason; empty if the reason is not known."""
    return _REMEDIES.get(reason.partition(":")[0], "")


def position_entries(system: System) -> tuple[int, ...]:
    """Indices of the state entries that are positions: those in m, else those whose unit is not per second."""
    lengths = tuple(index for index, variable in enumerate(system.state) if variable.unit == "m")
    if lengths:
        return lengths
    still = tuple(index for index, variable in enumerate(system.state) if "/s" not in variable.unit)
    # A system with rates alone: any entry may show motion.
    return still or tuple(range(len(system.state)))


@dataclass
class DeadlockDetector:
    """The state of one robot's deadlock detection: ``update`` with each state, ``expect`` after each decision."""

    entries: tuple[int, ...]
    seconds: float = 0.0
    """Time [s] for which it has been stationary although a motion was requested."""
    reported_after: float = REPORTED_SECONDS
    """Time [s] after which ``reason`` reports it."""
    failed_displacement: float = 0.0
    """Largest displacement expected in one tick that did not happen since the robot is stationary; 0: none."""
    _start: tuple[float, ...] = ()
    _nominal_motion: float = 0.0
    _driven_motion: float = 0.0
    _without_expectation: float = 0.0
    """Time [s] since the last expectation."""
    _expected: tuple[float, float] | None = None
    _direction: tuple[float, ...] = ()
    """Displacement predicted under the nominal action of the last tick."""
    _net: tuple[float, ...] = ()
    """Vector sum of the displacements predicted under the nominal actions."""
    _driven_displacements: list[float] = field(default_factory=list)
    """Displacements expected under the last actions that should have moved the robot, one per tick."""

    def update(self, values: Sequence[float], period: float) -> None:
        """Compares the expectation of the last tick with the measured state (states,)."""
        expected, self._expected = self._expected, None
        # A missing nominal action is no request: after a grace period the robot is stationary on purpose.
        self._without_expectation = 0.0 if expected is not None else self._without_expectation + period
        lapsed = not self._without_expectation <= _GRACE_SECONDS
        unknown = expected is None and (self._nominal_motion == 0.0 or lapsed)
        if unknown or max(self.entries) >= len(values):
            self._restart(())
            return
        position = tuple(values[index] for index in self.entries)
        if expected is not None:
            self._nominal_motion += expected[0]
            self._driven_motion += expected[1]
            before = self._net or (0.0,) * len(position)
            self._net = tuple(own + step for own, step in zip(before, self._direction, strict=True))
        # The distance from the start, not the path length: noise and oscillation must not count as progress.
        moved = hypot(*(now - then for now, then in zip(position, self._start, strict=False)))
        nominal_next = expected is None or expected[0] > 0.0
        # A nominal action of rest is no deadlock, however long it lasts.
        if not self._start or not nominal_next or not moved <= _MIN_MOVED_SHARE * self._nominal_motion:
            self._restart(position)
            return
        self.seconds += period
        if expected is not None:
            self._record_driven(expected, period)

    def expect(self, state: Sequence[float], nominal_next: Sequence[float], expected: Sequence[float]) -> None:
        """Stores the displacements predicted from ``state`` under the nominal action and under the action sent."""
        if not self._start:
            self._start = tuple(state[index] for index in self.entries)
        self._expected = self.displacement(state, nominal_next), self.displacement(state, expected)
        self._direction = tuple(nominal_next[index] - state[index] for index in self.entries)

    def displacement(self, state: Sequence[float], following: Sequence[float]) -> float:
        """The distance between the robot's positions in two states."""
        return hypot(*(following[index] - state[index] for index in self.entries))

    def interrupt(self) -> None:
        """Call it when nothing is requested, or nothing is known."""
        self._restart(())

    def is_inside_dead_band(self, displacement: float) -> bool:
        """Whether an action with this expected displacement expects no more than what did not move the robot."""
        return self.failed_displacement > 0.0 and displacement <= self.failed_displacement

    def reason(self, status: str, active: Sequence[str], margin_binds: bool) -> str:
        """Why the robot is stationary; empty for the first ``reported_after`` seconds."""
        if self.seconds <= self.reported_after:
            return ""
        if status in ("fallback", "stopped"):
            return "no decision: the backup action holds it"
        driven = self._driven_motion > _MIN_DRIVEN_SHARE * self._nominal_motion
        violated = status in ("relaxed", "violated")
        # A dead band explains a stand only if the filter let the action through, or the action sent should have moved
        # the robot.
        if (self.failed_displacement > 0.0 and (driven or not violated)) or (
            driven and status in ("passed", "disabled")
        ):
            is_held = self._net and hypot(*self._net) <= _MIN_NET_SHARE * self._nominal_motion
            return "" if is_held else "dead band: the model says that such an action moves it, and it does not move"
        active_names = " and ".join(active) if active else "the barriers"
        if violated or margin_binds:
            return f"margin: {active_names} leave less room than the margin asks for"
        return f"boxed in: {active_names} allow no action that would move it"

    def _record_driven(self, expected: tuple[float, float], period: float) -> None:
        if expected[1] <= _MIN_DRIVEN_SHARE * expected[0]:
            self._driven_displacements.clear()
            return
        self._driven_displacements.append(expected[1])
        # Half a second without motion: one tick may be friction or a late actuator.
        if len(self._driven_displacements) * period >= DEAD_BAND_SECONDS:
            self.failed_displacement = max(self.failed_displacement, *self._driven_displacements)

    def _restart(self, position: tuple[float, ...]) -> None:
        self._start, self.seconds, self.failed_displacement = position, 0.0, 0.0
        self._nominal_motion = self._driven_motion = 0.0
        self._net = ()
        self._driven_displacements.clear()


def record_deadlock(found: list[Stand], verdict: StandReport) -> None:
    """Adds the stand that a verdict reports to those found, or extends the last one.

    ``reason`` is the one that held for the longest part of the whole stand, and not the newest: when the cause is over,
    a robot that begins to move reports other reasons. ``reasons`` has the seconds of each, by its first word.
    """
    if not verdict.stationary_reason:
        return
    start, seconds = round(verdict.robot_time - verdict.stationary_for, 6), round(verdict.stationary_for, 6)
    # The same start to within a millisecond is the same stand: later verdicts report it again with more seconds.
    if not found or abs(found[-1]["from"] - start) >= 1e-3:
        found.append({"from": start, "seconds": 0.0, "reason": "", "reasons": {}})
    stand = found[-1]
    kind = verdict.stationary_reason.partition(":")[0]
    before = max(stand["reasons"], key=stand["reasons"].get, default="")
    stand["reasons"][kind] = round(stand["reasons"].get(kind, 0.0) + max(0.0, seconds - stand["seconds"]), 6)
    if kind == before or not before or stand["reasons"][kind] > stand["reasons"][before]:
        stand["reason"] = verdict.stationary_reason
    stand["from"], stand["seconds"] = start, seconds
