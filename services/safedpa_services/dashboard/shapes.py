"""What can be shown, without a word about who draws it: plain values that a test can look at."""

from __future__ import annotations

from dataclasses import dataclass

from safedpa.drawing import Discs, Lines, Point, Rings

__all__ = [
    "Bands",
    "Curves",
    "Discs",
    "Lines",
    "MarkdownPage",
    "Note",
    "Point",
    "Rings",
    "Shape",
    "StateSet",
    "States",
    "TimelineEntry",
    "TimelineFrame",
]


@dataclass(frozen=True, slots=True)
class Curves:
    """Values of curves at one time, NaN where there is none."""

    values: tuple[float, ...]
    names: tuple[str, ...] = ()
    """With the unit; given once, with ``colours`` and ``widths`` [points], in a static entry without values."""
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
    """The state of a lane from now on; an empty one ends the lane."""

    state: str


@dataclass(frozen=True, slots=True)
class StateSet:
    """Static: the colours of a lane's states."""

    colours: dict[str, int]


@dataclass(frozen=True, slots=True)
class Note:
    """A line of the log."""

    text: str
    colour: int
    level: str = "INFO"


@dataclass(frozen=True, slots=True)
class MarkdownPage:
    """A text in Markdown."""

    text: str


Shape = Discs | Rings | Lines | Curves | Bands | States | StateSet | Note | MarkdownPage


@dataclass(frozen=True, slots=True)
class TimelineEntry:
    """One shape under a path; ``static``: holds at every time."""

    path: tuple[str, ...]
    shape: Shape
    static: bool = False


@dataclass(frozen=True, slots=True)
class TimelineFrame:
    """Entries of one moment, ``at`` [s] on the dashboard's time line."""

    at: float
    entries: tuple[TimelineEntry, ...]
