"""The barrier conditions at one state: kept or broken by an action, and linearised about one; in plain numbers.

Nothing in here has a scale of its own. What is small next to what is told by each barrier's

    scale_i = max(|h_i(x)|, epsilon_i, what the actions can change in h_i(x+))

so that no verdict depends on the unit in which h, a state or an action is expressed.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from typing import Any, Final, final

from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrierSet
from safedpa.safety.errors import NotFiniteError
from safedpa.safety.prediction.dead_time import InFlightCommands, MultiStepBarriers
from safedpa.safety.prediction.predictor import AffineMotion, Prediction
from safedpa.safety.solver.linearization import Linearization
from safedpa.safety.solver.qp_scaling import Side

__all__ = ["NO_INFLUENCE", "ROUNDING", "ActionCandidate", "Constraints", "Plain"]

Plain = Sequence[float]

NO_INFLUENCE: Final = 1e-9
"""A column of g that over the action's whole range moves no entry of the state by more than this share of the entry, or
of its motion, is rounding error: the actuator is saturated."""

_TINY: Final = 1e-300
"""Scale of a barrier that has none: h = 0, no margin, and no action that moves it."""

_LARGEST: Final = 1.7976931348623157e308
"""The largest number there is: a margin may be so wide that what misses it is none."""

ROUNDING: Final = 1e-10
"""Share of a barrier's scale by which its condition may be missed: rounding errors of h and of the model."""


@final
class ActionCandidate:
    """What the model predicts for one action (actions,)."""

    def __init__(
        self,
        action: Plain,
        next_state: Plain,
        h_next: list[float],
        residual: list[float],
        broken: list[int],
    ) -> None:
        self.action, self.next_state, self.h_next = action, next_state, h_next
        self.residual = residual
        """(m,) h_i(x+) - ((1 - eta) h_i(x) + epsilon_i)."""
        self.broken = broken
        """Rows whose condition is broken by more than rounding."""
        self.least: float = _smallest(h_next)
        """Smallest h_i(x+)."""
        self.usable: bool = self.least > -inf
        """False where model or barrier have no finite numbers for this action: then all its h are -infinity."""
        self.kept: bool = not broken and self.least >= 0.0
        """Whether every condition holds, and every h_i(x+) >= 0."""

    @property
    def violation(self) -> float:
        """The slack that this action needs, the largest of all rows, in the unit of that row's h."""
        worst = 0.0
        for row in self.broken:
            missing = -self.residual[row]
            worst = missing if missing > worst else worst
        return worst if worst < _LARGEST else _LARGEST


