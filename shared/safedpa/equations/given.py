"""The arguments of an equation of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from safedpa.operations import Scalar


class Given(NamedTuple):
    """The arguments of an equation of rows: floats, arrays, or numbers that are being recorded."""

    state: Sequence[Scalar]
    """(states,)"""
    shared: Sequence[Scalar]
    """Values that all items have in common, such as the lengths of the robot's body."""
    each: Sequence[Scalar]
    """Values of one item, such as an obstacle's position and radius."""
    form: tuple[int, ...] = ()
    """Integers that determine the equation itself, such as the index of an entry of the state."""
