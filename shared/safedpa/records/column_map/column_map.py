"""Column maps: how the columns of a foreign log become time, state and action of a system. Errors name the key."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from safedpa.systems import System

__all__ = [
    "DERIVATIONS",
    "JOINS",
    "KEEPABLE",
    "SLOPE",
    "ColumnMap",
    "DerivedColumn",
    "SkipRows",
    "SourceColumn",
    "TrackedPoint",
    "native_map",
]

DERIVATIONS = {"speed_from_position": ("speed", ("x", "y", "yaw")), "rate_from_angle": ("rate", ("angle",))}
"""What can be derived: its target, and the targets that it is derived from."""
SLOPE = "slope"
"""Derives any state from another one, which the map names with ``of``."""
JOINS = ("mean", "sum", "difference", "norm", "first")
"""How several columns become one: mean, sum, first less the others, root of the sum of squares, the first that is there
in each row."""


KEEPABLE = ("dead_command", "frozen", "out_of_bounds")
"""Findings whose rows are cut unless a map keeps them."""


@dataclass(frozen=True)
class SourceColumn:
    """value(t) = (-1 if flip else 1) scale factor(unit) raw(t + shift) + offset; the offset is in SI units.

    ``shift`` [s]: how late the column comes.
    """

    source: str
    """The raw column, of a log of topics ``/odom:pose.pose.position.x``; the first of several that are joined."""
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    flip: bool = False
    shift: float = 0.0
    others: tuple[str, ...] = ()
    """Further raw columns; what is joined is raw, before unit, scale and offset."""
    join: str = ""
    """One of JOINS where there are ``others``."""
    hold: float | None = None
    """s; of a log of topics: how old a message may be that a row of another topic still takes; None: the usual."""

    @property
    def sources(self) -> tuple[str, ...]:
        """All raw columns that it is made of."""
        return (self.source, *self.others)

    def gain(self, factor: float) -> float:
        """What the raw value is multiplied with, given the unit's factor to SI."""
        return (-self.scale if self.flip else self.scale) * factor


@dataclass(frozen=True)
class DerivedColumn:
    """A state that the log lacks, as the derivative of one that it has.

    The derivative at a row is the least-squares slope over the rows within window / 2 [s] on either side: central, so
    without phase shift; what changes faster than about 1 / window [Hz] is smoothed away.
    """

    derive: str
    window: float
    of: str = ""
    """The state of which a ``slope`` is taken."""


@dataclass(frozen=True)
class SkipRows:
    """Rows whose raw column equals a number are left out."""

    column: str
    equals: float


@dataclass(frozen=True)
class TrackedPoint:
    """Where the tracked point lies on the car, seen from the middle of the rear axle [m], and how its frame is turned.

    rear = tracked - R(yaw) (ahead, left), yaw = tracked yaw + yaw_offset [rad].
    """

    ahead: float = 0.0
    left: float = 0.0
    yaw_offset: float = 0.0


@dataclass(frozen=True)
class ColumnMap:
    """How to read one kind of log."""

    name: str
    robot: str
    columns: Mapping[str, SourceColumn | DerivedColumn]
    """Targets (t, states, actions) and where each comes from."""
    unwrap: tuple[str, ...] | None = None
    """Angles to unwrap; None: every angle of the system."""
    skip_first_rows: int = 0
    skip_where: tuple[SkipRows, ...] = ()
    tracked_point: TrackedPoint | None = None
    keep_period: float | None = None
    """s; of a faster log only the row nearest to each multiple is kept, with the action averaged up to the next one."""

    keep: tuple[str, ...] = ()
    """Kinds of findings of which the rows are kept all the same."""
    frames: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """By topic: the ``frame_id`` and ``child_frame_id`` that its messages must have."""

    @property
    def sources(self) -> tuple[str, ...]:
        """The raw columns that are read, each once."""
        joined = [column.sources for column in self.columns.values() if isinstance(column, SourceColumn)]
        used = [name for names in joined for name in names]
        return tuple(dict.fromkeys([*used, *(rule.column for rule in self.skip_where)]))


def native_map(system: System) -> ColumnMap:
    """The map of a log whose columns have the native names."""
    names = ("t", *system.state_names, *system.action_names)
    return ColumnMap("native", system.name, {name: SourceColumn(name) for name in names})
