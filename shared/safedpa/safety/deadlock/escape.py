"""Deadlock escape: leads a robot out of the boundary layer of its margin.

Between 0 and epsilon_i / eta it may be impossible to satisfy the constraint in a single step, above all from rest; a
robot that takes the least-violation action of each tick is then stationary for ever. Two actions replace it. First the
nominal action, if it raises every h below its margin, from the upper half of the layer, and satisfies the other
constraints. Second, if the robot is stationary nevertheless, a manoeuvre: one action, held for up to 1.5 s. With

    share(x) = min_i h_i(x) eta / epsilon_i

it is accepted if the model predicts for every tick k of the manoeuvre, and every barrier i,

    h_i(x[k+1]) >= (1 - eta) h_i(x[k]) + epsilon_i                                    if h_i(x[0]) >= epsilon_i / eta,
    h_i(x[k+1]) >= max(0, min(h_i(x[0]) - epsilon_i / (100 eta), epsilon_i / (2 eta)))   otherwise: in its layer,

and share(x[n]) >= min(1, share(x[0]) + 1/50) at its end. All of this is checked again in every tick, from the measured
state over the rest of the manoeuvre: any failure ends it, and the least-violation action is used again. Since h
contains the distance that the backup needs to stop (braking straight lowers no h), the backup can end it at any tick.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf
from typing import Final, final

import numpy as np

from safedpa.safety.settings import FilterSettings
from safedpa.safety.solver.qp import QuadraticProgram
from safedpa.safety.verdict import Status, Verdict

__all__ = ["DeadlockEscape", "TickContext"]

Action = tuple[float, ...]

_START_AFTER: Final = 0.5
"""Time [s] after which a stationary robot is led out."""
_MAX_DURATION: Final = 1.5
"""Longest duration [s] of a manoeuvre."""
_SHARES: Final = (-1.0, -0.5, -0.25, -0.125, 0.0, 0.125, 0.25, 0.5, 1.0)
"""Shares of the range from the resting action to a bound: finer near rest, where the robot starts."""
_ACTIONS_PER_TICK: Final = 8
"""Actions evaluated per tick: a stationary robot can wait, the other robots of its service cannot."""
_STEPS_PER_TICK: Final = 240
"""Predictions per tick after which no further action is evaluated: a shorter period has more steps per manoeuvre and
less time for them. It is the number that eight actions take at 20 ticks a second."""
_GAIN: Final = 0.02
"""Smallest gain, as a share of the layer's depth, that is worth a manoeuvre."""
_MAX_SHARE: Final = 2.0
"""Share at which a manoeuvre has led far enough; of several such the one nearest to the nominal action is chosen."""
_MAX_DIP: Final = 0.01
"""Share of the layer's depth by which h may fall at first: speed reduces the clearance before the robot gets away."""


@final
@dataclass(frozen=True)
class TickContext:
    """The inputs of one tick."""

    tick: int
    period: float
    h: list[float]
    """(m,) h at the state."""
    margins: list[float]
    """(m,) epsilon of each barrier."""
    predict_h: Callable[[Sequence[float]], Iterator[list[float]]]
    """Yields h (m,) after each tick of a held action, as long as the model returns finite values."""
    is_inside_dead_band: Callable[[Sequence[float]], bool]
    """Whether an action is known not to move the robot."""


@final
@dataclass(frozen=True)
class _ActiveManoeuvre:
    """A manoeuvre in progress."""

    action: Action
    left: int
    """Ticks for which it is still held, this one included."""
    tick: int
    """The tick of the last check."""
    floors: tuple[float, ...]
    """(m,) lower limits of the predicted h; -infinity for rows that must satisfy their constraint."""
    goal: float
    """Share to be reached at its end."""


