"""A barrier at a point ahead of the robot, so that turning moves h.

A robot that drives where it points (unicycle, differential drive, boat) cannot move sideways: the turn rate moves no
plain distance within one tick, and a filter with that barrier can only brake, until the robot creeps to rest in front
of an obstacle that it could drive around. With p = position + l (cos yaw, sin yaw)

    H(x) = h(x with p as its position) - l

depends on yaw. If h changes by at most 1 per metre of position, as a distance does, H >= 0 implies h >= 0.
Source: Cortez and Dimarogonas, Correct-by-design control barrier functions for Euler-Lagrange systems, 2020; the point
itself is that of input-output linearisation of a unicycle.
"""

from __future__ import annotations

from typing import final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier

__all__ = ["LookAheadBarrier"]


@final
class LookAheadBarrier(AbstractBarrier):
    """H(x) = h at the point ``ahead`` [m] > 0 in front, less ``ahead``; see the module's equation.

    ``barrier`` is h, in metres, of a position; ``x``, ``y``, ``yaw`` are the indices of position and heading [rad] in
    the state. Passages become narrower by 2 ``ahead``, so choose it small: a fifth of the robot's length, say. Raises
    InputError for a distance that is not positive and finite.

    >>> disc = safedpa.FunctionBarrier(lambda s: float(np.hypot(s[0] - 2.0, s[1])) - 0.5)
    >>> safedpa.LookAheadBarrier(disc, 0.2).h(np.array([0.0, 0.0, 0.0])).round(3).tolist()
    [1.1]
    """

    def __init__(self, barrier: AbstractBarrier, ahead: float, x: int = 0, y: int = 1, yaw: int = 2) -> None:
        if not isinstance(barrier, AbstractBarrier):
            raise InputError(f"barrier: got {type(barrier).__name__}, wanted a barrier such as FunctionBarrier(h)")
        if not 0.0 < ahead < np.inf:
            raise InputError(f"ahead: got {ahead!r}, wanted a finite number of metres > 0")
        self.names, self.kind, self.reads = barrier.names, barrier.kind, barrier.reads
        self._barrier, self._ahead, self._entries = barrier, float(ahead), (x, y, yaw)

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        # The robot itself may be nearer to the obstacle than the point, by at most their distance ``ahead``.
        return np.asarray(self._barrier.h(self._moved(state))) - self._ahead

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        x, y, yaw = self._entries
        h, gradient = self._barrier.h_and_grad(self._moved(state))
        gradient = np.array(gradient)  # a copy: the barrier may return an array that it uses again
        turned = self._ahead * (-np.sin(state[yaw]) * gradient[:, x] + np.cos(state[yaw]) * gradient[:, y])
        # Added to the barrier's own derivative, since h may depend on the heading as well.
        gradient[:, yaw] += turned
        return np.asarray(h) - self._ahead, gradient

    def _moved(self, state: FloatArray) -> FloatArray:
        x, y, yaw = self._entries
        moved = state.copy()
        moved[x] += self._ahead * np.cos(state[yaw])
        moved[y] += self._ahead * np.sin(state[yaw])
        return moved
