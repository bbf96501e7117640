"""Plain shapes: what a robot looks like, without a word about who draws it."""

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
    """m."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines through points [m]."""

    strips: tuple[tuple[Point, ...], ...]
    colours: tuple[int, ...]
    """One for all, or one for each."""
    width: float
    """m."""
    on_top: bool = False
    """Whether they are drawn over discs."""


Shape = Discs | Rings | Lines
