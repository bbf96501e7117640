"""Random barriers around a recorded state of a car, to calibrate a margin from logs without a scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.robots.car.system import CAR
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.settings import FilterSettings

SMALL_CAR = (0.08, 0.40, 0.12)
"""m; footprint of the 1:10 car: extent behind and ahead of the rear axle, and radius."""
_AROUND = (0.5, 2.5)
"""m; range of the obstacles' distances."""
_RADII = (0.2, 0.35)
"""m"""
_OBSTACLES = 3
_ROOM = 4.0
"""m; largest distance of a wall."""


def barriers_around(
    state: FloatArray, settings: FilterSettings, footprint: tuple[float, ...], draw: np.random.Generator
) -> list[AbstractBarrier]:
    """Draws obstacles and four walls around a state; ``footprint`` (3,) or empty for ``SMALL_CAR``."""
    assert len(state) == len(CAR.state)
    distance, angle = draw.uniform(*_AROUND, _OBSTACLES), draw.uniform(-np.pi, np.pi, _OBSTACLES)
    x, y = state[0] + distance * np.cos(angle), state[1] + distance * np.sin(angle)
    obstacles: Any = np.column_stack([x, y, draw.uniform(*_RADII, _OBSTACLES)])
    low, high = draw.uniform(0.5, _ROOM, 2), draw.uniform(0.5, _ROOM, 2)
    field = (state[0] - low[0], state[0] + high[0], state[1] - low[1], state[1] + high[1])
    return car_barriers(settings, footprint if len(footprint) == 3 else SMALL_CAR, obstacles, field)
