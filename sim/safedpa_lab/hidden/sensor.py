"""What the tracking system makes of a true run: noise, lost rows, glitches."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray

__all__ = ["NOISE", "measured"]

NOISE: Final[dict[str, tuple[float, ...]]] = {
    "car": (0.002, 0.002, 0.003, 0.015),
    "pendulum": (0.002, 0.01),
    "differential_drive": (0.002, 0.002, 0.003, 0.01, 0.02),
}
"""Standard deviations of the states' noise: m, m, rad, m/s; rad, rad/s; m, m, rad, m/s, rad/s."""

_HARDER = 3.0
_LOST = 0.01
_GLITCHES = 3
"""In each hard run."""


def measured(
    states: FloatArray, robot: str, random: np.random.Generator, hard: bool
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Measured states and the rows (kept,) that arrived, of one run (rows, states)."""
    noise = np.array(NOISE[robot]) * (_HARDER if hard else 1.0)
    shown = states + noise * random.standard_normal(states.shape)
    retained = np.ones(len(states), dtype=bool)
    if hard:
        retained[1:-1] = random.random(len(states) - 2) >= _LOST
        _glitch(shown, random)
    return shown, np.flatnonzero(retained)


def _glitch(shown: FloatArray, random: np.random.Generator) -> None:
    """The track jumps to something else for one to three rows, and back."""
    for _ in range(_GLITCHES):
        row = int(random.integers(5, len(shown) - 8))
        rows = slice(row, row + int(random.integers(1, 4)))
        shown[rows, :2] += random.choice([-1.0, 1.0], 2) * random.uniform(0.5, 1.5, 2)
