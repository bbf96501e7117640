"""The car's conditions on a grid of actions: its own h, the model's own prediction, and nothing of the filter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.safety import FilterSettings

FOOTPRINT: Final = (0.08, 0.40, 0.12)
"""m; the segment's rear and front end and its radius."""
FIELD: Final = (-4.0, 4.0, -4.0, 4.0)
_GRID: Final = (27, 35)
"""Target speeds and steering angles."""


@final
@dataclass(frozen=True, eq=False)
class CarQuestion:
    """State (4,), nominal action (2,) and obstacles (m, 3)."""

    state: FloatArray
    nominal: FloatArray
    obstacles: FloatArray


@final
class CarJudge:
    """The conditions at one state, for any number of actions at once."""

    def __init__(self, model: PhysicsModel, settings: FilterSettings, question: CarQuestion) -> None:
        self._model, self._settings, self._question = model, settings, question
        self.now = self._h(question.state[None])[0]
        kinds = ["obstacle"] * len(question.obstacles) + ["field"] * 8 + ["speed"] * 2
        default = settings.epsilon.get("default", 0.0)
        margin = np.array([settings.epsilon.get(kind, default) for kind in kinds])
        self.required = (1.0 - settings.eta) * self.now + margin
        self.low, self.high = np.array(settings.action_low), np.array(settings.action_high)
        self.grid = np.stack(
            np.meshgrid(*(np.linspace(*ends) for ends in zip(self.low, self.high, _GRID, strict=True))), axis=-1
        ).reshape(-1, 2)
        self._least = np.maximum(np.abs(self.now), margin)

    @cached_property
    def h(self) -> FloatArray:
        """(grid, rows) predicted h."""
        return self.heights(self.grid)

    @cached_property
    def scale(self) -> FloatArray:
        """(rows,) of h now, of its margin, and of what the actions can change in it, the largest."""
        return np.asarray(np.maximum(self._least, self.h.max(axis=0) - self.h.min(axis=0)))

    def heights(self, actions: FloatArray) -> FloatArray:
        """(n, rows) predicted h for actions (n, 2)."""
        states = np.repeat(self._question.state[None], len(actions), axis=0)
        return self._h(np.asarray(self._model.step(states, actions, self._model.latent)))

    def distance(self, actions: FloatArray) -> FloatArray:
        """(n,) sqrt(sum weight_j ((a_j - nominal_j) / range_j)^2)."""
        weights = np.array(self._settings.weights or (1.0, 1.0))
        share = (actions - self._question.nominal) / (self.high - self.low)
        return np.asarray(np.sqrt((weights * share**2).sum(axis=1)))

    def _h(self, states: FloatArray) -> FloatArray:
        """h (n, rows): obstacles, walls at the front and at the rear end, and the two limits of speed."""
        x, y, yaw, v = (states[:, column, None] for column in range(4))
        c, s = np.cos(yaw), np.sin(yaw)
        front, rear = self._ends(v)
        obstacles = self._question.obstacles
        ahead = (obstacles[:, 0] - x) * c + (obstacles[:, 1] - y) * s
        aside = (obstacles[:, 1] - y) * c - (obstacles[:, 0] - x) * s
        beyond = ahead - np.minimum(np.maximum(ahead, rear), front)
        room = FOOTPRINT[2] + self._settings.barrier("clearance")
        parts = [np.sqrt(beyond**2 + aside**2) - obstacles[:, 2] - room]
        for end in (front, rear):
            across, along = x + end * c, y + end * s
            parts += [across - FIELD[0] - room, FIELD[1] - room - across]
            parts += [along - FIELD[2] - room, FIELD[3] - room - along]
        parts += [v - self._settings.barrier("speed_low"), self._settings.barrier("speed_high") - v]
        return np.concatenate(parts, axis=1)

    def _ends(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the swept segment ends, before and behind: D(v) as the page on safety has it."""
        b, k = self._settings.barrier("braking_deceleration"), self._settings.barrier("braking_gain")
        size = np.abs(v)
        stop = np.sign(v) * np.where(size <= b / k, size / k, b / k**2 + (size**2 - (b / k) ** 2) / (2.0 * b))
        return FOOTPRINT[1] + np.maximum(stop, 0.0), -FOOTPRINT[0] + np.minimum(stop, 0.0)
