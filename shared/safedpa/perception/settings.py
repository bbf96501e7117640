"""What a person may set about perception, and its TOML file; errors name the setting."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any, final

from safedpa.errors import InputError
from safedpa.limits import finite_number, parse_toml, refuse_unknown, text_of_file, whole_number
from safedpa.perception.ros_map import PackedCells, read_map
from safedpa.perception.zones import Zone

__all__ = ["PerceptionSettings", "SourceSettings", "load_perception", "parse_perception"]

FORMAT = 1
_MOST_ZONES = 64
_MOST_POINTS = 20
_MAP = re.compile(r"""^[ \t]*map[ \t]*=[ \t]*["']([^"'\n]+)["'][ \t]*(?:#.*)?$""", re.MULTILINE)
_TIME_OUT = (0.05, 10.0)
"""s"""


@final
@dataclass(frozen=True)
class SourceSettings:
    """What is set about one source alone; None: as for all. Raises InputError naming the setting."""

    use: bool = True
    """Whether it is listened to unless an order says otherwise. What only it sees is hidden then, not free."""
    time_out: float | None = None
    """s"""
    min_points: int | None = None

    def __post_init__(self) -> None:
        if self.time_out is not None:
            _check("time_out", self.time_out, *_TIME_OUT)
        if self.min_points is not None:
            _check("min_points", self.min_points, 1, _MOST_POINTS)


@final
@dataclass(frozen=True)
class PerceptionSettings:
    """Lengths in m, times in s, speeds in m/s. Raises InputError naming the setting, what was got and wanted."""

    fastest: float = 1.5
    """Speed that anything which moves may have, in any direction, at any moment: a person who walks quickly."""
    coming: float = 1.5
    """Speed that is reckoned with for what comes out of a place that no one sees. Less lets the robot drive faster past
    corners, and promises nothing about who comes faster."""
    slimmest: float = 0.2
    """Radius of the slimmest thing that may move: where it does not fit, nothing hides. No less than a cell of 0.1 m:
    in a cell that something slimmer is in, hardly any ray would show that it is not."""
    widest: float = 0.25
    """Radius that is reckoned with for something hidden."""
    point_radius: float = 0.05
    """Of the disc around a measured point: noise, and half of the room to its neighbours."""
    drift: float = 0.02
    """m by which the robot may misjudge its own way for each metre: what it has not seen since is wider by so much."""
    time_out: float = 0.5
    """A source that is silent for longer is told as amiss, and the filter brakes."""
    still_after: float = 0.25
    """What was never seen to move, and stays in its place for so long, is at rest: at 10 Hz, three scans."""
    restless: float = 10.0
    """What was seen to move and stops may move again for so long."""
    memory: float = 30.0
    """What is at rest is believed to be there for so long after it was seen last."""
    reach: float = 5.0
    """How far around the robot anything is remembered."""
    most: int = 160
    """Discs of each kind that are told at most: where there is more, one stands for several."""
    open_air: bool = False
    """Whether a ray that does not come back has seen free room: not so where there is glass."""
    min_points: int = 1
    """So many rays of one scan have to end in a cell of 0.1 m or its eight neighbours before something is there. More
    than 1 takes lone rays for noise, and with them whatever is so slim or so far away that fewer rays meet it."""
    sources: Mapping[str, SourceSettings] = field(default_factory=lambda: MappingProxyType({}))
    """What is set about single sources, by the name that the robot's states give them."""
    zones: tuple[Zone, ...] = ()

    def __post_init__(self) -> None:
        for name, low, high in (
            ("fastest", 0.0, 20.0),
            ("coming", 0.0, self.fastest),
            ("slimmest", 0.1, 5.0),
            ("widest", self.slimmest, 5.0),
            ("point_radius", 0.0, 1.0),
            ("drift", 0.0, 1.0),
            ("time_out", *_TIME_OUT),
            ("still_after", 0.0, 60.0),
            ("restless", 0.0, 600.0),
            ("memory", 0.1, 3600.0),
            ("reach", 1.0, 15.0),
            ("most", 8, 256),
            ("min_points", 1, _MOST_POINTS),
        ):
            _check(name, getattr(self, name), low, high)
        if len(self.zones) > _MOST_ZONES:
            raise InputError(f"perception zones: got {len(self.zones)}, wanted {_MOST_ZONES} at most")
        names = [zone.name for zone in self.zones]
        twice = [name for index, name in enumerate(names) if name in names[:index]]
        if twice:
            raise InputError(f"zone {twice[0]}: got two of this name, wanted each once; an order could not tell them")

    def time_out_of(self, source: str) -> float:
        """s of silence after which a source is told as amiss."""
        own = self.sources.get(source)
        return self.time_out if own is None or own.time_out is None else own.time_out

    def min_points_of(self, source: str) -> int:
        """Rays of a source that have to end near each other before something is there."""
        own = self.sources.get(source)
        return self.min_points if own is None or own.min_points is None else own.min_points


def _check(name: str, value: float, low: float, high: float) -> None:
    if isinstance(value, bool) or not (isfinite(value) and low <= value <= high):
        raise InputError(f"perception {name}: got {value!r}, wanted {low:g} to {high:g}")


def load_perception(path: Path) -> tuple[PerceptionSettings, str]:
    """The settings in a file, and its text, in which the maps that it names are written out: anyone who has the text has
    all. Raises InputError naming the file and the key."""
    try:
        text = _with_maps(text_of_file(path, "toml_bytes"), path.parent)
        return parse_perception(text), text
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason}); docs/sensing-zones.md has a whole file") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _with_maps(text: str, folder: Path) -> str:
    """The text with the cells of each map in the place of its file's name."""

    def cells(found: re.Match[str]) -> str:
        return f'cells = "{read_map(folder / found[1]).packed}"'

    return _MAP.sub(cells, text)


