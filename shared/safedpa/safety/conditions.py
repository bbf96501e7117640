"""The barrier conditions at one state: kept or broken by an action, and linearised about one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractStack
from safedpa.safety.inputs import all_finite
from safedpa.safety.prediction import Prediction

__all__ = ["NO_INFLUENCE", "Conditions", "Outcome", "limits"]

Values = NDArray[np.float64]

NO_INFLUENCE = 1e-9
"""A column of g this small, relative to the size of the state, is rounding error: the actuator is saturated."""


@final
@dataclass(frozen=True, eq=False)
class Outcome:
    """What the model predicts for one action."""

    action: Values
    next_state: Values
    h_next: Values
    residual: Values
    """(m,) h_i(x+) - ((1 - eta) h_i(x) + epsilon_i): negative where a condition is broken."""

    @cached_property
    def tightest(self) -> float:
        """Smallest residual."""
        return float(min(self.residual.tolist()))

    @property
    def violation(self) -> float:
        """The slack that this action needs: max(0, -min residual)."""
        return max(0.0, -self.tightest)

    @property
    def least(self) -> float:
        """Smallest h_i(x+)."""
        return float(min(self.h_next.tolist()))


@final
class Conditions:
    """h_i(x[t+1]) >= (1 - eta) h_i(x[t]) + epsilon_i for every barrier i, at one state and latent.

    ``low`` and ``high`` (actions,) are the actuator bounds.

    Raises InputError when a barrier or the model returns a wrong shape or a number that is not finite.
    """

    def __init__(
        self,
        barriers: AbstractStack,
        prediction: Prediction,
        state: Values,
        latent: Values | None,
        memory: Any,
        eta: float,
        epsilon: Values,
        low: Values,
        high: Values,
    ) -> None:
        self.barriers, self._prediction = barriers, prediction
        self._state, self._latent, self._memory = state, latent, memory
        self._low, self._high = low, high
        self.h_now = _finite("h at the state", barriers.values(state), (len(barriers.names),))
        self.required = (1.0 - eta) * self.h_now + epsilon
        self._last_g: Values | None = None

    def outcome(self, action: Values) -> Outcome:
        """What ``action`` (actions,) leads to."""
        following = self._prediction.next_state(self._state, action, self._latent, self._memory)
        _finite("predicted state", following, self._state.shape)
        h_next = _finite("h at the predicted state", self.barriers.values(following), self.required.shape)
        return Outcome(action, following, h_next, h_next - self.required)

    def linearised(self, about: Outcome) -> tuple[Values, Values]:
        """A (m, actions), b (m,): the conditions A a >= b, tangent at ``about.action``.

        h(x+) is taken as h + p'(x - x+) and x as x+ + g (a - about), x+ the predicted state under ``about``.
        """
        A = self._slopes(about)
        return A, limits(A, about)

    def _slopes(self, about: Outcome) -> Values:
        g = self._prediction.slopes(self._state, about.action, self._latent, self._memory)
        _finite("g of the model", g, (len(self._state), len(about.action)))
        p = self.barriers.gradient(about.next_state)
        _finite("gradient of h", p, (len(self.required), len(self._state)))
        return np.asarray(p.dot(self._unsaturated(g, about)))

    def _unsaturated(self, g: Values, about: Outcome) -> Values:
        """g with a chord in place of each column that vanishes because the actuator saturates at ``about``.

        A tangent of zero would say that this action does not matter, though its other values do: the chord leads to the
        bound that is further away, unless an earlier tangent knows the slope.
        """
        noise = NO_INFLUENCE * (1.0 + _largest(about.next_state))
        columns = enumerate(zip(*g.tolist(), strict=True))
        silent = [index for index, column in columns if max(column) <= noise and min(column) >= -noise]
        if silent:
            g = g.copy()
            for index in silent:
                g[:, index] = self._chord(about, index) if self._last_g is None else self._last_g[:, index]
        self._last_g = g
        return g

    def _chord(self, about: Outcome, index: int) -> Values:
        value, low, high = about.action[index], self._low[index], self._high[index]
        other = about.action.copy()
        other[index] = low if value - low > high - value else high
        following = self._prediction.next_state(self._state, other, self._latent, self._memory)
        _finite("predicted state", following, self._state.shape)
        return np.asarray((following - about.next_state) / (other[index] - value))


def limits(A: Values, about: Outcome) -> Values:
    """b (m,) of A a >= b for slopes A (m, actions) and the true residual at ``about``."""
    return np.asarray(A.dot(about.action) - about.residual)


def _largest(vector: Values) -> float:
    """Of the absolute values."""
    return float(max(map(abs, vector.tolist())))


def _finite(what: str, array: Values, shape: tuple[int, ...]) -> Values:
    if array.shape != shape:
        raise InputError(f"{what}: got shape {array.shape}, wanted {shape}")
    if not all_finite(array):
        raise InputError(f"{what}: got NaN or infinity, wanted finite numbers")
    return array
