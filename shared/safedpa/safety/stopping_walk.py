"""The stopping manoeuvre of one robot in plain numbers: a tenth of the time that arrays of one entry take."""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.stopping_barrier import FAINT, GAIN, STEP_SECONDS, STEPS, STOP_SECONDS, Motion

__all__ = ["least_rooms"]

Floats = NDArray[np.float64]


def least_rooms(state: Floats, motion: Motion, end: float, hazards: Floats, radii: Floats) -> Floats:
    """h (hazards,) [m] along the manoeuvre from ``state`` (5,) among hazards (hazards, 2): ``stopping_path`` of one."""
    path = np.array(_places([float(entry) for entry in state], motion, end))
    apart = hazards[:, np.newaxis] - path
    room: Floats = np.sqrt(np.einsum("hpk,hpk->hp", apart, apart).min(axis=1)) - radii
    return room


def _places(state: list[float], motion: Motion, end: float) -> list[tuple[float, float]]:
    """The middle's places along the manoeuvre, from now on; the same arithmetic as ``stopping_path``."""
    x, y, yaw, vx, vy = state
    wind_x, wind_y = float(motion.wind[0]), float(motion.wind[1])
    drag, strongest, fastest, behind = float(motion.drag), float(motion.strongest), motion.fastest, motion.ahead
    places = [(x - behind * cos(yaw), y - behind * sin(yaw))]
    for _ in range(STEPS):
        ahead, aside = cos(yaw), sin(yaw)
        wanted_x = -vx / STOP_SECONDS - wind_x + drag * vx
        wanted_y = -vy / STOP_SECONDS - wind_y + drag * vy
        along = wanted_x * ahead + wanted_y * aside
        across = wanted_y * ahead - wanted_x * aside
        size = sqrt(along * along + across * across)
        error = atan2(end * across, end * along) * size / (size + FAINT)
        thrust = min(max(along, -strongest), strongest)
        turn = min(max(GAIN * error, -fastest), fastest)
        middle = yaw + 0.5 * STEP_SECONDS * turn
        yaw += STEP_SECONDS * turn
        push_x = thrust * cos(middle) + wind_x - drag * vx
        push_y = thrust * sin(middle) + wind_y - drag * vy
        x += STEP_SECONDS * (vx + 0.5 * STEP_SECONDS * push_x)
        y += STEP_SECONDS * (vy + 0.5 * STEP_SECONDS * push_y)
        vx += STEP_SECONDS * push_x
        vy += STEP_SECONDS * push_y
        places.append((x - behind * cos(yaw), y - behind * sin(yaw)) if behind else (x, y))
    return places
