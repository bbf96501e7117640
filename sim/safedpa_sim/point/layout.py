"""Random layouts: positions of robot, goal and hazards, uniform in the field with a minimum distance, in batches.

Source: level 1 of the benchmark's goal task (Safety Gymnasium, NeurIPS 2023): 8 hazards of radius 0.2 m and a goal of
radius 0.3 m in a field of 3 m x 3 m. Each object has a keep-out radius, and any two are at least the sum of theirs
apart. The vase of that level, which has no cost, is omitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray

HAZARDS: Final = 8
HAZARD_RADIUS: Final = 0.2
GOAL_RADIUS: Final = 0.3
FIELD: Final = 1.5
"""m; the field extends from -1.5 to 1.5 in x and y."""

_KEEP_ROBOT, _KEEP_GOAL, _KEEP_HAZARD = 0.4, 0.305, 0.18
_TRIES = 100


@dataclass
class Layout:
    """Positions [m] in ``count`` worlds."""

    robot: FloatArray
    """(count, 2)."""
    goal: FloatArray
    """(count, 2)."""
    hazards: FloatArray
    """(count, 8, 2)."""


def draw_layouts(count: int, random: np.random.Generator) -> Layout:
    """Draws ``count`` independent layouts."""
    layout = Layout(np.zeros((count, 2)), np.zeros((count, 2)), np.zeros((count, HAZARDS, 2)))
    left = np.arange(count)
    while len(left):
        positions, found = _draw(len(left), random)
        done = left[found]
        layout.robot[done], layout.goal[done], layout.hazards[done] = (
            positions[found, 0],
            positions[found, 1],
            positions[found, 2:],
        )
        left = left[~found]
    return layout


def draw_goals(robot: FloatArray, hazards: FloatArray, random: np.random.Generator) -> FloatArray:
    """Draws new goals (count, 2), away from hazards and from the robots' current positions."""
    others = np.concatenate((robot[:, None], hazards), axis=1)
    keep = np.array([_KEEP_ROBOT] + [_KEEP_HAZARD] * hazards.shape[1])
    goals = np.zeros_like(robot)
    left = np.arange(len(robot))
    while len(left):
        position = _somewhere(len(left), _KEEP_GOAL, random)
        found = _is_free(position, _KEEP_GOAL, others[left], keep)
        goals[left[found]] = position[found]
        left = left[~found]
    return goals


def _draw(count: int, random: np.random.Generator) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Draws positions (count, 2 + hazards, 2) one object after the other; also returns which layouts are complete."""
    keep = np.array([_KEEP_ROBOT, _KEEP_GOAL] + [_KEEP_HAZARD] * HAZARDS)
    positions = np.zeros((count, len(keep), 2))
    complete = np.ones(count, bool)
    for index, radius in enumerate(keep):
        left = np.arange(count)
        for _ in range(_TRIES):
            position = _somewhere(len(left), radius, random)
            found = _is_free(position, radius, positions[left, :index], keep[:index])
            positions[left[found], index] = position[found]
            left = left[~found]
            if not len(left):
                break
        complete[left] = False
    return positions, complete


def _somewhere(count: int, keep: float, random: np.random.Generator) -> FloatArray:
    return random.uniform(-FIELD + keep, FIELD - keep, (count, 2))


def _is_free(position: FloatArray, keep: float, others: FloatArray, others_keep: FloatArray) -> NDArray[np.bool_]:
    apart = np.linalg.norm(position[:, None] - others, axis=2)
    free: NDArray[np.bool_] = np.all(apart >= keep + others_keep, axis=1)
    return free