@final
class Constraints:
    """h_i(x[t+1]) >= (1 - eta) h_i(x[t]) + epsilon_i for every barrier i, at one state and latent; eta = 1 for those
    that may be used up ``at_once``.

    ``sides`` (actions,) are lowest value, highest value and range of each action.

    Raises InputError when a barrier or the model returns a wrong shape or a number that is not finite.
    """

    def __init__(
        self,
        barriers: AbstractBarrierSet,
        prediction: Prediction,
        state: tuple[float, ...],
        latent: tuple[float, ...] | None,
        memory: Any,
        eta: float,
        epsilon: Plain,
        sides: Sequence[Side],
    ) -> None:
        self.barriers, self._prediction = barriers, prediction
        plain = barriers.since(state).plain(len(state))
        self._plain: Any = plain
        self._state, self._latent, self._sides = state, latent, sides
        self._memory = memory.memory if isinstance(memory, InFlightCommands) else memory
        self._widths: list[float] = [width for _, _, width in sides]
        h_now: list[float] = plain.heights(state)
        self.h_now = h_now
        _finite("h at the state", h_now)
        self.least_now: float = _smallest(h_now)
        """Smallest h_i at the state."""
        self.least_pending: float = inf
        """Smallest h_i on the way to where an action begins to act, which no action can change; infinity: at once."""
        self._begin = begin = prediction.begin(state, latent, memory)
        if begin is not None:
            for passed in begin.path:
                on_the_way: list[float] = plain.heights(passed)
                _finite("h on the way to where the action acts", on_the_way)
                self.least_pending = min(self.least_pending, *on_the_way)
            if begin.rows > 1:
                self._plain = plain = MultiStepBarriers(plain, begin.rows, len(state))
                epsilon = [*epsilon] * begin.rows
            self._state, h_now = begin.state, plain.heights(begin.state)
            if begin.at_once and not prediction.remembers:  # it is the state there that decides, and nothing else
                self._begin, self._memory = None, begin.memory
            _finite("h where the action begins to act", h_now)
        self.h_begin = h_now
        """(rows,) h where the action begins to act; several times the barriers where it is judged in several states."""
        self._motion: AffineMotion | None = prediction.affine_motion(self._state, latent) if prediction.affine else None
        share, at_once = 1.0 - eta, barriers.at_once
        if len(epsilon) != len(h_now):
            raise ValueError(f"{len(epsilon)} margins for {len(h_now)} barriers")
        required: list[float] = []
        scales: list[float] = []
        for index in range(len(h_now)):
            margin: float = epsilon[index]
            required.append(margin if at_once[index % len(at_once)] else share * h_now[index] + margin)
            height = abs(h_now[index])
            scales.append(height if height > margin else margin if margin > _TINY else _TINY)
        self.required = required
        self.sizes = scales.copy()
        """(m,) max(|h_i(x)|, epsilon_i)."""
        self.scales = scales
        """(m,) in the unit of each h; of what the actions can change as far as tangents were drawn."""
        self.affine: bool = prediction.affine
        """Whether the predicted state is affine in the action, which then saturates nowhere."""
        self.saturated: bool = False
        """Whether a tangent was drawn where an actuator saturates."""
        self._last_g: list[list[float]] | None = None

    def outcome(self, action: Plain) -> ActionCandidate:
        """What ``action`` (actions,) leads to."""
        following, required, scales = self._following(action), self.required, self.scales
        if not _is_finite(following):
            return self._nothing(action, following)
        h_next: list[float] = self._plain.heights(following)
        if len(h_next) != len(required):
            raise ValueError(f"{len(h_next)} values of h, wanted {len(required)}")
        residual: list[float] = []
        broken: list[int] = []
        total = 0.0
        for index in range(len(required)):
            rest = h_next[index] - required[index]
            total += rest
            residual.append(rest)
            if rest < 0.0 and rest < -ROUNDING * scales[index]:
                broken.append(index)
        if total - total != 0.0 and not _is_finite(h_next):
            return self._nothing(action, following)
        return ActionCandidate(action, following, h_next, residual, broken)

    def _nothing(self, action: Plain, following: Plain) -> ActionCandidate:
        """Of an action for which model or barrier have no finite numbers."""
        lowest = [-inf] * len(self.required)
        return ActionCandidate(action, following, lowest, lowest, list(range(len(lowest))))

    def linearised(self, about: ActionCandidate) -> Linearization:
        """The conditions tangent at ``about``."""
        if self._last_g is None or not self._prediction.affine:
            self._last_g = self._slopes(about)
        return Linearization(self._plain, self._last_g, about.next_state, self._widths, self.scales)

    def tightest(self, found: ActionCandidate) -> float:
        """Least residual, each as a share of its barrier's scale."""
        residual, scales = found.residual, self.scales
        least = residual[0] / scales[0]
        for row in range(1, len(residual)):
            value = residual[row]
            if value < least * scales[row]:
                least = value / scales[row]
        return least

    def active_names(self, found: ActionCandidate, limit: float) -> tuple[str, ...]:
        """Names of the barriers whose residual is ``limit`` of their scale at most, the tightest first."""
        near: list[tuple[float, int]] = []
        scales = self.scales
        for row in range(len(found.residual)):
            value = found.residual[row]
            if value <= limit * scales[row]:
                near.append((value / scales[row], row))
        if not near:
            return ()
        near.sort()
        names = self.barriers.names
        return tuple(dict.fromkeys([names[row % len(names)] for _, row in near]))

    def _slopes(self, about: ActionCandidate) -> list[list[float]]:
        """g (states, actions) about an action."""
        g: list[list[float]]
        if self._motion is not None:
            g = self._motion.slopes()
        elif self._begin is not None:
            g = self._prediction.slopes_after(self._begin, about.action, self._latent)
        else:
            g = self._prediction.slopes_of_one(self._state, about.action, self._latent, self._memory)
        for row in g:
            if not _is_finite(row):
                raise NotFiniteError("g of the model: got NaN or infinity, wanted finite numbers")
        return g if self._prediction.affine else self._unsaturated(g, about)

    def _following(self, action: Plain) -> list[float]:
        found: list[float]
        if self._motion is not None:
            found = self._motion.after(action)
        elif self._begin is not None:
            found = self._prediction.after(self._begin, action, self._latent)
        else:
            found = self._prediction.following(self._state, action, self._latent, self._memory)
        return found

    def _unsaturated(self, g: list[list[float]], about: ActionCandidate) -> list[list[float]]:
        """g with a chord in place of each column that vanishes because the actuator saturates at ``about``.

        A tangent of zero would say that this action does not matter, though its other values do: the chord leads to the
        bound that is further away, unless an earlier tangent knows the slope.
        """
        for index in range(len(about.action)):
            if self._silent(g, index, about.next_state):
                self.saturated = True
                last = self._last_g
                column = self._chord(about, index) if last is None else [row[index] for row in last]
                if not _is_finite(column):
                    continue
                g = [[*row[:index], slope, *row[index + 1 :]] for row, slope in zip(g, column, strict=True)]
        return g

    def _silent(self, g: list[list[float]], column: int, reached: Plain) -> bool:
        width = self._widths[column]
        for row in range(len(g)):
            entry: float = reached[row]
            motion = abs(entry - self._state[row])
            size = abs(entry)
            noise = NO_INFLUENCE * (motion if motion > size else size)
            if not abs(g[row][column]) * width <= noise:
                return False
        return True

    def _chord(self, about: ActionCandidate, index: int) -> list[float]:
        value, (low, high, _) = about.action[index], self._sides[index]
        end = low if value - low > high - value else high
        other = (*about.action[:index], end, *about.action[index + 1 :])
        reached = zip(self._following(other), about.next_state, strict=True)
        return [(there - here) / (end - value) for there, here in reached]


def _smallest(numbers: list[float]) -> float:
    least = numbers[0]
    for value in numbers:
        least = value if value < least else least
    return least


def _finite(what: str, numbers: list[float]) -> None:
    if not _is_finite(numbers):
        raise InputError(f"{what}: got NaN or infinity, wanted finite numbers")


def _is_finite(numbers: list[float]) -> bool:
    total = 0.0
    for value in numbers:
        total += value
    # finite numbers have an infinite sum where they are as large as a float can be
    return total - total == 0.0 or all(map(isfinite, numbers))
