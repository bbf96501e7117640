"""The teacher of the point robot's policy: it knows the wind, and drives at one speed along the shortest way."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.stopping_barrier import Motion
from safedpa_sim.point.seeking import steered

__all__ = ["CRUISE", "taught"]

Floats = NDArray[np.float64]

CRUISE: Final = 0.9
"""m/s; faster ones are stopped more often by the filter and reach fewer goals."""


def taught(state: Floats, turn: Floats, motion: Motion) -> Floats:
    """Actions (robots, 2) in [-1, 1] for states (robots, 5) towards the way's first ``turn`` (robots, 2)."""
    apart = turn - state[:, :2]
    return steered(state, np.arctan2(apart[:, 1], apart[:, 0]), np.full(len(state), CRUISE), motion)
