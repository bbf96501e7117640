"""The car's barriers in one go: obstacles, field and speed limits over plain numbers."""

from __future__ import annotations

from collections.abc import Sequence
from operator import is_
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.barrier import AbstractBarrier, AbstractStack, Barriers
from safedpa.safety.car_geometry import CarGeometry
from safedpa.safety.compatibility import check_reads
from safedpa.safety.field_barrier import FieldBarrier
from safedpa.safety.obstacle_barrier import ObstacleBarrier
from safedpa.safety.speed_barrier import SpeedBarrier

__all__ = ["CarStack", "Stacks", "stacked"]

Values = NDArray[np.float64]

_STATES, _SPEED = 4, 3


def stacked(parts: Sequence[AbstractBarrier]) -> AbstractStack:
    """The quickest stack of these barriers, in this order: ``CarStack`` for those of ``car_barriers``.

    Any others are asked one by one, which is the reference.
    """
    if isinstance(parts, AbstractStack):
        return parts
    if len(parts) in (2, 3):
        obstacles, field, speed = parts[0], parts[1] if len(parts) == 3 else None, parts[-1]
        if (
            isinstance(obstacles, ObstacleBarrier)
            and (field is None or isinstance(field, FieldBarrier))
            and isinstance(speed, SpeedBarrier)
            and (field is None or field.body == obstacles.body)
            and speed.index == _SPEED
        ):
            return CarStack(obstacles, field, speed)
    return Barriers(parts)


@final
class Stacks:
    """``stacked`` for parts that are mostly those of the last tick: their stack is kept.

    ``states`` are the names of the state's entries; empty: not known.
    """

    def __init__(self, states: Sequence[str] = ()) -> None:
        self._states = tuple(states)
        self._entries = -1
        self._last: AbstractStack = Barriers(())
        self._given: AbstractStack = self._last

    def of(self, parts: Sequence[AbstractBarrier], entries: int) -> AbstractStack:
        """The stack of just these objects, for a state with so many entries.

        Raises InputError for one that is no barrier, or reads other states.
        """
        if entries != self._entries:
            self._last, self._given, self._entries = Barriers(()), Barriers(()), entries
        if parts is self._given:
            return parts
        if isinstance(parts, AbstractStack):
            check_reads(parts.parts, self._states, entries)
            self._given = parts
            return parts
        known = self._last.parts
        if len(parts) != len(known) or not all(map(is_, parts, known)):
            check_reads(parts, self._states, entries)
            self._last = stacked(parts)
        return self._last


@final
class CarStack(AbstractStack):
    """Obstacles, field and speed limits of one body, with the same numbers as one by one, to rounding."""

    def __init__(self, obstacles: ObstacleBarrier, field: FieldBarrier | None, speed: SpeedBarrier) -> None:
        super().__init__((obstacles, speed) if field is None else (obstacles, field, speed))
        walls = None if field is None else (field.low_x, field.high_x, field.low_y, field.high_y)
        places = list(zip(*obstacles.centres.tolist(), obstacles.reach.tolist(), strict=True))
        self._geometry = CarGeometry(
            places,
            walls,
            (speed.low, speed.high),
            (obstacles.rear, obstacles.front),
            obstacles.braking,
            obstacles.towed,
        )

    def values(self, state: Values) -> Values:  # noqa: D102
        if state.shape != (_STATES,):
            return self.one_by_one.values(state)
        return np.array(self._geometry.heights(state.tolist()))

    def gradient(self, state: Values) -> Values:  # noqa: D102
        if state.shape != (_STATES,):
            return self.one_by_one.gradient(state)
        return np.array(self._geometry.slopes(state.tolist(), range(len(self.names))))

    def heights(self, state: Sequence[float]) -> list[float]:  # noqa: D102
        return self._geometry.heights(state) if len(state) == _STATES else super().heights(state)

    def slopes(self, state: Sequence[float], rows: Sequence[int]) -> Sequence[Sequence[float]]:  # noqa: D102
        return self._geometry.slopes(state, rows) if len(state) == _STATES else super().slopes(state, rows)

    def steepest(self, state: Sequence[float]) -> Sequence[float] | None:  # noqa: D102
        return self._geometry.steepest(state) if len(state) == _STATES else None

    def plain(self, states: int) -> CarGeometry | CarStack:  # noqa: D102
        return self._geometry if states == _STATES else self
