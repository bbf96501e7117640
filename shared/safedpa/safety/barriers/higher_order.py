"""Barriers of higher relative degree, if the derivatives of h along the motion are known.

If the action influences h only through its r-th derivative in time, the filter cannot change h within one step. It can
change the last of

    psi_0 = h,   psi_i = d(psi_{i-1})/dt + alpha_i psi_{i-1},   i = 1 ... r - 1

which has relative degree one. While psi_{r-1} >= 0 is enforced and all psi_i >= 0 held at the start, each psi_{i-1}
falls no faster than at the rate alpha_i and stays positive, down to h. With constant rates

    psi_{r-1} = sum over k of c_k d^k(h)/dt^k,   sum over k of c_k s^k = (s + alpha_1) ... (s + alpha_{r-1}).

Derivatives contain no actuator limits: alpha must be so small that the strongest action can still bend psi. For a mass
with acceleration up to b in front of a wall, alpha v <= b at its largest speed v. The last alpha may be a function
instead, increasing and 0 at 0: sqrt(2 b h) is what a brake of b allows at any distance.
Source: Xiao and Belta, Control Barrier Functions for Systems with High Relative Degree, CDC 2019; High Order Control
Barrier Functions, IEEE Transactions on Automatic Control 67, 2022.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.function import FunctionBarrier
from safedpa.safety.validation import checked_output

__all__ = ["HigherOrderBarrier"]

Rate: TypeAlias = float | Callable[[FloatArray], ArrayLike]


@final
class HigherOrderBarrier(AbstractBarrier):
    """psi_{r-1}(x) >= 0 from ``derivatives`` (h, dh/dt, ... up to r - 1), functions of x (states,) to float or (m,).

    They are derivatives along the motion without the action, and must not depend on it. ``rates`` (r - 1) are alpha_1
    ... in 1 / time, in the derivatives' unit of time, well below 1 / period; the last may be a function of psi_{r-2}
    (m,). ``gradient(x)`` of psi_{r-1} is (states,) or (m, states), if known. The error of sampling in ticks belongs
    into epsilon. Raises InputError if their numbers do not fit, or a rate is not positive.

    Example: a mass before a wall at 1 m, whose acceleration is the action; psi = dh/dt + 2 h.

        >>> wall = safedpa.HigherOrderBarrier([lambda x: 1.0 - x[0], lambda x: -x[1]], rates=[2.0], names=["wall"])
        >>> wall.h(np.array([0.5, 0.25]))
        array([0.75])
    """

    def __init__(
        self,
        derivatives: Sequence[Callable[[FloatArray], ArrayLike]],
        rates: Sequence[Rate],
        gradient: Callable[[FloatArray], ArrayLike] | None = None,
        names: Sequence[str] = ("h",),
        kind: str = "function",
        reads: Sequence[str] = (),
    ) -> None:
        for what, given in (("derivatives", derivatives), ("rates", rates)):
            if not hasattr(given, "__len__"):
                raise InputError(f"{what}: got {type(given).__name__}, wanted a list")
        # Checked here, since a number instead of a function would fail only during a drive.
        if not all(map(callable, derivatives)):
            raise InputError(f"derivatives: got {list(derivatives)!r}, wanted functions of the state")
        if len(derivatives) < 2 or len(rates) != len(derivatives) - 1:
            raise InputError(
                f"rates: got {len(rates)} for {len(derivatives)} derivatives, wanted h and its derivatives up to one "
                "less than the relative degree, and one rate for each but h"
            )
        # Only the last rate may be a function: the recursion above is linear up to there.
        *constant, last = rates
        for rate in (*constant, *(() if callable(last) else (last,))):
            if not isinstance(rate, (int, float, np.number)) or not (isfinite(rate) and rate > 0.0):
                raise InputError(
                    f"rates: got {rate!r}, wanted positive finite numbers; the last alone may be a function"
                )
        self._derivatives, self._last = tuple(derivatives), last
        roots = np.array([-float(rate) for rate in constant if not callable(rate)])
        # The coefficients of (s + alpha_1) ... (s + alpha_{r-2}), lowest power first: psi_{r-2} is one dot product.
        self._inner: FloatArray = np.atleast_1d(np.poly(roots))[::-1].copy()
        """c_k (r - 1,) of psi_{r-2}."""
        self._barrier = FunctionBarrier(self._psi, gradient, names, kind, reads)
        self.names, self.kind, self.reads = self._barrier.names, self._barrier.kind, self._barrier.reads

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self._barrier.h(state)

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        return self._barrier.h_and_grad(state)

    def lie_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:  # noqa: D102
        return self._barrier.lie_derivative(state, directions)

    def _psi(self, state: FloatArray) -> FloatArray:
        # All derivatives at once: psi and its rate of change use the same values.
        known = np.array([checked_output("h", derivative(state)) for derivative in self._derivatives])
        before = np.tensordot(self._inner, known[:-1], axes=1)
        rate_of_change = np.tensordot(self._inner, known[1:], axes=1)  # the same coefficients, one derivative higher
        rate = checked_output("rate", self._last(before)) if callable(self._last) else self._last * before
        return np.asarray(rate_of_change + rate)
