"""Selection of the sensed discs that can matter in this tick.

Most discs are dropped before their h is computed: by their distance from the robot (``discs_near``, ``moving_near``).
Of the others those with h below a limit stay (``below``), at most ``MOST_ROWS`` of each kind. A message is processed in
a single pass over plain floats, which also validates the discs. For discs of the usual kind C does the same
(``native/selection.c``).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import isfinite
from typing import Any, Final, TypeAlias

from safedpa.errors import InputError
from safedpa.native.library import NoKernelError, load_module

Rows: TypeAlias = tuple[tuple[float, ...], ...]
Disc: TypeAlias = tuple[float, float, float]
Moving: TypeAlias = tuple[float, float, float, float, float]

MOST_ROWS: Final = 64
"""Largest number of stationary discs, and of moving ones, in a decision; those with the least h are used."""


@cache
def load_selection() -> Any:
    """Returns the compiled functions of this module, or None; the first call may compile for two seconds."""
    try:
        return load_module()
    except NoKernelError:
        return None


def discs_near(rows: Rows, x: float, y: float, within: float, room: float) -> tuple[list[int], list[Disc]]:
    """Returns indices and (x, y, radius + ``room``) [m] of the discs ``rows`` (m, 3) within ``within`` [m] of (x, y).

    The distance is measured to the disc enlarged by ``room``. Raises InputError for rows of a wrong width or invalid
    discs.
    """
    compiled = load_selection()
    found: tuple[list[int], list[Disc]] | None = compiled and compiled.discs_near(rows, x, y, within, room)
    if found is not None:
        return found
    kept: list[int] = []
    discs: list[Disc] = []
    total, negative = 0.0, False
    for index in range(len(rows)):
        row = rows[index]
        if len(row) != 3:
            raise _width("points", 3)
        there_x: float = row[0]
        there_y: float = row[1]
        size: float = row[2]
        total += there_x + there_y + size
        negative = negative or size < 0.0
        reach = size + room
        apart_x, apart_y, limit = there_x - x, there_y - y, within + reach
        if apart_x * apart_x + apart_y * apart_y < limit * limit:
            kept.append(index)
            discs.append((there_x, there_y, reach))
    _check("points", rows, total, negative)
    return kept, discs


def fastest_of(movers: Rows, hidden: Rows) -> float:
    """Returns the largest speed [m/s], the last column of ``movers`` (m, 6) and ``hidden`` positions (k, 4); 0 if none.

    Raises InputError for rows of a wrong width or invalid discs.
    """
    one, other = _fastest("movers", movers, 6), _fastest("hidden", hidden, 4)
    return one if one > other else other


def moving_near(
    movers: Rows, hidden: Rows, place: Sequence[float], within: float, room: float, period: float
) -> tuple[list[int], list[Moving], list[Moving]]:
    """Returns the movers, followed by hidden positions, that may come within ``within`` [m] of ``place`` in s seconds.

    ``place`` is (x, y, s). The result has their indices; rows x, y, radius + ``room`` + w ``period`` [m], speed w, and
    the speed that counts behind the car; and for the hidden ones alone the rows with w behind the car as well. The rows
    must have been validated by ``fastest_of``.
    """
    x: float = place[0]
    y: float = place[1]
    seconds: float = place[2]
    kept: list[int] = []
    discs: list[Moving] = []
    everywhere: list[Moving] = []
    count = len(movers)
    for index in range(count + len(hidden)):
        row = movers[index] if index < count else hidden[index - count]
        there_x: float = row[0]
        there_y: float = row[1]
        size: float = row[2]
        fast: float = row[5] if index < count else row[3]
        reach = size + room + fast * period
        apart_x, apart_y, limit = there_x - x, there_y - y, within + reach + fast * seconds
        if apart_x * apart_x + apart_y * apart_y < limit * limit:
            kept.append(index)
            discs.append((there_x, there_y, reach, fast, fast if index < count else 0.0))
            if index >= count:
                everywhere.append((there_x, there_y, reach, fast, fast))
    return kept, discs, everywhere


def below(values: Sequence[float], limit: float) -> list[int]:
    """Places of those that are less than ``limit``."""
    found: list[int] = []
    for index in range(len(values)):
        value: float = values[index]
        if value < limit:
            found.append(index)
    return found


def _fastest(name: str, rows: Rows, width: int) -> float:
    compiled = load_selection()
    known: float | None = compiled and compiled.fastest(rows, width)
    if known is not None:
        return known
    fastest, total, negative = 0.0, 0.0, False
    for row in rows:
        if len(row) != width:
            raise _width(name, width)
        for column in range(width):
            value: float = row[column]
            total += value
        size: float = row[2]
        fast: float = row[width - 1]
        negative = negative or size < 0.0 or fast < 0.0
        fastest = fast if fast > fastest else fastest
    _check(name, rows, total, negative)
    return fastest


def _width(name: str, width: int) -> InputError:
    return InputError(f"{name}: got rows of other lengths, wanted {width} numbers each")


def _check(name: str, rows: Rows, total: float, negative: bool) -> None:
    """Raises InputError if ``rows`` with the sum ``total`` are not finite, or any radius or speed is ``negative``."""
    # The sum is only a quick check: finite values near the largest float can have an infinite sum.
    if total - total != 0.0 and not all(map(isfinite, [value for row in rows for value in row])):
        raise InputError(f"{name}: got NaN or infinity, wanted finite x, y, radius and speed")
    if negative:
        raise InputError(f"{name}: got a radius or a speed below 0, wanted 0 or more")
