"""The way out of the margin's boundary layer, where no action of one tick satisfies every condition.

Between 0 and epsilon_i / eta no single step may reach what the condition asks for, above all from rest; anyone who takes
the safest action of each tick then stands there for ever. Two things are taken in its place. The nominal action, where it raises
every h that is short of its margin, from the upper half of the layer, and satisfies the other conditions. And of a robot
that stands all the same a manoeuvre: one action, held for up to 1.5 s. With

    share(x) = min_i h_i(x) eta / epsilon_i

it is taken where the model predicts for every tick k that it is held for, and every barrier i,

    h_i(x[k+1]) >= (1 - eta) h_i(x[k]) + epsilon_i                                    if h_i(x[0]) >= epsilon_i / eta,
    h_i(x[k+1]) >= max(0, min(h_i(x[0]) - epsilon_i / (100 eta), epsilon_i / (2 eta)))   otherwise: in its layer,

and share(x[n]) >= min(1, share(x[0]) + 1/50) at its end. All of it is judged again in every tick, from the state that is
measured, over what is left of the manoeuvre: whatever fails ends it, and the least-violation action is back in its place.
Since h holds the room that the backup needs to stop (braking straight lowers no h), the backup can end it at any tick.
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

_PATIENCE: Final = 0.5
"""s; who has stood for so long is led out."""
_LONGEST: Final = 1.5
"""s for which an action is held at most."""
_SHARES: Final = (-1.0, -0.5, -0.25, -0.125, 0.0, 0.125, 0.25, 0.5, 1.0)
"""Of the way from the resting action to a bound: finer near rest, where the robot begins."""
_A_TICK: Final = 8
"""Actions that are looked at in one tick at most: who stands has time, and the other robots of a fleet have not."""
_STEPS_A_TICK: Final = 240
"""Predictions after which no other action is looked at in the same tick: a short period has less time for more of
them. As many as eight actions take at 20 ticks a second."""
_GAIN: Final = 0.02
"""Of the layer's depth; to gain less is not worth the way."""
_ENOUGH: Final = 2.0
"""Depths of the layer; of manoeuvres that lead further than that the nearest to the nominal action is taken."""
_DIP: Final = 0.01
"""Of the layer's depth by which h may fall at first: speed takes room to stop before any way is made."""


@final
@dataclass(frozen=True)
class TickContext:
    """What one tick knows."""

    tick: int
    period: float
    heights: list[float]
    """(m,) h at the state."""
    margins: list[float]
    """(m,) epsilon of each barrier."""
    ahead: Callable[[Sequence[float]], Iterator[list[float]]]
    """(m,) h after each tick for which an action is held, one after the other, as long as the model has numbers."""
    fails: Callable[[Sequence[float]], bool]
    """Whether an action is known not to move the robot."""


@final
@dataclass(frozen=True)
class _ActiveManoeuvre:
    """A manoeuvre under way."""

    action: Action
    left: int
    """Ticks for which it is held, this one among them."""
    tick: int
    """When it was judged last."""
    floors: tuple[float, ...]
    """(m,) below it no h may be predicted; -infinity for those that are to satisfy their conditions."""
    goal: float
    """Share at its end."""


