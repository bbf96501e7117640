"""The tangent of a step at an action: (f, g) with step(a) = f + g a, by the road that fits the numbers."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics.dynamics import Array
from safedpa.dynamics.straight_tangent import IMAGINARY
from safedpa.operations import COMPLEX, FLOATS, Operations

__all__ = ["batched_difference", "complex_step", "forward_mode", "intercept", "single_tangent"]

_NUDGE = 1e-5
"""Share of an actuator's range by which the action is moved for a central difference. The error grows with its square
(curvature: 1e-10) and with its inverse (rounding: 1e-16 of a position, 1e-10 at 10 m)."""


def single_tangent(
    step: Callable[[Sequence[Any], Operations], Sequence[Any]],
    action: Sequence[float],
    ranges: Sequence[float],
    takes_complex: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """f (states,) and g (states, actions) for one robot: by complex steps where all equations take complex numbers."""
    if takes_complex:
        # Python's cmath refuses numbers that overflow; the differences answer them with NaN
        with contextlib.suppress(ValueError, ArithmeticError):
            return complex_step(lambda nudged: step(nudged, COMPLEX), action)
    return _difference(lambda nudged: step(nudged, FLOATS), action, ranges)


def complex_step(
    step: Callable[[Sequence[Any]], Sequence[Any]], action: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """slope = Im step(action + i h) / h: exact tangents, one step per action.

    Source: Squire and Trapp, Using complex variables to estimate derivatives of real functions, SIAM Review 40, 1998.
    """
    after = []
    for index, value in enumerate(action):
        nudged: list[Any] = list(action)
        nudged[index] = complex(value, IMAGINARY)
        after.append(step(nudged))
    g = [[entry.imag / IMAGINARY for entry in row] for row in zip(*after, strict=True)]
    return intercept([entry.real for entry in after[0]], g, action), np.array(g)


def _difference(
    step: Callable[[Sequence[float]], Sequence[float]], action: Sequence[float], ranges: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Central differences; exact where the step is affine, the mean of both sides at a kink."""
    slopes = []
    for index, width in enumerate(ranges):
        nudge = _NUDGE * width
        up, down = list(action), list(action)
        up[index] += nudge
        down[index] -= nudge
        slopes.append([(high - low) / (2.0 * nudge) for high, low in zip(step(up), step(down), strict=True)])
    g = list(zip(*slopes, strict=True))
    return intercept(step(action), g, action), np.array(g)


def intercept(value: Sequence[float], g: Sequence[Sequence[float]], action: Sequence[float]) -> NDArray[np.float64]:
    """f = value - g action."""
    return np.array(
        [
            entry - sum(slope * felt for slope, felt in zip(row, action, strict=True))
            for entry, row in zip(value, g, strict=True)
        ]
    )


def batched_difference(
    step: Callable[[Array], Array], action: Array, ranges: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Central differences over numpy arrays: f (..., states), g (..., states, actions)."""
    slopes = []
    for index, width in enumerate(ranges):
        nudge = np.zeros(len(ranges))
        nudge[index] = _NUDGE * width
        slopes.append((step(action + nudge) - step(action - nudge)) / (2.0 * _NUDGE * width))
    g = np.stack(slopes, axis=-1)
    return step(action) - np.einsum("...sa,...a->...s", g, action), g


def forward_mode(step: Callable[[Array], Array], action: Any) -> tuple[Any, Any]:
    """Forward-mode derivatives over torch tensors: f (..., states), g (..., states, actions), exact tangents."""
    import torch

    jvp, slopes = _forward_derivative(), []
    for index in range(action.shape[-1]):
        direction = torch.zeros_like(action)
        direction[..., index] = 1.0
        value, slope = jvp(step, (action,), (direction,))
        slopes.append(slope)
    g = torch.stack(slopes, dim=-1)
    return value - torch.einsum("...sa,...a->...s", g, action), g


@cache
def _forward_derivative() -> Callable[..., Any]:
    """torch.func.jvp, called once so that torch's own deprecation warning from the first call stays silent."""
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (torch.zeros(()),), (torch.ones(()),))
    return torch.func.jvp
