"""The barriers of perceived surroundings: the discs that can be relevant in this tick, and the speed limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf
from typing import Final, TypeAlias, final

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.robots.car.barriers.body import TrailerEnvelope
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import Footprint, ObstacleBarrier, checked_footprint
from safedpa.robots.car.barriers.pruning import irrelevance_distance
from safedpa.robots.car.dynamics.limits import IS_STATIONARY, ORDINARY, PerformanceLimits, ReversalBraking
from safedpa.safety.barriers.base import AbstractBarrierSet, CachingBarrierSet
from safedpa.safety.barriers.disc_selection import fastest_of
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.barriers.sensed_selection import Vicinity, remark_about, select_movers, select_points
from safedpa.safety.barriers.stack import CompiledBarrierSet
from safedpa.safety.barriers.stopping import Braking
from safedpa.safety.settings import FilterSettings

Far: TypeAlias = Callable[[AbstractEquationBarrier], float]
"""Returns the value of h above which a disc of a barrier is irrelevant."""

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
    return SensedBarriers(
        CachingBarrierSet(CompiledBarrierSet([resting, moving, limits])),
        who,
        remark_about(fewer, fewer_movers),
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
    near = Vicinity()
    if len(state.values) == len(MovingObstacleBarrier.reads):
        limit, within = inf, inf
        if seen.points:
            limit, arm = far(still), still.scalar_rows(len(state.values)).grad_bound(state.values)[2]
            within = limit + arm + (0.0 if towed is None else towed.most) + _ROUNDING
        near = Vicinity(state.values[0], state.values[1], within, limit, state.values, _compared(state, speeds))
    found = select_points(still, seen.points, room, near)
    return still.with_items(found.discs, found.names), found.left_out


def _moving(
    able: MovingObstacleBarrier,
    state: StateMessage,
    seen: SurroundingsMessage,
    clearance: float,
    speeds: Sequence[float],
    far: Far,
) -> tuple[MovingObstacleBarrier, int, str]:
    """Returns the barrier with the relevant movers, their number if some were left out (else 0), and who may touch
    it."""
    if not (seen.movers or seen.hidden):
        return able, 0, ""
    values, fastest = state.values, fastest_of(seen.movers, seen.hidden)
    swiftest, near, stands = able.with_speed(fastest, creeps=0.0), Vicinity(), False
    if len(values) == len(MovingObstacleBarrier.reads):
        limit, within = far(swiftest), inf
        if not able.tows:  # with a load the bound below, which is for the body only, does not hold
            within = limit + swiftest.scalar_rows(len(values)).grad_bound(values)[2] + _ROUNDING
        compared, seconds = _compared(state, speeds), able.seconds(values[3])
        near, stands = (
            Vicinity(values[0], values[1], within, limit, values, compared, seconds),
            abs(values[3]) <= IS_STATIONARY,
        )
    room = able.thick + clearance
    found = select_movers(swiftest, seen.movers, seen.hidden, room, state.period, near, stands)
    chosen = able.with_speed(max([disc[3] for disc in found.discs], default=0.0))
    return chosen.with_items(found.discs, found.names), found.left_out, found.yields_to


def _compared(state: StateMessage, speeds: Sequence[float]) -> tuple[tuple[float, ...], ...]:
    """Returns the state, and the state at either end of ``speeds``."""
    return tuple((*state.values[:3], speed) for speed in (state.values[3], *speeds))
