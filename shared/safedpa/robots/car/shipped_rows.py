"""The barriers of the car's scenes as C, compiled when a wheel or the environment is built."""

from __future__ import annotations

from safedpa.native.steps import rows_source
from safedpa.robots.car.barriers.body import TrailerEnvelope
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import FieldBarrier, ObstacleBarrier
from safedpa.robots.car.dynamics.limits import ReversalBraking
from safedpa.safety.barriers.equation import AbstractEquationBarrier, Pattern, pattern_of, tape_of
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.barriers.stopping import Braking

__all__ = ["STATES", "patterns", "sources"]

STATES = 4
_BODY = (0.1, 0.4, 0.1)
_FIELD = (-1.0, 1.0, -1.0, 1.0)


def patterns() -> list[Pattern]:
    """Returns the pattern of each set of barriers in the car's scenes, with and without a trailer.

    Lengths and limits do not matter here: they are arguments of the recorded equations.
    """
    found = []
    for towed in (None, TrailerEnvelope(0.1, 0.5, 0.2, 0.0, (0.0, 0.0, 0.0))):
        braking = Braking(2.0, 2.5)
        obstacles = ObstacleBarrier((), _BODY, braking, towed=towed)
        field = FieldBarrier(_FIELD, _BODY, braking, towed=towed)
        speed = SpeedBarrier(-1.0, 1.0)
        movers = MovingObstacleBarrier((), (), _BODY, braking, ReversalBraking(2.0, 2.5, 0.6), towed=towed)
        sets: tuple[tuple[AbstractEquationBarrier, ...], ...] = (
            (obstacles, speed),
            (obstacles, field, speed),
            (obstacles, movers, speed),
            (obstacles,),
            (movers,),
        )
        found += [pattern_of(parts) for parts in sets]
    return found


def sources() -> list[str]:
    """Returns the C of these barriers."""
    return [rows_source(tape_of(pattern, STATES))[0] for pattern in patterns()]
