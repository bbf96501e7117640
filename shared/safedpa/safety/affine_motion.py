"""A model that is affine in the action, at one state: where any action leads is a few products of known numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

__all__ = ["AffineMotion"]

_IMAGINARY = 1e-30
"""As ``_IMAGINARY`` of ``safedpa.dynamics.tangent``: with it the slopes are those of complex steps to the last bit."""


@final
class AffineMotion:
    """x[t+1] = x + period (f + g a) / trained_period, in the order in which the recorded equations compute it.

    ``known`` holds f (states,), then g (states, actions) row by row, for one state x (states,).
    """

    def __init__(self, state: tuple[float, ...], known: list[float], period: float, trained_period: float) -> None:
        self._state, self._known = state, known
        self._period, self._trained_period = period, trained_period
        self._actions = len(known) // len(state) - 1

    def after(self, action: Sequence[float]) -> list[float]:
        """x[t+1] (states,) under ``action`` (actions,)."""
        known, state, actions = self._known, self._state, self._actions
        states = len(state)
        place = states
        reached: list[float] = []
        for row in range(states):
            felt = 0.0
            for column in range(actions):
                felt += known[place] * action[column]
                place += 1
            reached.append(state[row] + self._period * ((known[row] + felt) / self._trained_period))
        return reached

    def slopes(self) -> list[list[float]]:
        """d(x[t+1])/d(a) (states, actions), the same about every action."""
        known, actions = self._known, self._actions
        place = len(self._state)
        rows: list[list[float]] = []
        for _ in range(len(self._state)):
            row: list[float] = []
            for _ in range(actions):
                nudge = self._period * (known[place] * _IMAGINARY / self._trained_period)
                row.append(nudge / _IMAGINARY)
                place += 1
            rows.append(row)
        return rows
