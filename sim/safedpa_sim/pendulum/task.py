"""The numbers of the pendulum experiments; those that the paper leaves out are assumptions, each said to be one."""

from __future__ import annotations

from math import pi, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel
from safedpa.safety import CorridorBarrier, FilterSettings
from safedpa_sim.training.configuration import load_configuration

__all__ = [
    "AHEAD",
    "BALANCING",
    "FIXED_DIRECTIONS",
    "HAZARD",
    "HELD_TICKS",
    "LONG_WAY_ROUND",
    "TORQUE",
    "UPRIGHT",
    "WIND",
    "corridor",
    "filter_settings",
    "in_hazard",
    "is_upright",
    "simulated_pendulum",
]


TORQUE: Final = 10.0
"""N m; assumption. Gravity asks for up to 4.9 N m (3.47 at 45 degrees), the wind of 4 m/s for at most 4 N m more."""
WIND: Final = 4.0
"""m/s in every experiment; assumption. From about 3 m/s on it decides about safety."""
BALANCING: Final = (-pi / 4, pi / 4)
"""rad; the safe angles of the paper's first question."""
HAZARD: Final = (radians(5.0), radians(60.0))
"""rad; the sector that must not be entered in the second question; assumption. It begins right behind upright, so
that who arrives fast has to stop in time, and who does not know the wind cannot stay."""
LONG_WAY_ROUND: Final = (HAZARD[1], HAZARD[0] + 2 * pi)
"""rad; what is left of the circle, counted on from the hazard's lower edge."""
HELD_TICKS: Final = 50
"""0.5 s; for so long the pendulum has to be upright before that counts."""
_CLOSE, _SLOW = radians(5.0), 1.0
"""rad and rad/s; what counts as upright."""
UPRIGHT: Final = 2 * pi
"""rad; the goal of the second question, as it is reached the long way round."""
AHEAD: Final = 0.25
"""s; the barrier's time. At mass length^2 / friction the torque that keeps it is that of gravity and wind alone."""
FIXED_DIRECTIONS: Final = (45, 135, 225, 315)
"""Degrees; the winds that the Fix models are trained in."""


def is_upright(state: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether states (..., 2) are upright and slow, whatever the number of turns."""
    tilt = np.abs(np.arctan2(np.sin(state[..., 0]), np.cos(state[..., 0])))
    upright: NDArray[np.bool_] = (tilt < _CLOSE) & (np.abs(state[..., 1]) < _SLOW)
    return upright


def in_hazard(angle: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether angles are in the hazard, whatever the number of turns."""
    within = np.mod(angle, 2 * pi)
    inside: NDArray[np.bool_] = (within > HAZARD[0]) & (within < HAZARD[1])
    return inside


def simulated_pendulum() -> PhysicsModel:
    """The pendulum that stands for the real one, in still air."""
    return load_configuration("pendulum").simulator


def corridor(edges: tuple[float, float]) -> CorridorBarrier:
    """The barrier that keeps the pendulum between two angles."""
    return CorridorBarrier(*edges, AHEAD)


def filter_settings(epsilon: float, eta: float = 0.5, torque: float = TORQUE) -> FilterSettings:
    """The filter of both questions: margin ``epsilon`` [rad], eta as in the published pendulum of the barrier.

    ``torque`` [N m] is what the motor gives at most.
    """
    return FilterSettings(
        eta=eta, epsilon={"corridor": epsilon}, action_low=(-torque,), action_high=(torque,), backup_action=(0.0,)
    )
