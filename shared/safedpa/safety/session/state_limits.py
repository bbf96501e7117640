"""Thresholds of the plausibility of a measured state, by unit of its entries, and their file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from importlib.resources import as_file, files
from math import inf, isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple, final

from safedpa.errors import InputError, did_you_mean
from safedpa.limits import finite_number, parse_toml, text_of_file
from safedpa.systems import System
from safedpa.systems.robots import robot_like

__all__ = ["SHIPPED_LIMITS", "Evidence", "StateLimits", "limits_for", "limits_from_evidence", "limits_named"]

SHIPPED_LIMITS: Final = "shipped"
"""Stands for the limits of ``limits_for``."""
_FORMAT: Final = 1
_STILL: Final = 0.05
"""Share of the largest way at which a window counts as one without motion."""
_SUMMED: Final = 1.3
"""Further factor on what adds up over seconds: its largest values are rarer, and differ more from drive to drive."""
_RESERVE: Final = 1.6
"""Factor on the largest value in healthy drives: another drive may exceed it a little."""


class Evidence(NamedTuple):
    """What one measured state shows, by unit. Rates have only a ``jump``."""

    jump: Mapping[str, float]
    """|x - predicted x| over the period that has just ended."""
    drift: Mapping[str, tuple[float, float]]
    """|sum of (x - predicted x)| over the last seconds, and the way that was predicted meanwhile."""
    unanswered: Mapping[str, float]
    """Motion, and rate, that the commands should have caused since the position last changed."""
    overbraking: Mapping[str, float] = MappingProxyType({})
    """By how much more than predicted a rate fell over the period, while it was predicted to fall."""


@final
@dataclass(frozen=True)
class StateLimits:
    """The largest deviations of a measured state from the prediction that a session believes, by unit.

    ``jump``: |x - predicted x| over one period, in the unit. ``drift``: the same summed over two seconds, for
    positions; ``drift_share`` adds that share of the way in those seconds. ``unanswered``: motion, or rate, that
    commands should cause within a second, while the position does not change. A unit without an entry is not checked.
    ``overbraking``: by how much more than predicted a rate may fall within a period; a robot that braked without a
    measured state may be that much slower than predicted when it has one again.

    Example:

        >>> safedpa.StateLimits(jump={"m": 0.1}).jump["m"]
        0.1
    """

    jump: Mapping[str, float] = field(default_factory=dict)
    drift: Mapping[str, float] = field(default_factory=dict)
    drift_share: Mapping[str, float] = field(default_factory=dict)
    unanswered: Mapping[str, float] = field(default_factory=dict)
    overbraking: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in _TABLES:
            table = getattr(self, name)
            if not isinstance(table, Mapping):
                raise InputError(f"{name}: got {table!r}, wanted numbers by unit")
            for unit, value in table.items():
                finite_number(f"{name}.{unit}", value)
                if not value >= 0.0:
                    raise InputError(f"{name}.{unit}: got {value}, wanted a number >= 0")

    @classmethod
    def of_system(cls, system: System, period: float) -> StateLimits:
        """The limits that the bounds of a system imply: no position moves further than its fastest rate allows.

        They are wide; ``limits_from_evidence`` gives narrower ones from healthy drives.
        """
        fastest = dict[str, float]()
        for each in system.state:
            if each.unit.endswith("/s"):
                unit, bound = each.unit.removesuffix("/s"), max(abs(each.low), abs(each.high))
                fastest[unit] = max(bound, fastest.get(unit, 0.0))
        units = dict.fromkeys(each.unit for each in system.state)
        return cls(jump={unit: period * fastest[unit] for unit in units if isfinite(fastest.get(unit, inf))})

    @classmethod
    def load(cls, path: str | Path) -> StateLimits:
        """Reads a TOML file. Raises InputError naming the file and the key."""
        try:
            table = parse_toml(text_of_file(Path(path), "toml_bytes"))
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read ({error}); wanted a file of state limits") from error
        if table.pop("format", None) != _FORMAT:
            raise InputError(f"{path}: format: wanted {_FORMAT}")
        unknown = [name for name in table if name not in (*_TABLES, "made")]
        if unknown:
            raise InputError(f"{path}: {unknown[0]}: unknown key; {did_you_mean(unknown[0], _TABLES)}")
        table.pop("made", None)
        try:
            return cls(**table)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def text(self, made: str = "") -> str:
        """The TOML text that ``load`` reads back to the same limits; ``made`` says how they were measured."""
        lines = [f"format = {_FORMAT}", f'made = "{made}"']
        for name in _TABLES:
            lines += ["", f"[{name}]", *(f'"{unit}" = {value!r}' for unit, value in getattr(self, name).items())]
        return "\n".join(lines) + "\n"


_TABLES: Final = tuple(item.name for item in fields(StateLimits))


def limits_from_evidence(evidence: Iterable[Evidence], *, reserve: float = _RESERVE) -> StateLimits:
    """The limits that healthy drives imply: the largest of each value, times ``reserve``; times 1.3 more for sums.

    ``drift`` is the largest sum in windows without motion; ``drift_share`` what others exceed it by, per way.
    Raises InputError without any evidence.
    """
    rows = list(evidence)
    if not rows:
        raise InputError("evidence: got none, wanted that of at least one healthy drive")
    jump = {unit: reserve * max(row.jump.get(unit, 0.0) for row in rows) for unit in rows[-1].jump}
    silent = {unit: reserve * max(row.unanswered.get(unit, 0.0) for row in rows) for unit in rows[-1].unanswered}
    drift, share = dict[str, float](), dict[str, float]()
    for unit in rows[-1].drift:
        pairs = [row.drift[unit] for row in rows if unit in row.drift]
        still = _STILL * max(way for _, way in pairs)
        # A robot that never rests, such as one that balances, has no windows without motion: its shortest ways count.
        resting = [total for total, way in pairs if way <= still] or [min(pairs, key=lambda pair: pair[1])[0]]
        drift[unit] = reserve * max(*resting, jump[unit] / reserve)
        share[unit] = max([0.0, *((reserve * total - drift[unit]) / way for total, way in pairs if way > still)])
    drift, share, silent = [
        {unit: _SUMMED * value for unit, value in table.items()} for table in (drift, share, silent)
    ]
    stronger = {
        unit: max(row.overbraking.get(unit, 0.0) for row in rows)
        for unit in {unit for row in rows for unit in row.overbraking}
    }
    return StateLimits(jump, drift, share, silent, stronger)


def limits_named(name: str) -> StateLimits | None:
    """The limits that ship under a name, such as that of a system; None if there are none."""
    with as_file(files("safedpa.safety") / "named_state_limits") as folder:
        path = folder / f"{name}.toml"
        return StateLimits.load(path) if path.exists() else None


def limits_for(system: System, period: float) -> StateLimits:
    """The limits that ship for a system, else those that its bounds imply at this ``period`` [s]."""
    robot = robot_like(system)
    shipped = None if robot is None else limits_named(robot.settings_name)
    return StateLimits.of_system(system, period) if shipped is None else shipped