@final
class DeadlockEscape:
    """Finds manoeuvres that lead out of the boundary layer, and stores the one in progress."""

    def __init__(self, settings: FilterSettings, program: QuadraticProgram) -> None:
        self._settings, self._program = settings, program
        resting = settings.resting_action.tolist()
        levels = [
            [rest + share * ((high - rest) if share > 0.0 else (rest - low)) for share in _SHARES]
            for rest, (low, high, _) in zip(resting, program.sides, strict=True)
        ]
        self._actions = [action for action in product(*levels) if list(action) != resting]
        self._evaluated = self._steps = 0
        """Actions evaluated since the robot is stationary, and steps predicted in this tick."""
        self._best: tuple[float, float, Action, int] | None = None
        self._active: _ActiveManoeuvre | None = None

    def may_replace(self, status: Status) -> bool:
        """Whether a verdict of this status may be replaced."""
        return status is Status.relaxed or (status is Status.corrected and self._active is not None)

    def reset(self) -> None:
        """Ends the manoeuvre and the search."""
        self._evaluated, self._best, self._active = 0, None, None

    def replace_verdict(self, verdict: Verdict, context: TickContext, stationary_for: float) -> Verdict:
        """Returns a verdict that leads out, or the given one; ``stationary_for`` [s] is how long the robot has been."""
        relaxed, manoeuvre = verdict.status is Status.relaxed, self._continue(context)
        # A manoeuvre in progress is continued first: alternating with the nominal action would lead nowhere.
        if manoeuvre is None and relaxed and (detour := self._nominal_action(verdict, context)) is not None:
            self.reset()
            return detour
        if manoeuvre is None and relaxed and stationary_for >= _START_AFTER:
            manoeuvre = self._search(verdict, context)
        elif manoeuvre is None:
            self.reset()
        if manoeuvre is None:
            return verdict
        h_next = next(context.predict_h(manoeuvre.action))
        slack = max([0.0, *self._shortfalls(context, context.h, h_next)])
        # The filter found a feasible action: a manoeuvre that violates a constraint must not replace it.
        if not relaxed and slack > 0.0:
            self.reset()
            return verdict
        action = np.array(manoeuvre.action)
        action.flags.writeable = False
        duration = manoeuvre.left * context.period
        notice = f"The robot was stationary: an action held for {duration:.2g} s leads out of the margin's layer."
        return replace(verdict, action=action, reason=notice, slack=slack, h_next=min(h_next))

    def _nominal_action(self, verdict: Verdict, context: TickContext) -> Verdict | None:
        """The nominal action instead of the least-violation action, if it raises every h below its margin."""
        action = np.clip(np.asarray(verdict.nominal), self._settings.low, self._settings.high)
        h_next = next(context.predict_h(action.tolist()), None)
        if h_next is None:
            return None
        shortfalls = self._shortfalls(context, context.h, h_next)
        for shortfall, now, after, epsilon in zip(shortfalls, context.h, h_next, context.margins, strict=True):
            # Only the upper half of the layer: deeper inside, a nominal action that raises h a little may still end at
            # h = 0.
            if not shortfall <= 0.0 and not after > now >= 0.5 * epsilon / self._settings.eta:
                return None
        action.flags.writeable = False
        notice = "The nominal action is used: it raises every h below its margin and satisfies the other constraints."
        return replace(verdict, action=action, reason=notice, slack=max([0.0, *shortfalls]), h_next=min(h_next))

    def _shortfalls(self, context: TickContext, h: list[float], h_next: list[float]) -> list[float]:
        """(m,) by how much each constraint is violated from one tick to the next; negative if satisfied."""
        share = 1.0 - self._settings.eta
        return [share * h[row] + context.margins[row] - h_next[row] for row in range(len(h_next))]

    def _continue(self, context: TickContext) -> _ActiveManoeuvre | None:
        """Checks the manoeuvre in progress again; None if its predictions no longer hold, or it has ended."""
        manoeuvre, self._active = self._active, None
        # After a gap in the ticks the robot may be anywhere: the manoeuvre was planned for the state of the next tick.
        if manoeuvre is None or manoeuvre.tick + 1 != context.tick or manoeuvre.left <= 1:
            return None
        ticks, share = self._best_duration(manoeuvre.action, manoeuvre.left - 1, manoeuvre.floors, context)
        if ticks == 0 or share < manoeuvre.goal:
            return None
        self._active = _ActiveManoeuvre(manoeuvre.action, ticks, context.tick, manoeuvre.floors, manoeuvre.goal)
        return self._active

    def _search(self, verdict: Verdict, context: TickContext) -> _ActiveManoeuvre | None:
        """The best manoeuvre, once all actions are evaluated: largest share, then nearest to the nominal action."""
        floors = tuple(self._floor(h, epsilon) for h, epsilon in zip(context.h, context.margins, strict=True))
        goal, most = min(1.0, self._min_share(context.h, context) + _GAIN), round(_MAX_DURATION / context.period)
        nominal = np.asarray(verdict.nominal).tolist()
        self._steps, last = 0, min(self._evaluated + _ACTIONS_PER_TICK, len(self._actions))
        while self._evaluated < last and self._steps < _STEPS_PER_TICK:
            action = self._actions[self._evaluated]
            self._evaluated += 1
            if context.is_inside_dead_band(action):
                continue
            ticks, reached = self._best_duration(action, most, floors, context)
            if ticks > 0 and reached >= goal:
                found = (-reached, self._program.distance(action, nominal), action, ticks)
                self._best = found if self._best is None else min(self._best, found)
        if self._evaluated < len(self._actions):
            return None
        best = self._best
        # The search took several ticks, so the result is checked again from the present state.
        self.reset()
        if best is None:
            return None
        ticks, reached = self._best_duration(best[2], best[3], floors, context)
        if ticks > 0 and reached >= goal:
            self._active = _ActiveManoeuvre(best[2], ticks, context.tick, floors, goal)
        return self._active

    def _floor(self, h: float, epsilon: float) -> float:
        depth = epsilon / self._settings.eta
        # Rows inside their layer may dip slightly, but never below 0, and never to less than half of the layer if they
        # are above.
        return -inf if h >= depth else max(0.0, min(h - _MAX_DIP * depth, 0.5 * depth))

    def _best_duration(
        self, action: Action, most: int, floors: tuple[float, ...], context: TickContext
    ) -> tuple[int, float]:
        """The number of ticks to hold the action, at most ``most``, and the share then; 0 if it fails at once.

        The first tick with the largest share, before any floor or constraint is violated.
        """
        best, ticks, previous = -1.0, 0, context.h
        for index, h in zip(range(most), context.predict_h(action), strict=False):
            self._steps += 1
            if self._is_violated(floors, context.margins, previous, h):
                break
            share, previous = self._min_share(h, context), h
            if share > best:
                best, ticks = share, index + 1
        return ticks, best

    def _is_violated(
        self, floors: tuple[float, ...], margins: list[float], previous: list[float], h_next: list[float]
    ) -> bool:
        """Whether a step violates the floor or the constraint of any row."""
        share: float = 1.0 - self._settings.eta
        for row in range(len(h_next)):
            floor, h = floors[row], h_next[row]
            smallest = share * previous[row] + margins[row] if floor == -inf else floor
            if not h >= smallest:  # also true for NaN
                return True
        return False

    def _min_share(self, h: list[float], context: TickContext) -> float:
        """The smallest h as a share of its layer's depth, at most ``_MAX_SHARE``; rows without margin have no layer."""
        eta: float = self._settings.eta
        margins, smallest = context.margins, _MAX_SHARE
        for row in range(len(h)):
            epsilon = margins[row]
            if epsilon > 0.0:
                share = h[row] * eta / epsilon
                smallest = share if share < smallest else smallest
        return smallest
