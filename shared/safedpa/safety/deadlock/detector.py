"""A robot that stands though something is requested: noticed by what its model says it would do, and told with a reason.

No robot is known here: what should move is what the model moves. Over a stand, from the state x0 where it began,

    promised = sum over ticks of |x(t+1 predicted under the nominal action) - x(t)|,   moved = |x(t) - x0|,

both over the places of the state: its positions in m, else the entries that are no rates. The robot stands while moved
stays below a tenth of what was promised. Next to it the same sum for the action that went out: where that is large, the
model says that the robot is driven, and it is not: the action lies in a dead band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import hypot
from typing import Final, Protocol

from safedpa.systems import System

__all__ = [
    "DEAD_BAND_SECONDS",
    "REPORTED_SECONDS",
    "DeadlockDetector",
    "Stand",
    "StandReport",
    "places_of",
    "record_deadlock",
    "what_to_do",
]

Stand = dict[str, float | str]
"""``from`` [s, by the robot's clock], ``seconds``, ``reason``."""


class StandReport(Protocol):
    """What a verdict message reports of a robot that is stationary."""

    @property
    def stationary_reason(self) -> str:
        """The reason; empty while it moves."""

    @property
    def stationary_for(self) -> float:
        """s for which it has been stationary."""

    @property
    def robot_time(self) -> float:
        """s, by the robot's clock."""


REPORTED_SECONDS: Final = 5.0
"""s; a longer stand is told in the verdict."""
DEAD_BAND_SECONDS: Final = 0.5
"""s; an action that has not moved the robot for so long, though the model says it would, does not move it."""
_STILL: Final = 0.1
"""Of the way promised; less is none."""
_FORGIVEN: Final = 0.5
"""s in a row without a promise, such as ticks whose nominal action came late, that do not end a stand."""
_DRIVEN: Final = 0.02
"""Of the way promised under the nominal action; with less the action that went out is not meant to move the robot either."""


_CURES: Final = {
    "dead band": "Free it if something blocks it, or give the model what holds it, such as a dead zone of its drive.",
    "no decision": "An input of the filter is missing or refused, or it was ordered to stop: it drives on when all is "
    "back, or after 'safedpa go'.",
    "margin": "Give it another goal or more room, roll back to a model with a narrower margin, or calibrate again.",
    "boxed in": "Give it another goal or more room, or drive it out by hand.",
}
"""By what a reason begins with."""


def what_to_do(reason: str) -> str:
    """What a person can do about a robot that stands for this reason of a verdict; empty for one not known here."""
    return _CURES.get(reason.partition(":")[0], "")


def places_of(system: System) -> tuple[int, ...]:
    """Which entries of the state tell where the robot is: those in m, else those whose unit is not per second."""
    lengths = tuple(index for index, variable in enumerate(system.state) if variable.unit == "m")
    if lengths:
        return lengths
    still = tuple(index for index, variable in enumerate(system.state) if "/s" not in variable.unit)
    return still or tuple(range(len(system.state)))


@dataclass
class DeadlockDetector:
    """What is remembered of one robot's standing; ``measure`` with each state, ``promise`` after each decision."""

    places: tuple[int, ...]
    seconds: float = 0.0
    """s for which it has stood though something was requested."""
    failed: float = 0.0
    """Largest way promised in one tick that has not moved it in this stand; 0: none."""
    _begun: tuple[float, ...] = ()
    _nominal_motion: float = 0.0
    _driven: float = 0.0
    _missed: float = 0.0
    """s since the last promise."""
    _promise: tuple[float, float] | None = None
    _pushed: list[float] = field(default_factory=list)
    """Ways promised under the last actions that should have moved it, one a tick."""

    def measure(self, values: Sequence[float], period: float) -> None:
        """Holds what was promised for the last tick against the measured state (states,)."""
        promise, self._promise = self._promise, None
        self._missed = 0.0 if promise is not None else self._missed + period
        unknown = promise is None and (self._nominal_motion == 0.0 or not self._missed <= _FORGIVEN)
        if unknown or max(self.places) >= len(values):
            self._begin(())
            return
        here = tuple(values[index] for index in self.places)
        if promise is not None:
            self._nominal_motion += promise[0]
            self._driven += promise[1]
        moved = hypot(*(now - then for now, then in zip(here, self._begun, strict=False)))
        nominal_next = promise is None or promise[0] > 0.0
        if not self._begun or not nominal_next or not moved <= _STILL * self._nominal_motion:
            self._begin(here)
            return
        self.seconds += period
        if promise is not None:
            self._push(promise, period)

    def promise(self, state: Sequence[float], nominal_next: Sequence[float], expected: Sequence[float]) -> None:
        """What the model predicts from ``state`` under the nominal action and under the action that went out, (states,) each."""
        if not self._begun:
            self._begun = tuple(state[index] for index in self.places)
        self._promise = self.way(state, nominal_next), self.way(state, expected)

    def way(self, state: Sequence[float], following: Sequence[float]) -> float:
        """How far the robot's place moves from the one state to the other."""
        return hypot(*(following[index] - state[index] for index in self.places))

    def interrupted(self) -> None:
        """Nothing is requested, or nothing is known."""
        self._begin(())

    def is_inside_dead_band(self, way: float) -> bool:
        """Whether an action that promises this way in a tick promises no more than what has not moved the robot."""
        return self.failed > 0.0 and way <= self.failed

    def reason(self, status: str, active: Sequence[str], margin_binds: bool) -> str:
        """Why it stands, in words; empty while it has not stood for longer than 5 s."""
        if self.seconds <= REPORTED_SECONDS:
            return ""
        pushed, short = self._driven > _DRIVEN * self._nominal_motion, status in ("relaxed", "violated")
        if (self.failed > 0.0 and (pushed or not short)) or (pushed and status in ("passed", "disabled")):
            return "dead band: the model says that such an action moves it, and it does not move"
        held = " and ".join(active) if active else "what it has to keep"
        if status in ("fallback", "stopped"):
            return "no decision: the backup action holds it"
        if short or margin_binds:
            return f"margin: {held} leave less room than the margin asks for"
        return f"boxed in: {held} allow no action that would move it"

    def _push(self, promise: tuple[float, float], period: float) -> None:
        if promise[1] <= _DRIVEN * promise[0]:
            self._pushed.clear()
            return
        self._pushed.append(promise[1])
        if len(self._pushed) * period >= DEAD_BAND_SECONDS:
            self.failed = max(self.failed, *self._pushed)

    def _begin(self, here: tuple[float, ...]) -> None:
        self._begun, self.seconds, self.failed = here, 0.0, 0.0
        self._nominal_motion = self._driven = 0.0
        self._pushed.clear()


def record_deadlock(found: list[Stand], verdict: StandReport) -> None:
    """Adds a stand that a verdict tells of to those found, or lengthens the last one; the newest reason counts."""
    if not verdict.stationary_reason:
        return
    begun = round(verdict.robot_time - verdict.stationary_for, 6)
    reported: Stand = {"from": begun, "seconds": round(verdict.stationary_for, 6), "reason": verdict.stationary_reason}
    if found and abs(float(found[-1]["from"]) - begun) < 1e-3:
        found[-1] = reported
    else:
        found.append(reported)
