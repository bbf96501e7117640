"""The goal seeker of the point robot: drives to the goal and passes hazards in between.

    wanted = (cruise direction - velocity) / time - (wind - drag velocity)            acceleration
    thrust = mass clip(wanted . heading),  turn = clip(gain angle from heading to wanted)

The direction is that of the goal, or, if a hazard is ahead, the one that passes it on the closer side. Safety is left
to the filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, atan2, cos, hypot, pi, sin
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import PhysicsModel
from safedpa.errors import MessageError

_CRUISE = 0.7
"""m/s."""
_SECONDS = 0.25
"""s; time constant of the velocity control."""
_APPROACH = 2.0
"""1/s; speed per distance to the goal."""
_GAIN = 6.0
"""1/s; gain of the heading control."""
_BERTH = 0.12
"""m between robot and hazard when passing."""
_LOOK = 0.9
"""m; hazards farther away are ignored."""
_LIMITS: Final = (0.015, 3.0)
"""N and rad/s; limits of the simulated robot."""


@final
class PointSeeker:
    """The controller of one robot; the wind is taken from the latent, if the model has it."""

    def __init__(self, model: PhysicsModel) -> None:
        self._model = model
        self._mass = model.settings["base.mass"].value if "base.mass" in model.settings else 1.0
        drag = model.settings.get("viscous_drag.coefficient")
        self._drag = drag.value if drag is not None else 0.0

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns thrust [N] and turn [rad/s]. Raises MessageError for the state of another robot."""
        if len(state.values) != 5 or len(state.goal) != 2:
            raise MessageError(f"state: got {len(state.values)} values and a goal of {len(state.goal)}, wanted 5 and 2")
        for row in state.obstacles:
            if len(row) != 3:
                raise MessageError(f"state.obstacles: got a row of {len(row)}, wanted x, y, radius")
        push, turn = goal_seeking_action(state.values, state.goal, state.obstacles, self._wind(latent), self._drag)
        limited = (min(max(value, -most), most) for value, most in zip((self._mass * push, turn), _LIMITS, strict=True))
        return tuple(limited), "goal_seeker:seek"

    def _wind(self, latent: NDArray[np.float64] | None) -> tuple[float, float]:
        known = dict(zip(self._model.latent_names, () if latent is None else latent.tolist(), strict=False))
        return known.get("constant_force.ax", 0.0), known.get("constant_force.ay", 0.0)


def goal_seeking_action(
    state: Sequence[float],
    goal: Sequence[float],
    hazards: Sequence[Sequence[float]],
    wind: Sequence[float],
    drag: float,
) -> tuple[float, float]:
    """Returns acceleration along the heading [m/s2] and turn [rad/s] at ``state`` (5,), without limits.

    ``goal`` (2,), ``hazards`` (m, 3): x, y, radius; ``wind`` (2,) [m/s2]; ``drag`` [1/s].
    """
    x, y, yaw, vx, vy = state
    apart = goal[0] - x, goal[1] - y
    distance = hypot(*apart)
    way = _around(x, y, hazards, atan2(apart[1], apart[0]), distance)
    speed = min(_CRUISE, _APPROACH * distance + 0.2)
    wanted_x = (speed * cos(way) - vx) / _SECONDS - wind[0] + drag * vx
    wanted_y = (speed * sin(way) - vy) / _SECONDS - wind[1] + drag * vy
    turn = _GAIN * _wrapped(atan2(wanted_y, wanted_x) - yaw)
    return wanted_x * cos(yaw) + wanted_y * sin(yaw), turn


def _around(x: float, y: float, hazards: Sequence[Sequence[float]], way: float, distance: float) -> float:
    """Returns the direction, turned to pass the nearest hazard in it."""
    nearest, chosen = min(_LOOK, distance), way
    for row in hazards:
        to_x, to_y, reach = row[0] - x, row[1] - y, row[2] + _BERTH
        far = hypot(to_x, to_y)
        if far - reach >= nearest:
            continue
        off = _wrapped(atan2(to_y, to_x) - way)
        half = asin(min(reach / max(far, 1e-6), 1.0)) if far > reach else 0.5 * pi
        if abs(off) < half:
            nearest, chosen = far - reach, way + off - (half if off >= 0.0 else -half)
    return chosen


def _wrapped(angle: float) -> float:
    return (angle + pi) % (2.0 * pi) - pi
