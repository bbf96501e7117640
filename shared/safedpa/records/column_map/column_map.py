"""Data model of a column map: the source of time and of each state and action in a foreign log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from safedpa.systems import System

__all__ = [
    "DERIVATIONS",
    "HOLD_ACTION",
    "HOLD_STATE",
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
"""Derivations by name: the derived quantity, and those that it is computed from."""
SLOPE = "slope"
"""Name of the derivation of any state as the time derivative of another one, which the map names with ``of``."""
HOLD_ACTION = 0.5
"""s; default for the age up to which a command counts as still applied."""
HOLD_STATE = 0.1
"""s; default for the age up to which a measurement of another topic, or of another rate, is used."""
JOINS = ("mean", "sum", "difference", "norm", "first")
"""How several columns are combined: mean, sum, first minus the others, Euclidean norm, first finite value of a row."""


KEEPABLE = (
    "changed_command", "clock_drift", "coarse_part", "dead_command", "frozen", "jump", "offset", "out_of_bounds",
    "stale_command",
)  # fmt: skip
"""Kinds of findings whose rows a map can keep; by default they are cut."""


@dataclass(frozen=True)
class SourceColumn:
    """value(t) = (-1 if flip else 1) scale factor(unit) raw(t + shift) + offset; the offset is in SI units.

    ``shift`` [s] is the delay of the column.
    """

    source: str
    """The raw column, such as ``/odom:pose.pose.position.x`` in a log of topics; the first of joined ones."""
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    flip: bool = False
    shift: float = 0.0
    others: tuple[str, ...] = ()
    """Further raw columns, joined before unit, scale and offset are applied."""
    join: str = ""
    """One of ``JOINS`` if there are ``others``."""
    hold: float | None = None
    """Maximum age [s] of a value of another topic, or of another rate in a table; None: the default."""

    @property
    def sources(self) -> tuple[str, ...]:
        """All raw columns that are read for it."""
        return (self.source, *self.others)

    def gain(self, factor: float) -> float:
        """Factor of the raw value, given the factor of its unit to SI."""
        return (-self.scale if self.flip else self.scale) * factor


@dataclass(frozen=True)
class DerivedColumn:
    """A state that the log lacks, computed as the time derivative of one that it has.

    The derivative at a row is the least-squares slope over the rows within window / 2 [s] on either side. It is
    central, so without phase shift; changes faster than about 1 / window [Hz] are smoothed out.
    """

    derive: str
    window: float
    of: str = ""
    """The state whose ``slope`` is computed."""


@dataclass(frozen=True)
class SkipRows:
    """Skips rows in which a raw column equals a number."""

    column: str
    equals: float


@dataclass(frozen=True)
class TrackedPoint:
    """Position of the tracked point relative to the middle of the rear axle [m], and rotation of its frame.

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
    """Source of each target: t, states and actions."""
    unwrap: tuple[str, ...] | None = None
    """Angles to unwrap; None: every angle of the system."""
    skip_first_rows: int = 0
    skip_where: tuple[SkipRows, ...] = ()
    tracked_point: TrackedPoint | None = None
    keep_period: float | None = None
    """s; a faster log is reduced to the row nearest to each multiple, with the action averaged up to the next one."""
    keep: tuple[str, ...] = ()
    """Kinds of findings whose rows are kept."""
    frames: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Required ``frame_id`` and ``child_frame_id`` of the messages, by topic."""

    @property
    def sources(self) -> tuple[str, ...]:
        """All raw columns that are read, without duplicates."""
        joined = [column.sources for column in self.columns.values() if isinstance(column, SourceColumn)]
        used = [name for names in joined for name in names]
        return tuple(dict.fromkeys([*used, *(rule.column for rule in self.skip_where)]))


def native_map(system: System) -> ColumnMap:
    """Returns the map of a log whose columns have the native names."""
    names = ("t", *system.state_names, *system.action_names)
    return ColumnMap("native", system.name, {name: SourceColumn(name) for name in names})
