"""The tangent of a step at an action: (f, g) with step(a) = f + g a, by three roads for three kinds of numbers."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics.dynamics import Array

__all__ = ["batched_difference", "forward_mode", "single_difference"]

_NUDGE = 1e-5
"""Share of an actuator's range by which the action is moved for a central difference. The error grows with its square
(curvature: 1e-10) and with its inverse (rounding: 1e-16 of a position, 1e-10 at 10 m)."""


def single_difference(
    step: Callable[[Sequence[float]], Sequence[float]], action: Sequence[float], ranges: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Central differences over plain floats: f (states,), g (states, actions); exact where the step is affine."""
    slopes = []
    for index, width in enumerate(ranges):
        nudge = _NUDGE * width
        up, down = list(action), list(action)
        up[index] += nudge
        down[index] -= nudge
        slopes.append([(high - low) / (2.0 * nudge) for high, low in zip(step(up), step(down), strict=True)])
    f = [
        value - sum(slope * felt for slope, felt in zip(row, action, strict=True))
        for value, *row in zip(step(action), *slopes, strict=True)
    ]
    return np.array(f), np.array(slopes).T


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
