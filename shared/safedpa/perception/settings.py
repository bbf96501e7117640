"""Settings of perception, and their TOML file; errors name the setting."""

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
_MAX_ZONES = 64
_MAX_POINTS = 20
_MAP = re.compile(r"""^[ \t]*map[ \t]*=[ \t]*["']([^"'\n]+)["'][ \t]*(?:#.*)?$""", re.MULTILINE)
_TIME_OUT_RANGE = (0.05, 10.0)
"""s; allowed range."""


@final
@dataclass(frozen=True)
class SourceSettings:
    """Settings of one source; None means the common value. Raises InputError that names the setting."""

    use: bool = True
    """Whether the source is used unless a user switches it. What only a disabled source sees counts as hidden."""
    time_out: float | None = None
    """Silence after which the source has failed, s."""
    min_points: int | None = None
    repeats: bool = False
    """Whether identical scans in a row are normal, as of a range sensor, a costmap or a simulated laser without noise;
    otherwise four of them count as a frozen sensor."""

    def __post_init__(self) -> None:
        if self.time_out is not None:
            _check("time_out", self.time_out, *_TIME_OUT_RANGE)
        if self.min_points is not None:
            _check("min_points", self.min_points, 1, _MAX_POINTS)


@final
@dataclass(frozen=True)
class PerceptionSettings:
    """Settings of perception; lengths in m, times in s, speeds in m/s. Raises InputError that names the setting."""

    fastest: float = 1.5
    """Largest speed of a mover, in any direction at any time: a person who walks quickly."""
    coming: float = 1.5
    """Assumed speed of a mover that comes out of a hidden region. A smaller value lets the robot drive faster past
    corners, but gives no guarantee for faster movers."""
    slimmest: float = 0.2
    """Radius of the slimmest mover: where it does not fit, nothing hides. At least a cell of 0.1 m, because rays would
    hardly ever prove that a cell contains no slimmer one."""
    widest: float = 0.25
    """Assumed radius of a hidden mover."""
    point_radius: float = 0.05
    """Radius of the disc around a measured point: noise, and half of the distance to its neighbours."""
    drift: float = 0.02
    """Odometry error in m per m: obstacles that were not seen since are enlarged by so much."""
    time_out: float = 0.5
    """A source that is silent for longer is reported as failed, and the filter brakes."""
    still_after: float = 0.25
    """An object that was never seen to move is at rest after it has stayed for so long: three scans at 10 Hz."""
    restless: float = 10.0
    """A mover that stops may move again for so long."""
    memory: float = 30.0
    """An obstacle at rest is kept for so long after it was last seen."""
    reach: float = 5.0
    """Distance around the robot within which objects are remembered."""
    most: int = 160
    """Largest number of published discs of each kind; if there are more, one disc covers several."""
    open_air: bool = False
    """Whether a ray without a return has seen free space; must be False if there is glass."""
    min_points: int = 1
    """Rays of one scan that must end in a cell of 0.1 m or its eight neighbours to count as an object. Values above 1
    treat single rays as noise, and so miss objects that are slim or far away."""
    sources: Mapping[str, SourceSettings] = field(default_factory=lambda: MappingProxyType({}))
    """Settings of single sources, by their name in the states of the robot."""
    zones: tuple[Zone, ...] = ()

    def __post_init__(self) -> None:
        for name, low, high in (
            ("fastest", 0.0, 20.0),
            ("coming", 0.0, self.fastest),
            ("slimmest", 0.1, 5.0),
            ("widest", self.slimmest, 5.0),
            ("point_radius", 0.0, 1.0),
            ("drift", 0.0, 1.0),
            ("time_out", *_TIME_OUT_RANGE),
            ("still_after", 0.0, 60.0),
            ("restless", 0.0, 600.0),
            ("memory", 0.1, 3600.0),
            ("reach", 1.0, 15.0),
            ("most", 8, 256),
            ("min_points", 1, _MAX_POINTS),
        ):
            _check(name, getattr(self, name), low, high)
        if len(self.zones) > _MAX_ZONES:
            raise InputError(f"perception zones: got {len(self.zones)}, wanted {_MAX_ZONES} at most")
        names = [zone.name for zone in self.zones]
        duplicates = [name for index, name in enumerate(names) if name in names[:index]]
        if duplicates:
            raise InputError(f"zone {duplicates[0]}: got two of this name, wanted each once, to be named in orders")

    def time_out_of(self, source: str) -> float:
        """Silence after which a source has failed, s."""
        own = self.sources.get(source)
        return self.time_out if own is None or own.time_out is None else own.time_out

    def repeats(self, source: str) -> bool:
        """Whether a source may send identical scans."""
        own = self.sources.get(source)
        return own is not None and own.repeats

    def min_points_of(self, source: str) -> int:
        """Rays of a source that must end near each other to count as an object."""
        own = self.sources.get(source)
        return self.min_points if own is None or own.min_points is None else own.min_points


def _check(name: str, value: float, low: float, high: float) -> None:
    if isinstance(value, bool) or not (isfinite(value) and low <= value <= high):
        raise InputError(f"perception {name}: got {value!r}, wanted {low:g} to {high:g}")


def load_perception(path: Path) -> tuple[PerceptionSettings, str]:
    """Loads settings from a file; also returns its text with the named maps inserted, so that the text is complete.

    Raises InputError that names the file and the key.
    """
    try:
        text = _with_maps(text_of_file(path, "toml_bytes"), path.parent)
        return parse_perception(text), text
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason}); docs/guides/sensing-zones.md has a whole file") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _with_maps(text: str, folder: Path) -> str:
    """Replaces the file name of each map by its cells."""

    def cells(found: re.Match[str]) -> str:
        return f'cells = "{read_map(folder / found[1]).packed}"'

    return _MAP.sub(cells, text)


def parse_perception(text: str) -> PerceptionSettings:
    """Parses settings from TOML: ``[perception]``, ``[sources.NAME]``, ``[[zones]]``. Errors name the key."""
    table = parse_toml(text)
    refuse_unknown(table, ("format", "perception", "sources", "zones"))
    if table.get("format", FORMAT) != FORMAT:
        raise InputError(f"format: got {table['format']!r}, wanted {FORMAT}; this program reads no other")
    own = _of_table(PerceptionSettings, "[perception]", table.get("perception", {}), but=("sources", "zones"))
    sources = _table("sources", table.get("sources", {}))
    by_source = {
        name: SourceSettings(**_of_table(SourceSettings, f"[sources.{name}]", sources[name])) for name in sources
    }
    zones = table.get("zones", [])
    if not isinstance(zones, list):
        raise InputError(f"zones: got {type(zones).__name__}, wanted a [[zones]] for each")
    return PerceptionSettings(**own, sources=MappingProxyType(by_source), zones=tuple(map(_zone, zones)))


def _table(where: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{where}: got {value!r}, wanted a table")
    return value


def _of_table(kind: type[Any], where: str, value: Any, but: tuple[str, ...] = ()) -> dict[str, Any]:
    """Reads a table whose keys and types are those of the fields of ``kind``."""
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
    """Parses one entry of ``[[zones]]``."""
    table = _table("zones", value)
    where = f"zone {table.get('name', '')}".rstrip()
    if "map" in table:
        raise InputError(f"{where}: map: wanted the name of a file in quotes, on a line of its own")
    refuse_unknown(table, [item.name for item in fields(Zone)], f"{where}: ")
    for key in ("name", "kind", "frame", *(() if "cells" in table else ("polygon",))):
        if key not in table:
            raise InputError(f"{where}: {key}: missing; docs/guides/sensing-zones.md has a whole file")
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
