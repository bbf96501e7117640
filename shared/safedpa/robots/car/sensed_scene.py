"""The barriers of what a car's sensors see: the discs that can matter now, and the speed limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain
from math import isfinite
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import NUMPY
from safedpa.robots.car.barriers import ObstacleBarrier, braking_of, checked_footprint
from safedpa.robots.car.counter_braking import STANDS, CounterBraking
from safedpa.robots.car.quickness import ORDINARY, Quickness
from safedpa.robots.car.sensed_barrier import MoverBarrier
from safedpa.robots.car.sensed_far import far_of
from safedpa.robots.car.towed_reach import TowedReach
from safedpa.safety.barrier import AbstractStack, RememberingStack
from safedpa.safety.equation_barrier import AbstractEquationBarrier
from safedpa.safety.settings import FilterSettings
from safedpa.safety.speed_barrier import SpeedBarrier
from safedpa.safety.stacks import stacked

__all__ = ["MOST_ROWS", "Sensed", "counter_braking_of", "sensed_barriers"]

Values = NDArray[np.float64]
Rows = NDArray[np.int64]

MOST_ROWS: Final = 64
"""Discs of each kind, at rest and not, that a decision looks at: those with the least h."""
_WIDTHS: Final = (("points", 3), ("movers", 6), ("hidden", 4))


@final
@dataclass(frozen=True)
class Sensed:
    """The barriers of one tick, and what is to be said of them."""

    barriers: AbstractStack
    yields_to: str
    """Who may be at the car before it stands, in words; empty where there is nobody."""
    left_out: str
    """What was not looked at though it is near, in words; empty where everything was."""


def counter_braking_of(settings: FilterSettings, *, servo: bool = True) -> CounterBraking:
    """The braking that is guaranteed to a car that may be told a speed the other way round: one with a ``servo``."""
    against = max(-settings.action_low[0], 0.0) if servo else 0.0
    return CounterBraking(settings.barrier("braking_deceleration"), settings.barrier("braking_gain"), against)


def sensed_barriers(
    settings: FilterSettings,
    counter: CounterBraking,
    state: StateMessage,
    seen: SurroundingsMessage,
    towed: TowedReach | None,
    epsilon: Mapping[str, float] | None = None,
    late: float = 0.0,
    quick: Quickness = ORDINARY,
) -> Sensed:
    """Of what is around a car at the moment of ``state``. Raises InputError for rows of a wrong width.

    ``epsilon`` by kind are the margins in force, else those of the settings; an action acts ``late`` [s] after the
    state. ``quick``: how quick the model of the car is.
    """
    body = checked_footprint(state.footprint)
    points, movers, places = (_table(seen, name, width) for name, width in _WIDTHS)
    discs = np.vstack([movers[:, [0, 1, 2, 5]], places])
    hidden = np.arange(len(discs)) >= len(movers)
    braking, clearance, own = braking_of(settings), settings.barrier("clearance"), settings.barrier("own_radius")

    def named(row: int) -> str:
        return f"mover {row}" if row < len(movers) else f"hidden {row - len(movers)}"

    def at_rest(rows: Rows) -> ObstacleBarrier:
        names = tuple([f"point {row}" for row in rows.tolist()])
        return ObstacleBarrier(points[rows], body, braking, clearance, names, towed)

    def moving(rows: Rows) -> MoverBarrier:
        names = tuple(map(named, rows.tolist()))
        unseen = hidden[rows].tolist()
        known = body, braking, counter, clearance, state.period, names, towed
        return MoverBarrier(discs[rows], unseen, *known, creeps=settings.barrier("creeping"), own_radius=own)

    speeds, kept = (settings.barrier("speed_low"), settings.barrier("speed_high")), body[2] + clearance
    thick = body[2] if towed is None else min(own or body[2], body[2])
    none, margins = np.arange(0), {**settings.epsilon, **(epsilon or {})}

    def far(barrier: AbstractEquationBarrier) -> float:
        return far_of(barrier, state, settings.eta, margins.get(barrier.kind, margins.get("default", 0.0)), late, quick)

    resting = at_rest(none)
    still, _, fewer = _that_matter(resting, (*points[:, :2].T, points[:, 2] + kept), state, speeds, far)
    x, y, radius, fastest = discs.T
    everywhere = (x, y, radius + thick + clearance + fastest * state.period, fastest, fastest)
    each = (*everywhere[:4], np.where(hidden, 0.0, fastest))
    able = moving(none) if len(discs) else resting
    # without creeping: a car that creeps has h to spare of what is near, and none of it once it drives
    strict = (*able.shared[:7], float(fastest.max()), 0.0, *able.shared[9:]) if len(discs) else ()
    swiftest = able.sharing(strict) if len(discs) else able
    may_move, h, fewer_movers = _that_matter(swiftest, each, state, speeds, far, everywhere)
    stands = len(state.values) == len(MoverBarrier.reads) and abs(state.values[3]) <= STANDS
    left_out = " and ".join(
        filter(None, (f"{fewer} points" * bool(fewer), f"{fewer_movers} movers" * bool(fewer_movers)))
    )
    return Sensed(
        RememberingStack(stacked([at_rest(still), moving(may_move), SpeedBarrier(*speeds)])),
        _who_may_touch(h[: len(movers)] if stands else h, named),
        f"Of {left_out} near it, those with the least h were looked at." if left_out else "",
    )


def _table(seen: SurroundingsMessage, name: str, width: int) -> Values:
    rows = getattr(seen, name)
    if not rows:
        return np.empty((0, width))
    if set(map(len, rows)) != {width}:
        raise InputError(f"{name}: got rows of other lengths, wanted {width} numbers each")
    table = np.fromiter(chain.from_iterable(rows), np.float64, len(rows) * width).reshape(-1, width)
    if not isfinite(table.sum()) and not np.isfinite(table).all():
        raise InputError(f"{name}: got NaN or infinity, wanted finite x, y, radius and speed")
    if (table[:, [2, -1]] < 0.0).any():  # of points both are the radius
        raise InputError(f"{name}: got a radius or a speed below 0, wanted 0 or more")
    return table


def _that_matter(
    barrier: AbstractEquationBarrier,
    each: tuple[Values, ...],
    state: StateMessage,
    speeds: tuple[float, float],
    far: Callable[[AbstractEquationBarrier], float],
    everywhere: tuple[Values, ...] | None = None,
) -> tuple[Rows, Values, int]:
    """The rows that can matter in this tick, h of all at the state, and how many there were if not all were taken.

    By the equation of a ``barrier`` of the same body, over arrays: ``each`` (numbers, m). Of too many those with the
    least h at the state or at either end of the speeds: what moves by itself matters to a car that drives off, though
    it may be far while the car stands. What is far is told by the numbers that hold ``everywhere``, where others hold
    behind the car alone: a little turn brings a place before it, and h falls there all at once.
    """
    count = len(each[0])
    if not count or len(state.values) != len(MoverBarrier.reads):
        return np.arange(count), np.empty(0), 0
    heights: Values = np.asarray(barrier.h(Given(state.values, barrier.shared, each), NUMPY)[0])
    lowest = heights
    if everywhere is not None:
        lowest = np.asarray(barrier.h(Given(state.values, barrier.shared, everywhere), NUMPY)[0])
    near = np.flatnonzero(lowest < far(barrier))
    if len(near) <= MOST_ROWS:
        return near, heights, 0
    at = np.array([[state.values[3]], *([speed] for speed in speeds)])
    nearest = tuple(numbers[near] for numbers in each)
    least: Values = np.asarray(barrier.h(Given((*state.values[:3], at), barrier.shared, nearest), NUMPY)[0]).min(axis=0)
    chosen = near[np.argpartition(least, MOST_ROWS)[:MOST_ROWS]]
    return np.sort(chosen), heights, len(near)


def _who_may_touch(h: Values, named: Callable[[int], str]) -> str:
    """Of movers and, behind them, hidden places: who may be at the car before it stands."""
    if not len(h) or float(h.min()) >= 0.0:
        return ""
    who = named(int(np.argmin(h)))
    return f"{who if who.startswith('mover') else 'somebody whom nobody sees'} may be at the robot before it stands"