def parse_perception(text: str) -> PerceptionSettings:
    """The settings in a TOML text: ``[perception]``, ``[sources.NAME]``, ``[[zones]]``. Raises InputError naming the
    key."""
    table = parse_toml(text)
    refuse_unknown(table, ("format", "perception", "sources", "zones"))
    if table.get("format", FORMAT) != FORMAT:
        raise InputError(f"format: got {table['format']!r}, wanted {FORMAT}; this program reads no other")
    own = _of_table(PerceptionSettings, "[perception]", table.get("perception", {}), but=("sources", "zones"))
    sources = _table("sources", table.get("sources", {}))
    reported = {
        name: SourceSettings(**_of_table(SourceSettings, f"[sources.{name}]", sources[name])) for name in sources
    }
    zones = table.get("zones", [])
    if not isinstance(zones, list):
        raise InputError(f"zones: got {type(zones).__name__}, wanted a [[zones]] for each")
    return PerceptionSettings(**own, sources=MappingProxyType(reported), zones=tuple(map(_zone, zones)))


def _table(where: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{where}: got {value!r}, wanted a table")
    return value


def _of_table(kind: type[Any], where: str, value: Any, but: tuple[str, ...] = ()) -> dict[str, Any]:
    """The keys of a table with values of the types that the fields of ``kind`` have."""
    table, known = _table(where, value), {item.name: str(item.type) for item in fields(kind) if item.name not in but}
    refuse_unknown(table, known, f"{where} ")
    return {key: _value(f"{where} {key}", known[key], entry) for key, entry in table.items()}


def _value(key: str, kind: str, value: Any) -> Any:
    if kind == "bool":
        if not isinstance(value, bool):
            raise InputError(f"{key}: got {value!r}, wanted true or false")
        return value
    if kind == "str":
        if not isinstance(value, str):
            raise InputError(f"{key}: got {value!r}, wanted a text")
        return value
    return whole_number(key, value) if kind.startswith("int") else finite_number(key, value)


def _zone(value: Any) -> Zone:
    """One of ``[[zones]]``."""
    table = _table("zones", value)
    where = f"zone {table.get('name', '')}".rstrip()
    if "map" in table:
        raise InputError(f"{where}: map: wanted the name of a file in quotes, on a line of its own")
    refuse_unknown(table, [item.name for item in fields(Zone)], f"{where}: ")
    for key in ("name", "kind", "frame", *(() if "cells" in table else ("polygon",))):
        if key not in table:
            raise InputError(f"{where}: {key}: missing; docs/sensing-zones.md has a whole file")
    given = {key: _value(f"{where}: {key}", "str", table[key]) for key in ("name", "kind", "frame")}
    speed = table.get("speed")
    return Zone(
        **given,
        polygon=tuple(_pair(f"{where}: polygon", entry, "[x, y] in m") for entry in _list(where, "polygon", table)),
        speed=None if speed is None else _pair(f"{where}: speed", speed, "[lowest, highest] in m/s"),
        robots=tuple(_value(f"{where}: robots", "str", name) for name in _list(where, "robots", table)),
        use=_value(f"{where}: use", "bool", table.get("use", True)),
        cells=_cells(where, table),
    )


def _cells(where: str, table: Mapping[str, Any]) -> PackedCells | None:
    if "cells" not in table:
        return None
    try:
        return PackedCells(_value("cells", "str", table["cells"]))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _list(where: str, key: str, table: Mapping[str, Any]) -> list[Any]:
    value = table.get(key, [])
    if not isinstance(value, list):
        raise InputError(f"{where}: {key}: got {value!r}, wanted a list")
    return value


def _pair(where: str, value: Any, wanted: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{where}: got {value!r}, wanted {wanted}")
    first, second = (finite_number(where, entry, wanted) for entry in value)
    return first, second
