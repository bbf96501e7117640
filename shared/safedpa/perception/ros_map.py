"""Reads ROS maps (a YAML file and an image) as the closed cells of a zone.

Format: documentation of map_server and nav2_map_server (trinary mode), and pgm(5) of Netpbm.
"""

from __future__ import annotations

import re
import zlib
from base64 import b64decode, b64encode
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import cos, isfinite, sin
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, IndexArray
from safedpa.errors import InputError
from safedpa.limits import file_of_at_most, text_of_file
from safedpa.perception.occupancy_grid import CELL

__all__ = ["PackedCells", "read_map"]


_MAX_EDGE = 4000
"""Cells along an edge: 400 m."""
_MAX_COORDINATE = 10_000_000
"""Largest distance from the origin, in cells."""
_RESOLUTION = (0.005, 1.0)
"""Allowed range of the edge of a pixel, m."""
_MAX_LAYERS = 16
"""Depth in cells up to which the distance from the border is known."""
_ROUNDING = 1e-6
"""m; tolerance for a pixel that ends at the border of a cell."""
_PIXELS_PER_BATCH = 2**20
"""Pixels that are processed together, to bound the memory."""
_PGM_HEADER = rb"P5(?:\s|#[^\n]*\n)+(\d{1,6})(?:\s|#[^\n]*\n)+(\d{1,6})(?:\s|#[^\n]*\n)+(\d{1,3})\s"
_KEYS = ("image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


@final
@dataclass(frozen=True)
class PackedCells:
    """Closed cells of 0.1 m in one string; raises InputError if it is invalid.

    ``packed`` has column and row of the corner with the lowest x and y, width, height, and one bit for each cell
    (column by column, zlib, base64).
    """

    packed: str

    def __post_init__(self) -> None:
        _ = self._layers  # validated and computed here, not while the robot drives

    @classmethod
    def of(cls, column: int, row: int, closed: BoolArray) -> PackedCells:
        """Packs flags ``closed`` (width, height) whose first cell is at (column, row)."""
        bits = b64encode(zlib.compress(np.packbits(closed).tobytes(), 9)).decode()
        return cls(f"{column} {row} {closed.shape[0]} {closed.shape[1]} {bits}")

    @cached_property
    def corner(self) -> tuple[int, int]:
        """Column and row of the first cell."""
        column, row, *_ = self.packed.split()
        return int(column), int(row)

    @cached_property
    def flags(self) -> BoolArray:
        """Which cells are closed, shape (width, height)."""
        found = re.fullmatch(r"(-?\d{1,8}) (-?\d{1,8}) (\d{1,5}) (\d{1,5}) ([A-Za-z0-9+/=]+)", self.packed)
        if found is None:
            raise InputError("cells: got no packed cells, wanted those of safedpa; name a file with 'map'")
        column, row, width, height = (int(part) for part in found.groups()[:4])
        if not (0 < width <= _MAX_EDGE and 0 < height <= _MAX_EDGE):
            raise InputError(f"cells: got {width} x {height} cells, wanted 1 to {_MAX_EDGE} along each edge")
        if max(abs(column), abs(row)) > _MAX_COORDINATE:
            raise InputError(
                f"cells: got a corner {max(abs(column), abs(row))} cells away, wanted {_MAX_COORDINATE} at most"
            )
        wanted = -(-width * height // 8)
        try:
            raw = zlib.decompressobj().decompress(b64decode(found[5], validate=True), wanted + 1)
        except (ValueError, zlib.error) as error:
            raise InputError(f"cells: got no packed cells ({error}), wanted those of safedpa") from error
        if len(raw) != wanted:
            raise InputError(f"cells: got {len(raw)} bytes or more, wanted {wanted} of {width} x {height} cells")
        bits = np.unpackbits(np.frombuffer(raw, dtype=np.uint8), count=width * height)
        return bits.reshape(width, height).astype(np.bool_)

    @cached_property
    def _layers(self) -> NDArray[np.uint8]:
        """Number of layers of closed cells around each closed cell, at most _MAX_LAYERS; shape (width, height)."""
        found = np.zeros(self.flags.shape, dtype=np.uint8)
        inner = self.flags
        for layer in range(1, _MAX_LAYERS + 1):
            inner = _erode(inner)
            if not inner.any():
                break
            found[inner] = layer
        return found

    def near(self, column: int, row: int, around: int) -> tuple[IndexArray, NDArray[np.int64]]:
        """Column and row (n, 2) of the closed cells within ``around`` cells along each axis, and their layers (n,)."""
        left, low = self.corner
        width, height = self.flags.shape
        first = max(column - around - left, 0), max(row - around - low, 0)
        last = min(column + around - left + 1, width), min(row + around - low + 1, height)
        if first[0] >= last[0] or first[1] >= last[1]:
            return np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.int64)
        part = np.s_[first[0] : last[0], first[1] : last[1]]
        places = np.argwhere(self.flags[part])
        layers = self._layers[part][self.flags[part]].astype(np.int64)
        return places + np.array((left + first[0], low + first[1])), layers


def _erode(flags: BoolArray) -> BoolArray:
    """Keeps cells that are set together with their eight neighbours; cells outside are not set."""
    padded = np.pad(flags, 1)
    found = flags.copy()
    for i in range(3):
        for j in range(3):
            found &= padded[i : i + flags.shape[0], j : j + flags.shape[1]]
    return found


def read_map(path: Path) -> PackedCells:
    """Reads the occupied cells of a map (YAML file and .pgm image); unknown cells stay open.

    A cell of 0.1 m is closed if the bounding box of an occupied pixel reaches into it. Raises InputError that names the
    file.
    """
    keys: dict[str, str] = {}
    try:
        keys = _parse_yaml(text_of_file(path, "toml_bytes"))
        picture = _read_pgm(path.parent / keys["image"])
        darkness = picture if keys["negate"] == "1" else 255 - picture
        occupied = darkness > 255.0 * _number(keys, "occupied_thresh", 0.0, 1.0)
        return _closed_cells(occupied, _number(keys, "resolution", *_RESOLUTION), _origin(keys["origin"]))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (OSError, ValueError) as error:  # not UTF-8, or not a valid file name
        reason = getattr(error, "strerror", None) or error
        unread = f"its image '{keys['image'][:200]}'" if keys else "it"
        raise InputError(f"{path}: {unread} cannot be read ({reason})") from error


def _parse_yaml(text: str) -> dict[str, str]:
    """Parses the YAML file of a map: only ``key: value`` lines, values as text."""
    found = {"mode": "trinary", "negate": "0", "occupied_thresh": "0.65"}
    for line in text.splitlines():
        bare = re.sub(r"(^|\s)#.*$", "", line).strip()
        if not bare or bare == "---":
            continue
        key, colon, value = bare.partition(":")
        if not colon or key.strip() not in _KEYS:
            raise InputError(f"line '{bare[:60]}': wanted one of {', '.join(_KEYS)}, each on a line of its own")
        found[key.strip()] = value.strip().strip("'\"")
    missing = [key for key in ("image", "resolution", "origin") if not found.get(key)]
    if missing:
        raise InputError(f"{missing[0]}: missing; wanted the YAML file of a map, as map_saver writes it")
    if found["mode"] != "trinary":
        raise InputError(f"mode: got '{found['mode'][:20]}', wanted trinary")
    if found["negate"] not in ("0", "1"):
        raise InputError(f"negate: got '{found['negate'][:20]}', wanted 0 or 1")
    return found


def _number(keys: dict[str, str], key: str, low: float, high: float) -> float:
    return _within(key, keys[key], low, high)


def _within(key: str, text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not (isfinite(value) and low <= value <= high):
        raise InputError(f"{key}: got '{text[:40]}', wanted {low:g} to {high:g}")
    return value


def _origin(text: str) -> tuple[float, float, float]:
    parts = text.strip("[]").split(",")
    if len(parts) != 3:
        raise InputError(f"origin: got '{text[:40]}', wanted [x in m, y in m, yaw in rad]")
    far = _MAX_COORDINATE * CELL / 2.0
    x, y = (_within("origin", part, -far, far) for part in parts[:2])
    return x, y, _within("origin yaw", parts[2], -7.0, 7.0)


def _read_pgm(path: Path) -> NDArray[np.uint8]:
    """Brightness (height, width), 0 to 255, of a binary PGM; the first row is the top."""
    content = file_of_at_most(path, "map_bytes")  # refuses a pipe, which could block
    found = re.match(_PGM_HEADER, content)
    if found is None:
        raise InputError(f"{path.name}: got no binary PGM of one byte a pixel; wanted one, as map_saver writes it")
    width, height, brightest = (int(part) for part in found.groups())
    pixels = content[found.end() :]
    if not width or not height or brightest != 255 or len(pixels) < width * height:
        raise InputError(
            f"{path.name}: got {len(pixels)} bytes for {width} x {height} pixels of up to {brightest}; wanted one for "
            "each, up to 255"
        )
    return np.frombuffer(pixels, dtype=np.uint8, count=width * height).reshape(height, width)


def _closed_cells(occupied: BoolArray, resolution: float, origin: tuple[float, float, float]) -> PackedCells:
    """Closes all cells that occupied pixels (height, width) reach into."""
    boxes = [(low.min(axis=0), high.max(axis=0)) for low, high in _pixel_boxes(occupied, resolution, origin)]
    if not boxes:
        raise InputError("got no occupied pixel, wanted one that closes something; leave the zone out")
    corner = np.min([low for low, _ in boxes], axis=0)
    size = np.max([high for _, high in boxes], axis=0) - corner + 1
    if size.max() > _MAX_EDGE:
        raise InputError(f"got {size.max() * CELL:.0f} m along an edge, wanted {_MAX_EDGE * CELL:.0f} at most")
    closed = np.zeros(tuple(size.tolist()), dtype=np.bool_)
    for low, high in _pixel_boxes(occupied, resolution, origin):
        spread = (high - low).max(axis=0)
        for i in range(int(spread[0]) + 1):
            for j in range(int(spread[1]) + 1):
                cells = np.minimum(low + np.array((i, j)), high) - corner
                closed[cells[:, 0], cells[:, 1]] = True
    return PackedCells.of(int(corner[0]), int(corner[1]), closed)


def _pixel_boxes(
    occupied: BoolArray, resolution: float, origin: tuple[float, float, float]
) -> Iterator[tuple[IndexArray, IndexArray]]:
    """Yields column and row (n, 2) of the first and last cell that each occupied pixel reaches into.

    It works in batches of rows: the largest image would need 7 GB at once.
    """
    x, y, yaw = origin
    half = 0.5 * resolution * (abs(cos(yaw)) + abs(sin(yaw))) - _ROUNDING
    height, width = occupied.shape
    rows = max(_PIXELS_PER_BATCH // width, 1)
    for top in range(0, height, rows):
        from_top, across = np.nonzero(occupied[top : top + rows])
        if not len(across):
            continue
        ahead, aside = (across + 0.5) * resolution, (height - (from_top + top) - 0.5) * resolution
        middles = np.column_stack([x + ahead * cos(yaw) - aside * sin(yaw), y + ahead * sin(yaw) + aside * cos(yaw)])
        yield np.floor((middles - half) / CELL).astype(np.int64), np.floor((middles + half) / CELL).astype(np.int64)
