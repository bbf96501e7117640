"""The goal seeker: drives to the goal and passes the obstacle in between on its closer side."""

from __future__ import annotations

from math import asin, atan2, cos, hypot, pi
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.errors import InputError
from safedpa.policy.grid_route import GridRoute

_FASTEST, _FASTEST_TURN = 0.5, 1.9
_TURN_GAIN = 2.5
"""1/s"""
_BERTH = 0.15
"""m between body and obstacle when passing."""
_SENSED_BERTH = 0.13
"""m between body and sensed points on a route: clearance and margin of the filter."""
_AHEAD = 1.5
"""m; obstacles farther away are ignored."""


@final
class WheeledSeeker:
    """target_speed = 0.5 m/s max(cos e, 0), target_turn_rate = 2.5 e, e the angle from the heading to the direction.

    With ``looks`` false it ignores obstacles and leaves them to the filter.
    """

    def __init__(self, looks: bool = True) -> None:
        self._looks = looks
        self._route: GridRoute | None = None
        self._seen: SurroundingsMessage | None = None

    def look(self, seen: SurroundingsMessage | None) -> None:
        """Sets what the sensors see, for the next state; None keeps the last."""
        self._seen = seen if seen is not None else self._seen

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns the action (2,) and the controller's name. Raises InputError without a goal."""
        del latent
        if len(state.goal) != 2:
            raise InputError(f"goal: got {len(state.goal)} numbers, wanted x and y in m")
        x, y, yaw = state.values[:3]
        error = _wrapped(self._way(state, x, y) - yaw)
        turn = min(max(_TURN_GAIN * error, -_FASTEST_TURN), _FASTEST_TURN)
        return (_FASTEST * max(cos(error), 0.0), turn), "goal_seeker" if self._looks else "straight"

    def _way(self, state: StateMessage, x: float, y: float) -> float:
        """Returns the direction to drive in, rad in the world frame."""
        if self._looks and state.sources:
            return self._sensed_way(state, x, y)
        way = atan2(state.goal[1] - y, state.goal[0] - x)
        distance = hypot(state.goal[0] - x, state.goal[1] - y)
        reach = (state.footprint[2] if len(state.footprint) == 3 else 0.0) + _BERTH
        for other_x, other_y, radius in state.obstacles if self._looks else ():
            apart = hypot(other_x - x, other_y - y)
            towards = atan2(other_y - y, other_x - x)
            aside = _wrapped(way - towards)
            needed = asin(min(1.0, (radius + reach) / max(apart, 1e-9)))
            if apart < min(distance, _AHEAD) + radius and abs(aside) < needed:
                way = towards + (needed if aside >= 0.0 else -needed)
        return way

    def _sensed_way(self, state: StateMessage, x: float, y: float) -> float:
        """Returns the direction along the route around what the sensors see."""
        if self._route is None:
            self._route = GridRoute((state.footprint[2] if len(state.footprint) == 3 else 0.0) + _SENSED_BERTH)
        self._route.look(self._seen)
        to_x, to_y = self._route.aim((x, y), state.goal, state.robot_time)
        return atan2(to_y - y, to_x - x)


def _wrapped(angle: float) -> float:
    return (angle + pi) % (2.0 * pi) - pi
