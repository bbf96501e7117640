"""The barrier conditions at one state: kept or broken by an action, and linearised about one; in plain numbers."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from typing import Any, Final, final

from safedpa.errors import InputError
from safedpa.safety.affine_motion import AffineMotion
from safedpa.safety.barrier import AbstractStack
from safedpa.safety.on_its_way import Along
from safedpa.safety.prediction import Prediction
from safedpa.safety.program_rows import Side

__all__ = ["NO_INFLUENCE", "Conditions", "Outcome", "Plain", "Tangent", "smallest"]

Plain = Sequence[float]

NO_INFLUENCE: Final = 1e-9
"""A column of g this small, relative to the size of the state, is rounding error: the actuator is saturated."""

_ROUNDING: Final = 1e-9
"""Share by which the reach of an action is taken too far, so that no rounding error leaves a row out."""


@final
class Outcome:
    """What the model predicts for one action (actions,)."""

    def __init__(
        self, action: Plain, next_state: Plain, h_next: list[float], residual: list[float], pending: float = inf
    ) -> None:
        self.action, self.next_state, self.h_next, self._pending = action, next_state, h_next, pending
        self.residual = residual
        """(m,) h_i(x+) - ((1 - eta) h_i(x) + epsilon_i): negative where a condition is broken."""
        tightest = residual[0]
        for value in residual:
            tightest = value if value < tightest else tightest
        self.tightest: float = tightest
        """Smallest residual."""
        self.violation: float = -tightest if tightest < 0.0 else 0.0
        """The slack that this action needs: max(0, -min residual)."""

    @property
    def least(self) -> float:
        """Smallest h_i(x+), and on the way to where the action begins to act."""
        least = smallest(self.h_next)
        return self._pending if self._pending < least else least

    def binding(self, names: tuple[str, ...], limit: float) -> tuple[str, ...]:
        """Of ``names`` (m,) those whose residual is ``limit`` at most, the tightest first."""
        if self.tightest > limit:
            return ()
        found = [(value, index) for index, value in enumerate(self.residual) if value <= limit]
        found.sort()
        return tuple(dict.fromkeys([names[index % len(names)] for _, index in found]))


@final
class Tangent:
    """A a >= b tangent at one outcome: h(x+) is taken as h + p'(x - x+) and x as x+ + g (a - about).

    x+ is the predicted state under ``about.action``, g (states, actions), ``widths`` (actions,) the actions' ranges.
    ``barriers`` have ``slopes`` and ``steepest``. A row's slopes are computed when it is asked for, and only if some
    action might break it.
    """

    def __init__(self, barriers: Any, g: list[list[float]], about: Outcome, widths: list[float]) -> None:
        self._barriers, self._g, self._state = barriers, g, about.next_state
        self._rows: dict[int, list[float]] = {}
        self._reach = inf
        """By more than this no action within its range changes a row: sum_kj |p_k| |g_kj| width_j at the most."""
        steepest = barriers.steepest(about.next_state)
        if steepest is not None:
            self._reach = self._furthest(steepest, widths) * (1.0 + _ROUNDING) + _ROUNDING

    def at(self, about: Outcome) -> tuple[list[list[float]], list[float]]:
        """A (rows, actions) and b (rows,) of the rows that actions might break, with the true residual at ``about``."""
        residual, action, rows, reach = about.residual, about.action, self._rows, self._reach
        near: list[int] = []
        missing: list[int] = []
        for index in range(len(residual)):
            if not residual[index] >= reach:
                near.append(index)
                if index not in rows:
                    missing.append(index)
        if missing:
            self._add(missing)
        slopes: list[list[float]] = []
        limits: list[float] = []
        for index in near:
            row = rows[index]
            total = -residual[index]
            for column in range(len(row)):
                value: float = action[column]
                total += row[column] * value
            slopes.append(row)
            limits.append(total)
        return slopes, limits

    def _furthest(self, steepest: Plain, widths: list[float]) -> float:
        g, reach = self._g, 0.0
        if len(steepest) != len(g):
            raise ValueError(f"the model has slopes of {len(g)} states, the barriers of {len(steepest)}")
        for index in range(len(g)):
            slope: float = steepest[index]
            row = g[index]
            for column in range(len(row)):
                reach += slope * abs(row[column]) * widths[column]
        return reach

    def _add(self, missing: list[int]) -> None:
        g, states = self._g, len(self._g)
        found: Sequence[Plain] = self._barriers.slopes(self._state, missing)
        for place in range(len(missing)):
            p = found[place]
            if len(p) != states:
                raise ValueError(f"h has slopes of {len(p)} states, the model of {states}")
            row = [0.0] * len(g[0])
            total = 0.0
            for state in range(states):
                slope: float = p[state]
                entries = g[state]
                for column in range(len(row)):
                    share = slope * entries[column]
                    row[column] += share
                    total += share
            self._rows[missing[place]] = row
            if total - total != 0.0:
                _refuse_infinite("gradient of h", list(p))


@final
class Conditions:
    """h_i(x[t+1]) >= (1 - eta) h_i(x[t]) + epsilon_i for every barrier i, at one state and latent.

    ``sides`` (actions,) are lowest value, highest value and range of each action.

    Raises InputError when a barrier or the model returns a wrong shape or a number that is not finite.
    """

    def __init__(
        self,
        barriers: AbstractStack,
        prediction: Prediction,
        state: tuple[float, ...],
        latent: tuple[float, ...] | None,
        memory: Any,
        eta: float,
        epsilon: Plain,
        sides: Sequence[Side],
    ) -> None:
        self.barriers, self._prediction = barriers, prediction
        plain = barriers.plain(len(state))
        self._plain: Any = plain
        self._state, self._latent, self._memory = state, latent, memory
        self._sides = sides
        self._widths: list[float] = [width for _, _, width in sides]
        h_now: list[float] = plain.heights(state)
        self.h_now = h_now
        _finite("h at the state", h_now)
        self._begin = begin = prediction.begin(state, latent, memory)
        self._pending = inf
        """Smallest h on the way to where an action begins to act, which no action can change."""
        if begin is not None:
            for passed in begin.path:
                self._pending = min(self._pending, smallest(plain.heights(passed)))
            if begin.rows > 1:
                self._plain = plain = Along(plain, begin.rows, len(state))
                epsilon = [*epsilon] * begin.rows
            self._state, h_now = begin.state, plain.heights(begin.state)
            _finite("h where the action begins to act", h_now)
        self._motion: AffineMotion | None = prediction.affine_motion(self._state, latent) if prediction.affine else None
        share = 1.0 - eta
        if len(epsilon) != len(h_now):
            raise ValueError(f"{len(epsilon)} margins for {len(h_now)} barriers")
        required: list[float] = []
        for index in range(len(h_now)):
            margin: float = epsilon[index]
            required.append(share * h_now[index] + margin)
        self.required = required
        self._last_g: list[list[float]] | None = None

    def outcome(self, action: Plain) -> Outcome:
        """What ``action`` (actions,) leads to."""
        following = self._following(action)
        h_next: list[float] = self._plain.heights(following)
        _finite("h at the predicted state", h_next)
        required = self.required
        if len(h_next) != len(required):
            raise ValueError(f"{len(h_next)} values of h, wanted {len(required)}")
        residual: list[float] = []
        for index in range(len(required)):
            residual.append(h_next[index] - required[index])
        return Outcome(action, following, h_next, residual, self._pending)

    def linearised(self, about: Outcome) -> Tangent:
        """The conditions tangent at ``about``."""
        if self._last_g is None or not self._prediction.affine:
            self._last_g = self._slopes(about)
        return Tangent(self._plain, self._last_g, about, self._widths)

    def _slopes(self, about: Outcome) -> list[list[float]]:
        """g (states, actions) about an action."""
        g: list[list[float]]
        if self._motion is not None:
            g = self._motion.slopes()
        elif self._begin is not None:
            g = self._prediction.slopes_after(self._begin, about.action, self._latent)
        else:
            g = self._prediction.slopes_of_one(self._state, about.action, self._latent, self._memory)
        for row in g:
            _finite("g of the model", row)
        return self._unsaturated(g, about)

    def _following(self, action: Plain) -> list[float]:
        found: list[float]
        if self._motion is not None:
            found = self._motion.after(action)
        elif self._begin is not None:
            found = self._prediction.after(self._begin, action, self._latent)
        else:
            found = self._prediction.following(self._state, action, self._latent, self._memory)
        _finite("predicted state", found)
        return found

    def _unsaturated(self, g: list[list[float]], about: Outcome) -> list[list[float]]:
        """g with a chord in place of each column that vanishes because the actuator saturates at ``about``.

        A tangent of zero would say that this action does not matter, though its other values do: the chord leads to the
        bound that is further away, unless an earlier tangent knows the slope.
        """
        largest = 0.0
        for value in about.next_state:
            size = abs(value)
            largest = size if size > largest else largest
        noise = NO_INFLUENCE * (1.0 + largest)
        for index in range(len(about.action)):
            if _silent(g, index, noise):
                last = self._last_g
                column = self._chord(about, index) if last is None else [row[index] for row in last]
                g = [[*row[:index], slope, *row[index + 1 :]] for row, slope in zip(g, column, strict=True)]
        return g

    def _chord(self, about: Outcome, index: int) -> list[float]:
        value, (low, high, _) = about.action[index], self._sides[index]
        end = low if value - low > high - value else high
        other = (*about.action[:index], end, *about.action[index + 1 :])
        reached = zip(self._following(other), about.next_state, strict=True)
        return [(there - here) / (end - value) for there, here in reached]


def smallest(numbers: list[float]) -> float:
    """Of one number at least."""
    least = numbers[0]
    for value in numbers:
        least = value if value < least else least
    return least


def _silent(g: list[list[float]], column: int, noise: float) -> bool:
    for row in g:  # noqa: SIM110 - no generator for every column
        if not -noise <= row[column] <= noise:
            return False
    return True


def _finite(what: str, numbers: list[float]) -> None:
    total = 0.0
    for value in numbers:
        total += value
    if total - total != 0.0:
        _refuse_infinite(what, numbers)


def _refuse_infinite(what: str, numbers: list[float]) -> None:
    """Finite numbers have an infinite sum where they are as large as a float can be."""
    if not all(map(isfinite, numbers)):
        raise InputError(f"{what}: got NaN or infinity, wanted finite numbers")
