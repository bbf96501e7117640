"""``BackingOff`` for many cars that tick at the same moments."""

from __future__ import annotations

import math
from collections import deque
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.policy.backing_off import BackingOffSettings

__all__ = ["BackingOffTogether"]

Values = NDArray[np.float64]

_NEVER = np.iinfo(np.int64).max


@final
class BackingOffTogether:
    """Hands on the wishes of cars (cars, 2), and interrupts those of cars that make no headway, as ``BackingOff``."""

    def __init__(self, cars: int, settings: BackingOffSettings | None = None) -> None:
        self._settings = settings or BackingOffSettings()
        self._trail: deque[tuple[float, Values]] = deque()
        self._first = 0
        """Number of the tick that the trail begins with."""
        self._tick = 0
        self._since = np.full(cars, _NEVER)
        """Number of the tick since which a car's headway is watched."""
        self._until = np.full(cars, -math.inf)
        self._steer, self._attempts = np.zeros(cars), np.zeros(cars, dtype=np.int64)
        self._goal = np.full((cars, 2), np.nan)

    def wishes(self, now: float, state: Values, goal: Values, wish: Values) -> Values:
        """The wishes (cars, 2) at the time ``now`` [s], for states (cars, 4) and goals (cars, 2)."""
        settings = self._settings
        fresh = (goal != self._goal).any(axis=1)
        self._goal[fresh], self._attempts[fresh], self._until[fresh] = goal[fresh], 0, -math.inf
        self._since[fresh] = _NEVER
        watched = now >= self._until
        self._since[watched & (self._since == _NEVER)] = self._tick
        self._begin(np.flatnonzero(watched & self._are_held(now, state)), now, state)
        self._tick += 1
        backing = np.column_stack([np.full(len(wish), settings.reverse_speed), self._steer])
        return np.where((now >= self._until)[:, None], wish, backing)

    def _begin(self, held: NDArray[np.int64], now: float, state: Values) -> None:
        x, y, yaw = state[held, 0], state[held, 1], state[held, 2]
        aside = np.sin(np.arctan2(self._goal[held, 1] - y, self._goal[held, 0] - x) - yaw)
        towards = np.where(aside >= 0.0, -1.0, 1.0) * np.where(self._attempts[held] % 2 == 0, 1.0, -1.0)
        self._steer[held] = towards * self._settings.steer
        self._attempts[held] += 1
        self._until[held] = now + self._settings.back_off_seconds
        self._since[held] = _NEVER

    def _are_held(self, now: float, state: Values) -> NDArray[np.bool_]:
        """Which cars have gone less than the headway for as long as the patience, shape (cars,)."""
        settings = self._settings
        self._trail.append((now, state[:, :2].copy()))
        while now - self._trail[0][0] > settings.patience_seconds:
            self._trail.popleft()
            self._first += 1
        times, places = zip(*self._trail, strict=True)
        oldest = np.minimum(np.maximum(self._since - self._first, 0), len(times) - 1)
        way = state[:, :2] - np.stack(places)[oldest, np.arange(len(state))]
        long_enough = now - np.array(times)[oldest] >= 0.9 * settings.patience_seconds
        return np.asarray(long_enough & (np.hypot(way[:, 0], way[:, 1]) < settings.headway))
