"""Actions spread over the whole of their range: where else to look when the way from the wish leads nowhere."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Final

from safedpa.safety.program_rows import Side, within

__all__ = ["NEARBY", "around", "lattice"]

_POINTS: Final = {1: 9, 2: 5, 3: 3}
"""By the number of actions: how many values of each, where the model is not affine in them."""
_MOST_CORNERS: Final = 4
"""Actions up to which all corners are taken; of more there are too many to be tried within a period."""
NEARBY: Final = (0.24, 0.12, 0.06, 0.03, 0.015, 0.006)
"""Shares of an entry's range by which an action is moved to look about it where tangents do not say what comes of it:
an actuator that saturates has them lead along a plateau and past the ridge that lies across it, and where a robot
stands h may bend."""


def lattice(sides: tuple[Side, ...], *, affine: bool) -> list[tuple[float, ...]]:
    """Evenly spread actions (actions,), all corners of their range among them; of many actions none.

    Of an ``affine`` model the corners alone: what lies between follows from them.
    """
    if len(sides) > _MOST_CORNERS:
        return []
    points = 2 if affine else _POINTS.get(len(sides), 2)
    return list(product(*[_values(low, high, width, points) for low, high, width in sides]))


def around(sides: tuple[Side, ...], action: Sequence[float], share: float) -> list[tuple[float, ...]]:
    """``action`` with each of its entries moved down and up by this share of its range, as far as the bounds allow."""
    moved: list[tuple[float, ...]] = []
    for index, (_, _, width) in enumerate(sides):
        for step in (-share * width, share * width):
            other = within([*action[:index], action[index] + step, *action[index + 1 :]], sides)
            if other[index] != action[index]:
                moved.append(other)
    return moved


def _values(low: float, high: float, width: float, points: int) -> list[float]:
    return [*[low + width * index / (points - 1) for index in range(points - 1)], high]
