"""The goal seeker of the point robot for many at once: towards the goal in a known wind, around the hazards on the way.

    wanted = (speed along the way - velocity) / time - (wind - drag velocity)         acceleration
    thrust = clip(wanted . heading / strongest),  turn = clip(gain angle from heading to wanted / fastest)

The same as ``safedpa.robots.point.point_seeker`` for one; what keeps it out of hazards is the filter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.stopping_barrier import Motion
from safedpa_sim.point.layout import HAZARD_RADIUS

__all__ = ["sought", "steered"]

Floats = NDArray[np.float64]

_CRUISE, _SLOWEST, _APPROACH = 0.9, 0.4, 3.0
"""m/s; m/s at the goal, and 1/s, the speed gained over the distance to it."""
_SECONDS = 0.2
"""s in which the velocity shall be the wanted one."""
_GAIN = 8.0
"""1/s of the turning."""
_BERTH, _LOOK = 0.15, 1.0
"""m to pass a hazard by; m ahead that hazards are heeded."""


def sought(state: Floats, goal: Floats, hazards: Floats, motion: Motion) -> Floats:
    """Actions (robots, 2) in [-1, 1] of the strongest thrust and the fastest turn, for states (robots, 5)."""
    apart = goal - state[:, :2]
    distance = np.linalg.norm(apart, axis=1)
    way = _around(state, np.arctan2(apart[:, 1], apart[:, 0]), distance, hazards)
    return steered(state, way, np.minimum(_CRUISE, _APPROACH * distance + _SLOWEST), motion)


def steered(state: Floats, way: Floats, speed: Floats, motion: Motion) -> Floats:
    """Actions (robots, 2) that bring states (robots, 5) to ``speed`` (robots,) [m/s] along ``way`` (robots,) [rad]."""
    yaw, vx, vy = state.T[2:]
    wanted_x = (speed * np.cos(way) - vx) / _SECONDS - motion.wind[0] + motion.drag * vx
    wanted_y = (speed * np.sin(way) - vy) / _SECONDS - motion.wind[1] + motion.drag * vy
    along = wanted_x * np.cos(yaw) + wanted_y * np.sin(yaw)
    across = wanted_y * np.cos(yaw) - wanted_x * np.sin(yaw)
    end = np.where(along < 0.0, -1.0, 1.0)
    turn = _GAIN * np.arctan2(end * across, end * along) / motion.fastest
    action: Floats = np.clip(np.stack((along / motion.strongest, turn), axis=1), -1.0, 1.0)
    return action


def _around(state: Floats, way: Floats, distance: Floats, hazards: Floats) -> Floats:
    """The ways, each turned past the hazard that is in it nearest."""
    to = hazards - state[:, np.newaxis, :2]
    far = np.linalg.norm(to, axis=2)
    reach = HAZARD_RADIUS + _BERTH
    off = _wrapped(np.arctan2(to[..., 1], to[..., 0]) - way[:, np.newaxis])
    half = np.where(far > reach, np.arcsin(np.minimum(reach / np.maximum(far, 1e-6), 1.0)), 0.5 * np.pi)
    near = far - reach
    blocks = (np.abs(off) < half) & (near < np.minimum(_LOOK, distance)[:, np.newaxis])
    which = np.where(blocks, near, np.inf).argmin(axis=1)
    index = np.arange(len(state))
    passed = way + off[index, which] - np.where(off[index, which] >= 0.0, 1.0, -1.0) * half[index, which]
    turned: Floats = np.where(blocks.any(axis=1), passed, way)
    return turned


def _wrapped(angle: Floats) -> Floats:
    wrapped: Floats = (angle + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped
