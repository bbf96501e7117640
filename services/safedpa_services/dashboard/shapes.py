"""Shapes as plain values, independent of the library that draws them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from safedpa.drawing import Discs, Lines, Rings


@dataclass(frozen=True, slots=True)
class Curves:
    """Values of the curves of one plot at one time; NaN is a gap."""

    values: tuple[float, ...]
    names: tuple[str, ...] = ()
    """Names with units. Names, ``colours`` and ``widths`` [points] are given once, in a static entry without values."""
    colours: tuple[int, ...] = ()
    widths: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Bands:
    """An estimate at one time: value and standard deviation, shown as a line and a band of one sigma."""

    value: float
    deviation: float
    name: str
    unit: str
    colour: int


@dataclass(frozen=True, slots=True)
class States:
    """The state of a lane from this time on; an empty state ends the lane."""

    state: str


@dataclass(frozen=True, slots=True)
class StateSet:
    """The colours of a lane's states; static."""

    colours: dict[str, int]


@dataclass(frozen=True, slots=True)
class Note:
    """A log line."""

    text: str
    colour: int
    level: str = "INFO"


@dataclass(frozen=True, slots=True)
class MarkdownPage:
    """A Markdown text."""

    text: str


Shape = Discs | Rings | Lines | Curves | Bands | States | StateSet | Note | MarkdownPage


@dataclass(frozen=True, slots=True)
class TimelineEntry:
    """A shape with its path in the recording; ``static``: valid at all times."""

    path: tuple[str, ...]
    shape: Shape
    static: bool = False


@dataclass(frozen=True, slots=True)
class TimelineFrame:
    """Entries of one time ``at`` [s] on the dashboard's time line."""

    at: float
    entries: tuple[TimelineEntry, ...]


_FARTHEST = 1e5
"""Largest drawn coordinate [m]: the viewer computes with 32-bit floats."""


def drawable(*numbers: float) -> bool:
    """Returns whether all numbers are finite and small enough to be drawn as coordinates."""
    return all(math.isfinite(number) and abs(number) <= _FARTHEST for number in numbers)


def gap_if_huge(value: float, largest: float = 1e12) -> float:
    """Returns a value of a curve; NaN, a gap, if it is not finite or so large that it would flatten the plot."""
    return value if abs(value) < largest else math.nan
