"""The barriers of perceived surroundings: the discs that can be relevant in this tick, and the speed limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf
from typing import Final, TypeAlias, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.equations import Given
from safedpa.operations import NUMPY
from safedpa.robots.car.barriers.body import TrailerEnvelope
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import Footprint, ObstacleBarrier, checked_footprint
from safedpa.robots.car.barriers.pruning import below, discs_near, fastest_of, irrelevance_distance, moving_near
from safedpa.robots.car.dynamics.limits import IS_STATIONARY, ORDINARY, PerformanceLimits, ReversalBraking
from safedpa.safety.barriers.base import AbstractBarrierSet, CachingBarrierSet
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.barriers.stack import CompiledBarrierSet
from safedpa.safety.barriers.stopping import Braking
from safedpa.safety.settings import FilterSettings

Far: TypeAlias = Callable[[AbstractEquationBarrier], float]
"""Returns the value of h above which a disc of a barrier is irrelevant."""

MOST_ROWS: Final = 64
"""Largest number of stationary discs, and of moving ones, in a decision; those with the least h are used."""
_NUMBERS: Final = (
    "braking_deceleration",
    "braking_gain",
    "clearance",
    "creeping",
    "own_radius",
    "speed_low",
    "speed_high",
)
_ROUNDING: Final = 1e-6
"""m; tolerance far above the rounding errors of distances."""


@final
@dataclass(frozen=True)
class SensedBarriers:
    """The barriers of one tick, with remarks for the verdict."""

    barriers: AbstractBarrierSet
    yields_to: str
    """The mover that may reach the car before it stops, as text; empty if none."""
    left_out: str
    """The relevant discs that were left out, as text; empty if none."""


def reversal_braking(settings: FilterSettings, *, servo: bool = True) -> ReversalBraking:
    """Returns the guaranteed braking with opposite speed commands, which only a car with a speed ``servo`` accepts."""
    against = max(-settings.action_low[0], 0.0) if servo else 0.0
    return ReversalBraking(settings.barrier("braking_deceleration"), settings.barrier("braking_gain"), against)


def sensed_barriers(
    settings: FilterSettings,
    counter: ReversalBraking,
    state: StateMessage,
    seen: SurroundingsMessage,
    towed: TrailerEnvelope | None,
    epsilon: Mapping[str, float] | None = None,
    late: float = 0.0,
    quick: PerformanceLimits = ORDINARY,
) -> SensedBarriers:
    """Builds the barriers of the surroundings at ``state``. Raises InputError for rows of a wrong width.

    ``epsilon`` holds the active margins by kind, by default those of the settings. An action acts ``late`` [s] after
    the state. ``quick`` holds the performance limits of the car's model.
    """
    body = checked_footprint(state.footprint)
    still, able, limits = _nothing_seen(tuple([settings.barrier(name) for name in _NUMBERS]), counter, body, towed)
    margins = {**settings.epsilon, **(epsilon or {})}

    def far(barrier: AbstractEquationBarrier) -> float:
        return irrelevance_distance(
            barrier, state, settings.eta, margins.get(barrier.kind, margins.get("default", 0.0)), late, quick
        )

    clearance, speeds = settings.barrier("clearance"), limits.each[0]
    resting, fewer = _resting(still, state, seen, body[2] + clearance, speeds, far, towed)
    moving, fewer_movers, who = _moving(able, state, seen, clearance, speeds, far)
    left_out = " and ".join(
        filter(None, (f"{fewer} points" * bool(fewer), f"{fewer_movers} movers" * bool(fewer_movers)))
    )
    return SensedBarriers(
        CachingBarrierSet(CompiledBarrierSet([resting, moving, limits])),
        who,
        f"Of {left_out} near it, those with the least h were looked at." if left_out else "",
    )


@lru_cache(maxsize=16)
def _nothing_seen(
    numbers: tuple[float, ...], counter: ReversalBraking, body: Footprint, towed: TrailerEnvelope | None
) -> tuple[ObstacleBarrier, MovingObstacleBarrier, SpeedBarrier]:
    """Returns the barriers for stationary discs, for movers and for the speed, all without discs."""
    deceleration, gain, clearance, creeps, own_radius, low, high = numbers
    braking = Braking(deceleration, gain)
    still = ObstacleBarrier((), body, braking, clearance, (), towed)
    able = MovingObstacleBarrier((), (), body, braking, counter, clearance, 0.0, (), towed, creeps, own_radius)
    return still, able, SpeedBarrier(low, high)


def _resting(
    still: ObstacleBarrier,
    state: StateMessage,
    seen: SurroundingsMessage,
    room: float,
    speeds: Sequence[float],
    far: Far,
    towed: TrailerEnvelope | None,
) -> tuple[ObstacleBarrier, int]:
    """Returns the barrier with the relevant points, and the number of relevant points if some were left out, else 0."""
    values, limit, within = state.values, inf, inf
    known = len(values) == len(MovingObstacleBarrier.reads)
    if known and seen.points:
        limit, arm = far(still), still.scalar_rows(len(values)).grad_bound(values)[2]
        within = limit + arm + (0.0 if towed is None else towed.most) + _ROUNDING
    x, y = values[:2] if known else (0.0, 0.0)
    rows, discs = discs_near(seen.points, x, y, within, room)
    near = list(range(len(rows)))
    if known:
        near = below(still.with_items(discs, ()).scalar_rows(len(values)).h_floats(values), limit)
    taken = _of_least_h(still, discs, near, state, speeds) if known and len(near) > MOST_ROWS else near
    names = tuple([f"point {rows[place]}" for place in taken])
    return still.with_items([discs[place] for place in taken], names), len(near) if len(taken) < len(near) else 0


def _moving(
    able: MovingObstacleBarrier,
    state: StateMessage,
    seen: SurroundingsMessage,
    clearance: float,
    speeds: Sequence[float],
    far: Far,
) -> tuple[MovingObstacleBarrier, int, str]:
    """Returns the barrier with the relevant movers, their number if some were left out (else 0), and who may touch it.

    Relevance is decided with the speeds that apply everywhere, not with those behind the car: after a small turn a
    hidden position may be ahead, and its h drops discontinuously.
    """
    if not (seen.movers or seen.hidden):
        return able, 0, ""
    values, fastest = state.values, fastest_of(seen.movers, seen.hidden)
    known = len(values) == len(MovingObstacleBarrier.reads)
    # Without creeping: while the car creeps, h of near discs is raised, but not any more once it drives.
    swiftest = able.with_speed(fastest, creeps=0.0)
    limit, within, place = inf, inf, (0.0, 0.0, 0.0)
    if known:
        limit, place = far(swiftest), (values[0], values[1], able.seconds(values[3]))
        if not able.tows:  # with a load the bound below, which is for the body only, does not hold
            within = limit + swiftest.scalar_rows(len(values)).grad_bound(values)[2] + _ROUNDING
    room = able.thick + clearance
    rows, discs, everywhere = moving_near(seen.movers, seen.hidden, place, within, room, state.period)
    taken, near, who = list(range(len(discs))), 0, ""

    def named(place: int) -> str:
        row = rows[place]
        return f"mover {row}" if row < len(seen.movers) else f"hidden {row - len(seen.movers)}"

    if known and discs:
        heights = swiftest.with_items([*discs, *everywhere], ()).scalar_rows(len(values)).h_floats(values)
        movers = len(discs) - len(everywhere)
        taken = below([*heights[:movers], *heights[len(discs) :]], limit)
        if len(taken) > MOST_ROWS:
            near, taken = len(taken), _of_least_h(swiftest, discs, taken, state, speeds)
        who = _who_may_touch(heights[: movers if abs(values[3]) <= IS_STATIONARY else len(discs)], named)
    kept = [discs[place] for place in taken]
    chosen = able.with_speed(max([disc[3] for disc in kept], default=0.0))
    return chosen.with_items(kept, tuple(map(named, taken))), near, who


def _of_least_h(
    barrier: AbstractEquationBarrier,
    discs: Sequence[tuple[float, ...]],
    near: Sequence[int],
    state: StateMessage,
    speeds: Sequence[float],
) -> list[int]:
    """Returns the ``MOST_ROWS`` indices among ``near`` with the least h at the state or at either end of ``speeds``: a
    mover that is irrelevant while the car is stationary may matter when it drives off."""
    at = np.array([[state.values[3]], *([speed] for speed in speeds)])
    items = tuple(np.array([discs[place] for place in near]).T)
    least: FloatArray = np.asarray(
        barrier.equation(Given((*state.values[:3], at), barrier.shared, items), NUMPY)[0]
    ).min(axis=0)
    return sorted([near[place] for place in np.argpartition(least, MOST_ROWS)[:MOST_ROWS].tolist()])


def _who_may_touch(h: Sequence[float], named: Callable[[int], str]) -> str:
    """Returns which of the movers and hidden positions may reach the car before it stops; empty if none."""
    least = min(h, default=0.0)
    if least >= 0.0:
        return ""
    who = named(h.index(least))
    return f"{who if who.startswith('mover') else 'an unseen person'} may reach the robot before it stops"
