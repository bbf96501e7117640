"""The safety filter for many point robots at once: the same conditions and the same answer as ``SafetyFilter``.

    min |(a - wish) / range|^2   subject to   h_i(f + g a) >= (1 - eta) h_i(x) + epsilon,  a within its bounds

with h_i's tangent over the action at the predicted next state, posed anew once at the solution. Two entries of the
action leave few corners, so all of them are tried. Where none will do, or the conditions do not hold at the prediction
for the solution, the stopping manoeuvre's own action is taken: it keeps every h_i from falling. Where that is not
enough, since h_i(x) < epsilon / eta asks for more room than there is, the action that leaves most room is taken:
recovery. So a robot whose wind is believed wrong, and that drifts while it believes that it stands, pushes itself away.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.stopping_barrier import ENDS, Motion, stopping_action, stopping_path, stopping_room

__all__ = ["ETA", "Around", "Believed", "Filtered", "best_end", "filtered", "nearest_in_polygon"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

ETA: Final = 0.5
_NUDGE = 0.02
"""Of the action's range, for the tangent."""
_GRID: Final = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 5), np.linspace(-1.0, 1.0, 5)), axis=-1).reshape(-1, 2)
"""Actions that are tried in recovery, beside the manoeuvre's."""
_TOLERANCE = 1e-4
"""m by which a condition may be missed."""


@final
@dataclass(frozen=True)
class Believed:
    """What a model says at the present states: x[t+1] = drift + gain a, and how the manoeuvre would go."""

    drift: Floats
    """(robots, 5)."""
    gain: Floats
    """(robots, 5, 2) over actions in [-1, 1]."""
    motion: Motion
    scale: Floats
    """(2,) thrust acceleration [m/s2] and turn [rad/s] of the action 1."""

    def next_state(self, action: Floats) -> Floats:
        """(robots, 5) after actions (robots, 2)."""
        following: Floats = self.drift + np.einsum("rsa,ra->rs", self.gain, action)
        return following

    def of(self, which: NDArray[np.intp]) -> Believed:
        """The same for the robots of those indices."""
        motion = self.motion
        wind = np.asarray(motion.wind, dtype=np.float64)
        some = Motion(
            wind[:, which] if wind.ndim > 1 else wind,
            _some(motion.drag, which),
            _some(motion.strongest, which),
            motion.fastest,
            motion.ahead,
        )
        return Believed(self.drift[which], self.gain[which], some, self.scale)


@final
@dataclass(frozen=True)
class Filtered:
    """Actions (robots, 2) in [-1, 1], where they are not the wish, and where they are the manoeuvre's."""

    action: Floats
    corrected: Flags
    stopping: Flags


def filtered(
    state: Floats, wish: Floats, hazards: Floats, radius: float, believed: Believed, epsilon: float = 0.0
) -> Filtered:
    """Safe actions for states (robots, 5) and wishes (robots, 2) among hazards (robots, m, 2)."""
    wish = np.clip(wish, -1.0, 1.0)
    radii = np.full(hazards.shape[1], radius)
    present, end = best_end(state, hazards, radii, believed.motion)
    needed = (1.0 - ETA) * present + epsilon
    reached, _ = best_end(believed.next_state(wish), hazards, radii, believed.motion)
    action = wish.copy()
    wrong = np.flatnonzero(np.any(reached < needed - _TOLERANCE, axis=1))
    stopping = np.zeros(len(wish), bool)
    if len(wrong):
        without_room = present[wrong].min(axis=1) < epsilon / ETA
        around = Around(hazards[wrong], radii, believed.of(wrong), end[wrong], without_room)
        action[wrong], stopping[wrong] = _corrected(state[wrong], wish[wrong], around, needed[wrong])
    corrected = np.zeros(len(wish), bool)
    corrected[wrong] = True
    return Filtered(action, corrected, stopping)


def best_end(state: Floats, hazards: Floats, radii: Floats, motion: Motion) -> tuple[Floats, Floats]:
    """h (robots, m) of states (robots, 5) with the end first that leaves more room, and that end (robots,)."""
    count = len(state)
    twice = np.concatenate((state, state))
    both = _rooms(twice, np.concatenate((hazards, hazards)), radii, _doubled(motion), np.repeat(ENDS, count))
    first, second = both[:count], both[count:]
    better = first.min(axis=1) >= second.min(axis=1)
    return np.where(better[:, np.newaxis], first, second), np.where(better, *ENDS)


@final
@dataclass(frozen=True)
class Around:
    """What surrounds robots whose wish is not safe."""

    hazards: Floats
    radii: Floats
    believed: Believed
    end: Floats
    without_room: Flags
    """(robots,): where h < epsilon / eta for some hazard, so that room has to be gained."""

    def rooms(self, action: Floats) -> Floats:
        """h (robots, m) at the predictions for actions (robots, 2)."""
        return _rooms(self.believed.next_state(action), self.hazards, self.radii, self.believed.motion, self.end)


