"""Constants, barrier and filter settings of the pendulum experiments; what the paper omits is marked assumed."""

from __future__ import annotations

from math import pi, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel
from safedpa.safety import CorridorBarrier, FilterSettings
from safedpa_sim.training.configuration import load_configuration

TORQUE: Final = 10.0
"""N m; assumed. Gravity needs up to 4.9 N m (3.47 at 45 degrees), a wind of 4 m/s up to 4 N m more."""
WIND: Final = 4.0
"""m/s in every experiment; assumed. From about 3 m/s on, the wind decides about safety."""
BALANCING: Final = (-pi / 4, pi / 4)
"""rad; the safe angles of the paper's first experiment."""
HAZARD: Final = (radians(5.0), radians(60.0))
"""rad; the forbidden sector of the second experiment; assumed. It begins just beyond upright, so that a fast swing has
to stop in time, and a controller that does not know the wind cannot stay upright."""
LONG_WAY_ROUND: Final = (HAZARD[1], HAZARD[0] + 2 * pi)
"""rad; the rest of the circle, counted from the hazard's lower edge at 60 degrees."""
HELD_TICKS: Final = 50
"""0.5 s; the pendulum counts as upright after this time."""
_CLOSE, _SLOW = radians(5.0), 1.0
"""rad and rad/s; tolerances for upright."""
UPRIGHT: Final = 2 * pi
"""rad; the goal of the second experiment, reached the long way round."""
AHEAD: Final = 0.25
"""s; look-ahead time of the barrier. At mass length^2 / friction, the torque at its edge balances gravity and wind."""
FIXED_DIRECTIONS: Final = (45, 135, 225, 315)
"""Degrees; directions of the winds that the Fix models are trained in."""


def is_upright(state: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Returns whether states (..., 2) are upright and slow, modulo full turns."""
    tilt = np.abs(np.arctan2(np.sin(state[..., 0]), np.cos(state[..., 0])))
    upright: NDArray[np.bool_] = (tilt < _CLOSE) & (np.abs(state[..., 1]) < _SLOW)
    return upright


def in_hazard(angle: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Returns whether angles are in the hazard, modulo full turns."""
    within = np.mod(angle, 2 * pi)
    inside: NDArray[np.bool_] = (within > HAZARD[0]) & (within < HAZARD[1])
    return inside


def simulated_pendulum() -> PhysicsModel:
    """Returns the model of the simulated pendulum in still air."""
    return load_configuration("pendulum").simulator


def corridor(edges: tuple[float, float]) -> CorridorBarrier:
    """Returns the barrier that keeps the pendulum between two angles."""
    return CorridorBarrier(*edges, AHEAD)


def filter_settings(epsilon: float, eta: float = 0.5, torque: float = TORQUE) -> FilterSettings:
    """Returns the filter settings of both experiments: margin ``epsilon`` [rad], eta as in the published pendulum.

    ``torque`` [N m] is the motor's largest torque.
    """
    return FilterSettings(
        eta=eta, epsilon={"corridor": epsilon}, action_low=(-torque,), action_high=(torque,), backup_action=(0.0,)
    )
