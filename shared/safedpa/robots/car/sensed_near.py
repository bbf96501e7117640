"""What a car's sensors see as items of its barriers, in one pass over plain numbers: checked, and near enough to ask.

A disc at c of which h has to be known below a limit f is left out where its distance alone says more: no part of the
body is farther from the car's place p than the longest arm L, so h >= |c - p| - L - reach, and it is left out where

    |c - p| >= f + L + reach.

What moves by itself at up to w counts the more the longer the car takes to stand: w T(v) on top.

As everything in here is a loop over what one message tells, it is compiled with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import TypeAlias

from safedpa.errors import InputError

__all__ = ["below", "discs_near", "fastest_of", "moving_near"]

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


def fastest_of(movers: Rows, hidden: Rows) -> float:
    """The greatest speed w [m/s] of ``movers`` (m, 6) and ``hidden`` places (k, 4), whose last number it is; 0 of none.

    Raises InputError for rows of a wrong width, or that are no discs.
    """
    one, other = _fastest("movers", movers, 6), _fastest("hidden", hidden, 4)
    return one if one > other else other


def moving_near(
    movers: Rows, hidden: Rows, place: Sequence[float], within: float, room: float, period: float
) -> tuple[list[int], list[Moving], list[Moving]]:
    """Of movers and behind them hidden places those that may reach to within ``within`` [m] of a ``place`` (x, y, s) in
    s seconds: their indices; x, y, radius + ``room`` + w ``period`` [m], w, and the speed that counts behind the car;
    and of the hidden ones alone the same with w behind it as well. The rows are ones that ``fastest_of`` took.
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


def below(heights: Sequence[float], limit: float) -> list[int]:
    """Places of those that are less than ``limit``."""
    found: list[int] = []
    for index in range(len(heights)):
        height: float = heights[index]
        if height < limit:
            found.append(index)
    return found


def _fastest(name: str, rows: Rows, width: int) -> float:
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
    """Of ``rows`` with the sum ``total``, some radius or speed of which is ``negative``."""
    # finite numbers have an infinite sum where they are as large as a float can be
    if total - total != 0.0 and not all(map(isfinite, [value for row in rows for value in row])):
        raise InputError(f"{name}: got NaN or infinity, wanted finite x, y, radius and speed")
    if negative:
        raise InputError(f"{name}: got a radius or a speed below 0, wanted 0 or more")