@final
class DeadlockEscape:
    """Finds what leads a robot out, and remembers the manoeuvre that is under way."""

    def __init__(self, settings: FilterSettings, program: QuadraticProgram) -> None:
        self._settings, self._program = settings, program
        resting = settings.resting_action.tolist()
        levels = [
            [rest + share * ((high - rest) if share > 0.0 else (rest - low)) for share in _SHARES]
            for rest, (low, high, _) in zip(resting, program.sides, strict=True)
        ]
        self._actions = [action for action in product(*levels) if list(action) != resting]
        self._looked = self._steps = 0
        """Actions looked at since it stands, and steps predicted in this tick."""
        self._best: tuple[float, float, Action, int] | None = None
        self._held: _ActiveManoeuvre | None = None

    def wanted(self, status: Status) -> bool:
        """Whether a verdict of this status may be replaced."""
        return status is Status.relaxed or (status is Status.corrected and self._held is not None)

    def forget(self) -> None:
        """Nothing is under way, and nothing was looked at."""
        self._looked, self._best, self._held = 0, None, None

    def instead_of(self, verdict: Verdict, here: TickContext, stood: float) -> Verdict:
        """A verdict that leads out, or the one given; ``stood`` [s]: for how long the robot has."""
        relaxed, held = verdict.status is Status.relaxed, self._followed(here)
        if held is None and relaxed and (detour := self._nominal_action(verdict, here)) is not None:
            self.forget()
            return detour
        if held is None and relaxed and stood >= _PATIENCE:
            held = self._found(verdict, here)
        elif held is None:
            self.forget()
        if held is None:
            return verdict
        then = next(here.ahead(held.action))
        slack = max([0.0, *self._missing(here, here.heights, then)])
        if not relaxed and slack > 0.0:
            self.forget()
            return verdict
        action = np.array(held.action)
        action.flags.writeable = False
        notice = f"It stood: an action held for {held.left * here.period:.2g} s leads out of the margin's layer."
        return replace(verdict, action=action, reason=notice, slack=slack, h_next=min(then))

    def _nominal_action(self, verdict: Verdict, here: TickContext) -> Verdict | None:
        """The nominal action in place of the least-violation action, if it raises every h that is short."""
        action = np.clip(np.asarray(verdict.nominal), self._settings.low, self._settings.high)
        then = next(here.ahead(action.tolist()), None)
        if then is None:
            return None
        missing = self._missing(here, here.heights, then)
        for short, now, after, epsilon in zip(missing, here.heights, then, here.margins, strict=True):
            if not short <= 0.0 and not after > now >= 0.5 * epsilon / self._settings.eta:
                return None
        action.flags.writeable = False
        notice = "The nominal action is taken: it raises every h that is short of its margin, and satisfies the other conditions."
        return replace(verdict, action=action, reason=notice, slack=max([0.0, *missing]), h_next=min(then))

    def _missing(self, here: TickContext, heights: list[float], then: list[float]) -> list[float]:
        """(m,) what each condition lacks from one tick to the next."""
        share = 1.0 - self._settings.eta
        return [share * heights[row] + here.margins[row] - then[row] for row in range(len(then))]

    def _followed(self, here: TickContext) -> _ActiveManoeuvre | None:
        """What is under way, judged again; None where its predictions hold no longer, or it is done."""
        held, self._held = self._held, None
        if held is None or held.tick + 1 != here.tick or held.left <= 1:
            return None
        ticks, share = self._best_end(held.action, held.left - 1, held.floors, here)
        if ticks == 0 or share < held.goal:
            return None
        self._held = _ActiveManoeuvre(held.action, ticks, here.tick, held.floors, held.goal)
        return self._held

    def _found(self, verdict: Verdict, here: TickContext) -> _ActiveManoeuvre | None:
        """The best manoeuvre from here, once all were looked at: the highest share, then the nearest to the nominal action."""
        floors = tuple(self._floor(h, epsilon) for h, epsilon in zip(here.heights, here.margins, strict=True))
        goal, most = min(1.0, self._share(here.heights, here) + _GAIN), round(_LONGEST / here.period)
        nominal = np.asarray(verdict.nominal).tolist()
        self._steps, last = 0, min(self._looked + _A_TICK, len(self._actions))
        while self._looked < last and self._steps < _STEPS_A_TICK:
            action = self._actions[self._looked]
            self._looked += 1
            if here.fails(action):
                continue
            ticks, reached = self._best_end(action, most, floors, here)
            if ticks > 0 and reached >= goal:
                found = (-reached, self._program.distance(action, nominal), action, ticks)
                self._best = found if self._best is None else min(self._best, found)
        if self._looked < len(self._actions):
            return None
        best = self._best
        self.forget()
        if best is None:
            return None
        ticks, reached = self._best_end(best[2], best[3], floors, here)  # it may have been found some ticks ago
        if ticks > 0 and reached >= goal:
            self._held = _ActiveManoeuvre(best[2], ticks, here.tick, floors, goal)
        return self._held

    def _floor(self, h: float, epsilon: float) -> float:
        depth = epsilon / self._settings.eta
        return -inf if h >= depth else max(0.0, min(h - _DIP * depth, 0.5 * depth))

    def _best_end(self, action: Action, most: int, floors: tuple[float, ...], here: TickContext) -> tuple[int, float]:
        """For how many ticks to hold the action, at most ``most``, and the share then; 0 where it fails at once.

        The first tick at which the share is largest, of those before a floor or a condition is broken.
        """
        best, ticks, before = -1.0, 0, here.heights
        for index, heights in zip(range(most), here.ahead(action), strict=False):
            self._steps += 1
            if self._broken(floors, here.margins, before, heights):
                break
            share, before = self._share(heights, here), heights
            if share > best:
                best, ticks = share, index + 1
        return ticks, best

    def _broken(self, floors: tuple[float, ...], margins: list[float], before: list[float], then: list[float]) -> bool:
        """Whether a step breaks what one of the barriers is to keep."""
        share: float = 1.0 - self._settings.eta
        for row in range(len(then)):
            floor, h = floors[row], then[row]
            least = share * before[row] + margins[row] if floor == -inf else floor
            if not h >= least:  # what is no number is broken
                return True
        return False

    def _share(self, heights: list[float], here: TickContext) -> float:
        """The least h as a share of its layer's depth, up to ``_ENOUGH``; barriers without a margin have no layer."""
        eta: float = self._settings.eta
        margins, least = here.margins, _ENOUGH
        for row in range(len(heights)):
            epsilon = margins[row]
            if epsilon > 0.0:
                share = heights[row] * eta / epsilon
                least = share if share < least else least
        return least
