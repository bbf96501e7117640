"""What a car's sensors see as items of its barriers, in one pass over plain numbers: checked, and near enough to ask.

A disc at c of which h has to be known below a limit f is left out where its distance alone says more: no part of the
body is farther from the car's place p than the longest arm L, so h >= |c - p| - L - reach, and it is left out where

    |c - p| >= f + L + reach.

As everything in here is a loop over what one message tells, it is compiled with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import TypeAlias

from safedpa.errors import InputError

__all__ = ["below", "discs_near", "moving_discs"]

Rows: TypeAlias = tuple[tuple[float, ...], ...]
Disc: TypeAlias = tuple[float, float, float]
Moving: TypeAlias = tuple[float, float, float, float, float]


def discs_near(rows: Rows, x: float, y: float, within: float, room: float) -> tuple[list[int], list[Disc]]:
    """Indices and (x, y, radius + ``room``) [m] of the discs ``rows`` (m, 3) that reach to within ``within`` [m] of
    (x, y), ``room`` added to their radius. Raises InputError for rows of a wrong width, or that are no discs.
    """
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


def moving_discs(movers: Rows, hidden: Rows, room: float, period: float) -> tuple[list[Moving], list[Moving]]:
    """Of ``movers`` (m, 6) and behind them ``hidden`` places (k, 4): x, y, radius + ``room`` + w ``period`` [m], the
    speed w [m/s], and the one that counts behind the car; of the hidden ones alone the same with w behind it as well.

    Raises InputError for rows of a wrong width, or that are no discs.
    """
    discs: list[Moving] = []
    everywhere: list[Moving] = []
    total, negative = 0.0, False
    for row in movers:
        if len(row) != 6:
            raise _width("movers", 6)
        x: float = row[0]
        y: float = row[1]
        size: float = row[2]
        fast: float = row[5]
        total += x + y + size + row[3] + row[4] + fast
        negative = negative or size < 0.0 or fast < 0.0
        discs.append((x, y, size + room + fast * period, fast, fast))
    _check("movers", movers, total, negative)
    total, negative = 0.0, False
    for row in hidden:
        if len(row) != 4:
            raise _width("hidden", 4)
        there_x: float = row[0]
        there_y: float = row[1]
        radius: float = row[2]
        coming: float = row[3]
        total += there_x + there_y + radius + coming
        negative = negative or radius < 0.0 or coming < 0.0
        reach = radius + room + coming * period
        discs.append((there_x, there_y, reach, coming, 0.0))
        everywhere.append((there_x, there_y, reach, coming, coming))
    _check("hidden", hidden, total, negative)
    return discs, everywhere


def below(heights: Sequence[float], limit: float) -> list[int]:
    """Places of those that are less than ``limit``."""
    found: list[int] = []
    for index in range(len(heights)):
        height: float = heights[index]
        if height < limit:
            found.append(index)
    return found


def _width(name: str, width: int) -> InputError:
    return InputError(f"{name}: got rows of other lengths, wanted {width} numbers each")


def _check(name: str, rows: Rows, total: float, negative: bool) -> None:
    """Of ``rows`` with the sum ``total``, some radius or speed of which is ``negative``."""
    # finite numbers have an infinite sum where they are as large as a float can be
    if total - total != 0.0 and not all(map(isfinite, [value for row in rows for value in row])):
        raise InputError(f"{name}: got NaN or infinity, wanted finite x, y, radius and speed")
    if negative:
        raise InputError(f"{name}: got a radius or a speed below 0, wanted 0 or more")
