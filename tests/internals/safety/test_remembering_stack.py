"""A stack that remembers values holds those of a few states, however many it is asked about."""

from __future__ import annotations

import numpy as np

from safedpa.robots.car.barriers import car_barriers
from safedpa.safety.barrier import RememberingStack
from safedpa.safety.settings import FilterSettings
from safedpa.safety.stacks import stacked


def test_its_memory_is_bounded() -> None:
    barriers = car_barriers(FilterSettings(), (0.08, 0.4, 0.12), ((0.5, 0.5, 0.2),), (-4.0, 4.0, -4.0, 4.0))
    remembering = RememberingStack(stacked(barriers))
    for x in np.linspace(-1.0, 1.0, 50):
        remembering.values(np.array([x, 0.0, 0.0, 0.0]))
        remembering.gradient(np.array([x, 0.0, 0.0, 0.0]))
    assert len(remembering.plain(4)._known) <= 8
