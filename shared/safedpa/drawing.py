"""Plain shapes that describe the look of a robot, independent of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Discs", "Lines", "Point", "Rings", "Shape"]

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Discs:
    """Filled circles at centres [m] with radii [m]."""

    centres: tuple[Point, ...]
    radii: tuple[float, ...]
    colour: int


@dataclass(frozen=True, slots=True)
class Rings:
    """Circles, outline only."""

    centres: tuple[Point, ...]
    radii: tuple[float, ...]
    colour: int
    width: float
    """Line width in m."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines through points [m]."""

    strips: tuple[tuple[Point, ...], ...]
    colours: tuple[int, ...]
    """One colour for all lines, or one for each."""
    width: float
    """Line width in m."""
    on_top: bool = False
    """Whether the lines are drawn over discs."""


Shape = Discs | Rings | Lines
