"""The barrier conditions at one state: kept or broken by an action, and linearised about one; in plain numbers."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from typing import Any, final

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractStack
from safedpa.safety.prediction import Prediction
from safedpa.safety.program_rows import Side

__all__ = ["NO_INFLUENCE", "Conditions", "Outcome", "Plain", "Tangent"]

Plain = Sequence[float]

NO_INFLUENCE = 1e-9
"""A column of g this small, relative to the size of the state, is rounding error: the actuator is saturated."""

_ROUNDING = 1e-9
"""Share by which the reach of an action is taken too far, so that no rounding error leaves a row out."""


@final
class Outcome:
    """What the model predicts for one action (actions,)."""

    def __init__(self, action: Plain, next_state: Plain, h_next: list[float], residual: list[float]) -> None:
        self.action, self.next_state, self.h_next = action, next_state, h_next
        self.residual = residual
        """(m,) h_i(x+) - ((1 - eta) h_i(x) + epsilon_i): negative where a condition is broken."""
        self.tightest: float = min(residual)
        """Smallest residual."""
        self.violation: float = max(0.0, -self.tightest)
        """The slack that this action needs: max(0, -min residual)."""

    @property
    def least(self) -> float:
        """Smallest h_i(x+)."""
        return min(self.h_next)


@final
class Tangent:
    """A a >= b tangent at one outcome: h(x+) is taken as h + p'(x - x+) and x as x+ + g (a - about).

    x+ is the predicted state under ``about.action``, g (states, actions), ``widths`` (actions,) the actions' ranges.
    A row's slopes are computed when it is asked for, and only if some action might break it.
    """

    def __init__(self, barriers: AbstractStack, g: Sequence[Plain], about: Outcome, widths: Plain) -> None:
        self._barriers, self._g, self._state = barriers, g, about.next_state
        self._rows: dict[int, list[float]] = {}
        steepest = barriers.steepest(about.next_state)
        self._reach = inf
        """By more than this no action within its range changes a row: sum_kj |p_k| |g_kj| width_j at the most."""
        if steepest is not None:
            reach = 0.0
            for slope, row in zip(steepest, g, strict=True):
                for entry, width in zip(row, widths, strict=True):
                    reach += slope * abs(entry) * width
            self._reach = reach * (1.0 + _ROUNDING) + _ROUNDING

    def at(self, about: Outcome) -> tuple[list[list[float]], list[float]]:
        """A (rows, actions) and b (rows,) of the rows that actions might break, with the true residual at ``about``."""
        residual, action, rows, reach = about.residual, about.action, self._rows, self._reach
        near = [index for index, value in enumerate(residual) if not value >= reach]
        missing = [index for index in near if index not in rows]
        if missing:
            self._add(missing)
        slopes = [rows[index] for index in near]
        limits = []
        for index, row in zip(near, slopes, strict=True):
            total = -residual[index]
            for slope, value in zip(row, action, strict=True):
                total += slope * value
            limits.append(total)
        return slopes, limits

    def _add(self, missing: Sequence[int]) -> None:
        for index, p in zip(missing, self._barriers.slopes(self._state, missing), strict=True):
            row = [0.0] * len(self._g[0])
            for slope, entries in zip(p, self._g, strict=True):
                for column, entry in enumerate(entries):
                    row[column] += slope * entry
            self._rows[index] = row
            if not isfinite(sum(row)):
                _finite("gradient of h", p)


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
        self._state, self._latent, self._memory = state, latent, memory
        self._sides = sides
        self._widths = [width for _, _, width in sides]
        self.h_now: list[float] = barriers.heights(state)
        _finite("h at the state", self.h_now)
        share = 1.0 - eta
        self.required: list[float] = [share * h + margin for h, margin in zip(self.h_now, epsilon, strict=True)]
        self._last_g: list[list[float]] | None = None

    def outcome(self, action: Plain) -> Outcome:
        """What ``action`` (actions,) leads to."""
        following = self._following(action)
        h_next: list[float] = self.barriers.heights(following)
        _finite("h at the predicted state", h_next)
        residual = [h - wanted for h, wanted in zip(h_next, self.required, strict=True)]
        return Outcome(action, following, h_next, residual)

    def linearised(self, about: Outcome) -> Tangent:
        """The conditions tangent at ``about``."""
        if self._last_g is None or not self._prediction.affine:
            self._last_g = self._slopes(about)
        return Tangent(self.barriers, self._last_g, about, self._widths)

    def _slopes(self, about: Outcome) -> list[list[float]]:
        """g (states, actions) about an action."""
        g: list[list[float]] = self._prediction.slopes_of_one(self._state, about.action, self._latent, self._memory)
        for row in g:
            _finite("g of the model", row)
        return self._unsaturated(g, about)

    def _following(self, action: Plain) -> list[float]:
        found: list[float] = self._prediction.following(self._state, action, self._latent, self._memory)
        _finite("predicted state", found)
        return found

    def _unsaturated(self, g: list[list[float]], about: Outcome) -> list[list[float]]:
        """g with a chord in place of each column that vanishes because the actuator saturates at ``about``.

        A tangent of zero would say that this action does not matter, though its other values do: the chord leads to the
        bound that is further away, unless an earlier tangent knows the slope.
        """
        noise = NO_INFLUENCE * (1.0 + max(map(abs, about.next_state)))
        for index in range(len(about.action)):
            if all(-noise <= row[index] <= noise for row in g):
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


def _finite(what: str, numbers: Plain) -> None:
    if not isfinite(sum(numbers)) and not all(map(isfinite, numbers)):
        raise InputError(f"{what}: got NaN or infinity, wanted finite numbers")
