"""Pruning of irrelevant discs: those whose h is so large that no action can violate their constraint.

An action begins to act ``late`` seconds after the state and acts for one period p. The speed is then at most u = |v| +
A (late + p). In s seconds the car moves at most R u s, turns by at most K u s, and changes its speed by at most A s.
With the bounds of the barrier's derivatives at that speed, h decreases in s seconds by at most

    F(s) = sqrt(2) place R u s + arm K u s + change A s,

and every action satisfies the constraint h(x+) >= (1 - eta) h(x) + epsilon if

    h >= F(late) + (F(p) + epsilon) / eta,     or F(late) + F(p) + epsilon for a barrier that may use up h at once.

This needs an h with these derivative bounds everywhere, so for hidden positions the h with the speed behind the car is
used. epsilon is doubled, because an online margin may increase before the decision.

Most discs are dropped before their h is computed. No part of the body is farther from the car's position p than the
longest arm L, and a mover at up to speed w can move w T(v) until the car stops, so a disc at c has

    h >= |c - p| - L - reach - w T(v).

A message is processed in a single pass over plain floats, which also validates the discs; the module is compiled by
mypyc.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, sqrt
from typing import Final, TypeAlias

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.robots.car.dynamics.limits import PerformanceLimits
from safedpa.safety.barriers.equation import AbstractEquationBarrier

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
    """Returns the value of h [m] from which on no action of one period can violate the constraint of a disc.

    ``barrier`` is any one with the same shared parameters, for the state x, y, yaw, speed, with bounded derivatives.
    ``car`` holds A, K and R of the model.
    """
    if not isfinite(car.acceleration + car.curvature + car.reach):
        return float("inf")
    speed = abs(state.values[3]) + car.acceleration * (late + state.period)
    place, arm, change = 0.0, 0.0, 0.0
    rows = barrier.scalar_rows(len(state.values))
    for signed in (speed, -speed):
        bounds = rows.grad_bound((*state.values[:3], signed))
        if bounds is None:
            return float("inf")
        x, y, turned, faster = bounds
        place, arm, change = max(place, x, y), max(arm, turned), max(change, faster)
    each_second = sqrt(2.0) * place * car.reach * speed + arm * car.curvature * speed + change * car.acceleration
    spent = each_second * state.period + _WIDENED * epsilon
    return each_second * late + (spent if barrier.at_once else spent / eta)


def discs_near(rows: Rows, x: float, y: float, within: float, room: float) -> tuple[list[int], list[Disc]]:
    """Returns indices and (x, y, radius + ``room``) [m] of the discs ``rows`` (m, 3) within ``within`` [m] of (x, y).

    The distance is measured to the disc enlarged by ``room``. Raises InputError for rows of a wrong width or invalid
    discs.
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
    """Raises InputError if ``rows`` with the sum ``total`` are not finite, or any radius or speed is ``negative``."""
    # The sum is only a quick check: finite values near the largest float can have an infinite sum.
    if total - total != 0.0 and not all(map(isfinite, [value for row in rows for value in row])):
        raise InputError(f"{name}: got NaN or infinity, wanted finite x, y, radius and speed")
    if negative:
        raise InputError(f"{name}: got a radius or a speed below 0, wanted 0 or more")
