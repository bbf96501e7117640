"""Which discs need not be looked at: how large h has to be for no action to break its condition, and where it is.

From where an action begins to act, ``late`` seconds after the state, it is in force for one period p. By then the speed
is u = |v| + A (late + p) at most, in s seconds the car goes no farther than R u s, turns by no more than K u s, and its
speed changes by no more than A s. With the bounds of the barrier's slopes at that speed, h falls in s seconds by

    F(s) = sqrt(2) place R u s + arm K u s + change A s                                  at the most,

and the condition h(x+) >= (1 - eta) h(x) + epsilon is kept by every action where

    h >= F(late) + (F(p) + epsilon) / eta,     or F(late) + F(p) + epsilon where all of h may be used up at once.

That holds for an h with such slopes all over: of a place that no one sees the h that counts who hides behind as well.
Twice the margin is taken for epsilon: it is watched, and may widen before the decision is made.

Most of what is told is left out before its h is asked for: no part of the body is farther from the car's place p than
the longest arm L, and what moves by itself at up to w counts the more the longer the car takes to stand, T(v), so

    h >= |c - p| - L - reach - w T(v)            of a disc at c,

and it is far where that is. One message is one pass over plain numbers, which also says what is no disc; it is compiled
with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, sqrt
from typing import Final, TypeAlias

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.robots.car.dynamics.limits import PerformanceLimits
from safedpa.safety.barriers.equation import AbstractEquationBarrier

__all__ = ["below", "discs_near", "fastest_of", "irrelevance_distance", "moving_near"]

Rows: TypeAlias = tuple[tuple[float, ...], ...]
Disc: TypeAlias = tuple[float, float, float]
Moving: TypeAlias = tuple[float, float, float, float, float]

_WIDENED: Final = 2.0


def irrelevance_distance(
    barrier: AbstractEquationBarrier,
    state: StateMessage,
    eta: float,
    epsilon: float,
    late: float,
    car: PerformanceLimits,
) -> float:
    """h [m] of an item of ``barrier`` from which on no action of one period breaks its condition.

    ``barrier``: any with the same shared numbers; of the state x, y, yaw, speed, whose slopes are bounded. ``car``: A,
    K and R of its model.
    """
    if not isfinite(car.acceleration + car.curvature + car.reach):
        return float("inf")
    speed = abs(state.values[3]) + car.acceleration * (late + state.period)
    place, arm, change = 0.0, 0.0, 0.0
    rows = barrier.alone(len(state.values))
    for signed in (speed, -speed):
        bounds = rows.steepest((*state.values[:3], signed))
        if bounds is None:
            return float("inf")
        x, y, turned, faster = bounds
        place, arm, change = max(place, x, y), max(arm, turned), max(change, faster)
    each_second = sqrt(2.0) * place * car.reach * speed + arm * car.curvature * speed + change * car.acceleration
    spent = each_second * state.period + _WIDENED * epsilon
    return each_second * late + (spent if barrier.at_once else spent / eta)


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
