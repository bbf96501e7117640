"""Actions spread over the whole of their range: where else to look when the way from the wish leads nowhere."""

from __future__ import annotations

from itertools import product
from typing import Final

from safedpa.safety.program_rows import Side

__all__ = ["lattice"]

_POINTS: Final = {1: 9, 2: 5, 3: 3}
"""By the number of actions: how many values of each, where the model is not affine in them."""
_MOST_CORNERS: Final = 4
"""Actions up to which all corners are taken; of more there are too many to be tried within a period."""


def lattice(sides: tuple[Side, ...], *, affine: bool) -> list[tuple[float, ...]]:
    """Evenly spread actions (actions,), all corners of their range among them; of many actions none.

    Of an ``affine`` model the corners alone: what lies between follows from them.
    """
    if len(sides) > _MOST_CORNERS:
        return []
    points = 2 if affine else _POINTS.get(len(sides), 2)
    return list(product(*[_values(low, high, width, points) for low, high, width in sides]))


def _values(low: float, high: float, width: float, points: int) -> list[float]:
    return [*[low + width * index / (points - 1) for index in range(points - 1)], high]