def _corrected(state: Floats, wish: Floats, around: Around, needed: Floats) -> tuple[Floats, Flags]:
    place, good = wish, np.zeros(len(wish), bool)
    action = wish.copy()
    for _ in range(2):
        value, slope = _tangent(place, around)
        offset = value - np.einsum("rma,ra->rm", slope, place)
        found, exists = nearest_in_polygon(wish, slope, needed - offset)
        holds = exists & np.all(around.rooms(found) >= needed - _TOLERANCE, axis=1)
        action[holds & ~good] = found[holds & ~good]
        good |= holds
        place = found
    thrust, turn = stopping_action(state.T, around.believed.motion, around.end)
    manoeuvre = np.clip(np.stack((thrust, turn), axis=1) / around.believed.scale, -1.0, 1.0)
    action[~good] = manoeuvre[~good]
    lost = np.flatnonzero(~good & around.without_room)
    if len(lost):
        action[lost] = _roomiest(np.concatenate((manoeuvre[lost, np.newaxis], _tried(len(lost))), axis=1), around, lost)
    return action, ~good


def _tried(count: int) -> Floats:
    return np.broadcast_to(_GRID, (count, *_GRID.shape))


def _roomiest(tried: Floats, around: Around, which: NDArray[np.intp]) -> Floats:
    """Of the actions (robots, actions, 2) for the robots ``which``, the one with the largest least h; first of equals.

    Rounded to a tenth of a millimetre, so that among actions that do alike the manoeuvre's, the first, is taken.
    """
    count = tried.shape[1]
    every = np.repeat(which, count)
    rooms, _ = best_end(
        around.believed.of(every).next_state(tried.reshape(-1, 2)),
        around.hazards[every],
        around.radii,
        around.believed.of(every).motion,
    )
    least = np.round(rooms.min(axis=1).reshape(-1, count), 4)
    best: Floats = tried[np.arange(len(which)), least.argmax(axis=1)]
    return best


def _tangent(action: Floats, around: Around) -> tuple[Floats, Floats]:
    """h (robots, m) at the prediction for ``action``, and its slope over the action (robots, m, 2)."""
    value = around.rooms(action)
    slope = np.empty((*value.shape, 2))
    for index in range(2):
        inwards = np.where(action[:, index] > 0.0, -_NUDGE, _NUDGE)
        moved = action.copy()
        moved[:, index] += inwards
        slope[..., index] = (around.rooms(moved) - value) / inwards[:, np.newaxis]
    return value, slope


def nearest_in_polygon(wish: Floats, slope: Floats, needed: Floats) -> tuple[Floats, Flags]:
    """The point of [-1, 1]^2 with slope a >= needed nearest to ``wish`` (robots, 2), and where there is any.

    The nearest point is the wish, its foot on one edge, or a corner of two: all are tried.
    """
    robots = len(wish)
    box = np.broadcast_to(np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]), (robots, 4, 2))
    rows = np.concatenate((slope, box), axis=1)
    least = np.concatenate((needed, np.full((robots, 4), -1.0)), axis=1)
    size = np.einsum("rma,rma->rm", rows, rows)
    missing = (least - np.einsum("rma,ra->rm", rows, wish)) / np.maximum(size, 1e-12)
    feet = wish[:, np.newaxis] + missing[..., np.newaxis] * rows
    first, second = np.array(list(combinations(range(rows.shape[1]), 2))).T
    a, b = rows[:, first], rows[:, second]
    determinant = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    safe = np.where(np.abs(determinant) < 1e-9, np.inf, determinant)
    p, q = least[:, first], least[:, second]
    corners = np.stack(((p * b[..., 1] - q * a[..., 1]) / safe, (q * a[..., 0] - p * b[..., 0]) / safe), axis=-1)
    points = np.concatenate((wish[:, np.newaxis], feet, corners), axis=1)
    inside = np.all(np.einsum("rma,rpa->rpm", rows, points) >= least[:, np.newaxis] - 1e-7, axis=2)
    inside[:, 1 + rows.shape[1] :] &= np.abs(determinant) >= 1e-9
    cost = np.where(inside, np.sum((points - wish[:, np.newaxis]) ** 2, axis=2), np.inf)
    best = np.argmin(cost, axis=1)
    found: Floats = np.clip(points[np.arange(robots), best], -1.0, 1.0)
    return found, np.isfinite(cost[np.arange(robots), best])


def _rooms(state: Floats, hazards: Floats, radii: Floats, motion: Motion, end: Floats) -> Floats:
    """In single precision within, which is exact to a micrometre."""
    single = Motion(
        np.asarray(motion.wind, np.float32),
        np.asarray(motion.drag, np.float32),
        np.asarray(motion.strongest, np.float32),
        motion.fastest,
        motion.ahead,
    )
    path = stopping_path(state.T.astype(np.float32), single, end.astype(np.float32))
    return stopping_room(path, hazards, radii).astype(np.float64)


def _doubled(motion: Motion) -> Motion:
    """The motion of the same robots twice."""
    wind, drag, strongest = (np.asarray(part) for part in (motion.wind, motion.drag, motion.strongest))
    return Motion(
        np.concatenate((wind, wind), axis=1) if wind.ndim > 1 else wind,
        np.concatenate((drag, drag)) if drag.ndim else drag,
        np.concatenate((strongest, strongest)) if strongest.ndim else strongest,
        motion.fastest,
        motion.ahead,
    )


def _some(part: object, which: NDArray[np.intp]) -> Floats:
    """The robots' own entries; a number that holds for all stays as it is."""
    array = np.asarray(part, dtype=np.float64)
    return array[which] if array.ndim else array
