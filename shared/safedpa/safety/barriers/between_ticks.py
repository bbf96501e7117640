"""A bound of h between two ticks, for an h that is flat, truncated or of unknown shape there.

If |h(x) - h(y)| <= |L o (x - y)|_2 for all states (o: entry by entry), then h on the straight chord from x to x+ is at
least

    (h(x) + h(x+) - |L o (x+ - x)|_2) / 2

(Piyavskii 1972, Shubert 1972). The filter requires that this bound is at least epsilon, in addition to its condition at
the ticks. How far the true path leaves the chord, up to acceleration x period^2 / 8, belongs into epsilon.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.function import FunctionBarrier
from safedpa.safety.validation import checked_output

__all__ = ["LipschitzBarrier"]


@final
class LipschitzBarrier(AbstractBarrier):
    """h(x) >= 0 at the ticks and, by a Lipschitz bound, between them.

    ``h``: a function of the state (states,) to float or (m,), with ``names`` and ``kind``, or another barrier.
    ``lipschitz`` (states,) >= 0 is L: 1 / unit of the entry, in units of h. For a distance to obstacles in metres it is
    (1, 1, 0, ...): 1 for x and y. ``largest_step`` (units of L o x) > 0 is the alternative if h has no bound, such as
    an occupancy map: the state may move by at most that much in one tick, which is then the thinnest obstacle that is
    seen. Rows: h at the ticks, then the bound between them.

    Raises InputError for bounds that are negative, not finite or all 0, and at evaluation for another number of states.

    >>> wall = safedpa.LipschitzBarrier(lambda x: min(1.0 - x[0], 0.1), lipschitz=(1.0, 0.0))
    >>> wall.starting_at(np.array([0.0, 0.0])).h(np.array([0.5, 0.0])).round(3).tolist()
    [0.1, -0.15]
    """

    def __init__(
        self,
        h: Callable[[FloatArray], ArrayLike] | AbstractBarrier,
        lipschitz: ArrayLike,
        largest_step: float | None = None,
        names: Sequence[str] = ("h",),
        kind: str = "function",
        *,
        reads: Sequence[str] = (),
    ) -> None:
        own = h if isinstance(h, AbstractBarrier) else FunctionBarrier(h, names=names, kind=kind, reads=reads)
        self.bound = checked_output("lipschitz", lipschitz)
        if (
            self.bound.ndim != 1
            or not np.isfinite(self.bound).all()
            or (self.bound < 0.0).any()
            or not self.bound.any()
        ):
            raise InputError(f"lipschitz: got {lipschitz!r}, wanted (states,) finite numbers >= 0, not all 0")
        if largest_step is not None and not (np.isfinite(largest_step) and largest_step > 0.0):
            raise InputError(f"largest_step: got {largest_step!r}, wanted a finite number > 0")
        self.largest_step = largest_step
        self.kind, self.reads = own.kind, own.reads
        self.names = (*own.names, *(f"{name} between ticks" for name in own.names))
        # The share eta of h may not be used up at the ticks; between them the whole of h may.
        self.at_once = (False,) * len(own.names) + (True,) * len(own.names)
        self.at_ticks = own

    def h(self, state: FloatArray) -> FloatArray:
        """h (2m,) of a state that is not moving: both rows are h."""
        return np.tile(self._h(state), 2)

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (2m,) and its gradient (2m, states) of a state that is not moving."""
        h, gradient = self.at_ticks.h_and_grad(state)
        return np.tile(h, 2), np.tile(gradient, (2, 1))

    def lie_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """As in every barrier, by h's own way of differencing."""
        return np.tile(self.at_ticks.lie_derivative(state, directions), (2, 1))

    def starting_at(self, state: FloatArray) -> AbstractBarrier:
        """Returns the barrier for states one tick after ``state``."""
        if len(state) != len(self.bound):
            raise InputError(f"lipschitz: got {len(self.bound)} numbers for {len(state)} states, wanted as many")
        # A copy: the origin must not change if the caller writes the next state into the same array.
        return _LipschitzFrom(self, np.array(state), self._h(state))

    def _h(self, state: FloatArray) -> FloatArray:
        return checked_output("h", self.at_ticks.h(state))


@final
class _LipschitzFrom(AbstractBarrier):
    """A ``LipschitzBarrier`` for states one tick after ``origin``, where h is ``h_origin`` (m,)."""

    def __init__(self, barrier: LipschitzBarrier, origin: FloatArray, h_origin: FloatArray) -> None:
        self.names, self.kind, self.reads, self.at_once = barrier.names, barrier.kind, barrier.reads, barrier.at_once
        self._barrier, self._origin, self._h_origin = barrier, origin, h_origin

    def h(self, state: FloatArray) -> FloatArray:
        h = checked_output("h", self._barrier.at_ticks.h(state))
        return np.concatenate([h, self._between(h, float(np.linalg.norm(self._motion(state))))])

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.h(state), self._with_chord(self._barrier.at_ticks.h_and_grad(state)[1], self._chord_gradient(state))

    def lie_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        own = self._barrier.at_ticks.lie_derivative(state, directions)
        return self._with_chord(own, self._chord_gradient(state) @ directions)

    def _with_chord(self, own: FloatArray, chord: FloatArray) -> FloatArray:
        """Derivatives (2m, n) from those of h (m, n) and of the chord's length (n,)."""
        # With ``largest_step`` the bound contains no h, so every row has the slope of the chord's length alone.
        between = 0.5 * (own - chord) if self._barrier.largest_step is None else np.tile(-chord, (len(own), 1))
        return np.concatenate([own, between])

    def _chord_gradient(self, state: FloatArray) -> FloatArray:
        """d|L o (x+ - x)|/d(x+) (states,); 0 at rest, between the one-sided derivatives of the kink there."""
        motion = self._motion(state)
        length = float(np.linalg.norm(motion))
        return self._barrier.bound * motion / length if length > 0.0 else np.zeros(len(state))

    def _motion(self, state: FloatArray) -> FloatArray:
        return self._barrier.bound * (state - self._origin)

    def _between(self, h: FloatArray, length: float) -> FloatArray:
        if self._barrier.largest_step is None:
            return 0.5 * (self._h_origin + h - length)
        return np.full(len(h), self._barrier.largest_step - length)
