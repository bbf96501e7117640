"""What networks see of a state, and in which frame they tell its change.

A car that stands elsewhere moves alike: its networks see no position, and tell the change of position along and across
the heading. So they need not learn what geometry knows. The equations run on numpy arrays and on torch tensors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from safedpa.errors import InputError
from safedpa.operations import NUMPY, Operations, operations_for

__all__ = ["Frame", "frame_of"]

Array = Any
"""A numpy array or a torch tensor; what comes out is of the kind that went in."""


@dataclass(frozen=True)
class Frame:
    """Features of a state, and changes of state in the robot's own frame."""

    feature_names: tuple[str, ...]
    _features: Callable[[Array, Operations], list[Array]]
    _rotation: Callable[[Array, Operations], tuple[Array, Array]] | None
    """Cosine and sine of the heading, for robots that have one; their first two entries are the position."""
    _angle: int | None
    """Which entry of the state is an angle."""

    def features(self, state: Array) -> Array:
        """What the networks see of states (..., states): shape (..., features)."""
        return _stacked(self._features(state, operations_for(state)))

    def features_of_one(self, state: Array) -> Array:
        """``features`` of one state (states,), a numpy array, without what only batches need."""
        return np.array(self._features(state, NUMPY))

    def world_matrix(self, state: Array) -> Array:
        """R (states, states) of one state (states,): ``world_increment`` as a matrix."""
        matrix = np.eye(len(state))
        if self._rotation is not None:
            cosine, sine = self._rotation(state, NUMPY)
            matrix[0, 0] = matrix[1, 1] = cosine
            matrix[0, 1], matrix[1, 0] = -sine, sine
        return matrix

    def own_increment(self, state: Array, following: Array) -> Array:
        """The change from ``state`` to ``following`` (..., states) in the frame of ``state``; angles the short way."""
        change = [following[..., index] - state[..., index] for index in range(state.shape[-1])]
        if self._angle is not None:
            turn = change[self._angle]
            change[self._angle] = (turn + np.pi) % (2.0 * np.pi) - np.pi
        if self._rotation is not None:
            cosine, sine = self._rotation(state, operations_for(state))
            change[:2] = cosine * change[0] + sine * change[1], cosine * change[1] - sine * change[0]
        return _stacked(change)

    def world_increment(self, state: Array, own: Array) -> Array:
        """An own-frame change (..., states) as a change of the state's entries: the inverse of ``own_increment``."""
        if self._rotation is None:
            return own
        cosine, sine = self._rotation(state, operations_for(state))
        along, across = own[..., 0], own[..., 1]
        turned = [cosine * along - sine * across, sine * along + cosine * across]
        return _stacked([*turned, *(own[..., index] for index in range(2, own.shape[-1]))])


def frame_of(robot: str) -> Frame:
    """The frame of a kind of robot. Raises InputError when learned models of it are not known."""
    if robot not in _FRAMES:
        raise InputError(f"robot: got '{robot}', wanted one with learned models: {', '.join(_FRAMES)}")
    return _FRAMES[robot]


def _stacked(entries: list[Array]) -> Array:
    if all(isinstance(entry, (np.ndarray, np.generic)) for entry in entries):
        return np.stack(np.broadcast_arrays(*entries), axis=-1)
    import torch

    return torch.stack(torch.broadcast_tensors(*entries), dim=-1)  # type: ignore[no-untyped-call]


def _car_features(state: Array, operations: Operations) -> list[Array]:
    yaw = state[..., 2]
    return [operations.cos(yaw), operations.sin(yaw), state[..., 3]]


def _car_rotation(state: Array, operations: Operations) -> tuple[Array, Array]:
    yaw = state[..., 2]
    return operations.cos(yaw), operations.sin(yaw)


def _pendulum_features(state: Array, operations: Operations) -> list[Array]:
    angle = state[..., 0]
    return [operations.cos(angle), operations.sin(angle), state[..., 1]]


_FRAMES = {
    "car": Frame(("cos(yaw)", "sin(yaw)", "speed"), _car_features, _car_rotation, 2),
    "pendulum": Frame(("cos(angle)", "sin(angle)", "rate"), _pendulum_features, None, 0),
}
