"""``StoppingBarrier`` around many robots at once: the same rooms and slopes, the robots first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.many_barriers import AbstractManyBarriers
from safedpa.safety.stopping_barrier import (
    ALIKE,
    ENDS,
    NUDGE,
    Motion,
    StoppingBarrier,
    nearer_end,
    stopping_path,
    stopping_room,
)

__all__ = ["ManyStopping"]

Values = NDArray[np.float64]
Indices = NDArray[np.intp]


@final
class ManyStopping(AbstractManyBarriers):
    """h (robots, hazards) among ``hazards`` (robots, m, 3): x, y, radius [m]; ``motion`` as in ``stopping_path``."""

    reads = StoppingBarrier.reads

    def __init__(self, hazards: Values, motion: Motion) -> None:
        self.hazards, self._motion = hazards, motion
        self.kinds = (StoppingBarrier.kind,) * hazards.shape[1]

    def __len__(self) -> int:
        return len(self.hazards)

    def only(self, which: Indices) -> ManyStopping:  # noqa: D102
        return ManyStopping(self.hazards[which], self._motion.of(which))

    def one(self, robot: int) -> Sequence[AbstractBarrier]:  # noqa: D102
        return [StoppingBarrier(self.hazards[robot], self._motion.of(robot))]

    def motion_of(self, robot: int) -> Motion:
        """What is known of how that robot moves."""
        return self._motion.of(robot)

    def values(self, state: Values) -> Values:  # noqa: D102
        return self.best(state)[0]

    def best(self, state: Values) -> tuple[Values, Values]:
        """h (robots, hazards) with the end first that leaves more room, and that end (robots,)."""
        everybody = np.arange(len(state))
        both = np.concatenate((everybody, everybody))
        rooms = self._rooms(state[both], both, np.repeat(ENDS, len(state)))
        first, second = rooms[: len(state)], rooms[len(state) :]
        more = second.min(axis=1) - first.min(axis=1) if rooms.shape[1] else np.zeros(len(state))
        nose = np.where(np.abs(more) > ALIKE, more < 0.0, nearer_end(state.T, self._motion) > 0.0)
        return np.where(nose[:, np.newaxis], first, second), np.where(nose, *ENDS)

    def along(self, state: Values, g: Values, widths: Values) -> Values:  # noqa: D102
        robots, states = state.shape
        _, end = self.best(state)
        around = np.repeat(state[:, np.newaxis], 2 * states, axis=1)
        index = np.arange(states)
        around[:, index, index] += NUDGE
        around[:, states + index, index] -= NUDGE
        which = np.repeat(np.arange(robots), 2 * states)
        rooms = self._rooms(around.reshape(-1, states), which, end[which]).reshape(robots, 2, states, -1)
        gradient = (rooms[:, 0] - rooms[:, 1]).swapaxes(1, 2) / (2.0 * NUDGE)
        return np.asarray(gradient @ g)

    def _rooms(self, state: Values, which: Indices, end: Values) -> Values:
        """h (n, hazards) at states (n, states) of the robots ``which``, the manoeuvre begun with those ends."""
        hazards = self.hazards[which]
        path = stopping_path(state.T, self._motion.of(which), end)
        return stopping_room(path, hazards[..., :2], hazards[..., 2])
