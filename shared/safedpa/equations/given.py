"""What an equation of alike things is given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from safedpa.operations import Scalar

__all__ = ["Given"]


class Given(NamedTuple):
    """What an equation of rows is given: floats, arrays, or numbers that are being recorded."""

    state: Sequence[Scalar]
    """(states,)"""
    shared: Sequence[Scalar]
    """What all items have in common, such as the lengths of the robot's body."""
    each: Sequence[Scalar]
    """The numbers of one item, such as an obstacle's place and radius."""
    form: tuple[int, ...] = ()
    """Whole numbers that the equation itself depends on, such as the place of an entry in the state."""
