"""The inputs of the networks (features of a state), and the frame in which they predict its change.

Motion does not depend on position and heading, so the networks get no position, and predict changes along and across
the heading: they need not learn geometry. The equations work on Python floats (the entries of one state), NumPy arrays
and torch tensors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safedpa.errors import InputError
from safedpa.networks.plain_rows import turn_rows
from safedpa.operations import FLOATS, Operations, Scalar, operations_for
from safedpa.systems.robots import robots

__all__ = ["Frame", "frame_of"]

Array = Any
"""A NumPy array or a torch tensor; results have the kind of the arguments."""


@dataclass(frozen=True)
class Frame:
    """Features of a state, and changes of state in the robot's own frame."""

    feature_names: tuple[str, ...]
    _features: Callable[[Sequence[Scalar], Operations], list[Scalar]]
    _rotation: Callable[[Sequence[Scalar], Operations], tuple[Scalar, Scalar]] | None
    """Cosine and sine of the heading; None for a robot without one."""
    _angle: int | None
    """Index of the state's angle; None: no entry is one."""
    _turned: tuple[tuple[int, int], ...] = ((0, 1),)
    """Index pairs (x, y) of the state's vectors in the world frame: the position, a velocity."""

    def features(self, state: Array) -> Array:
        """Returns the features (..., features) of states (..., states)."""
        return _stacked(self._features(_entries(state), operations_for(state)))

    def features_of_one(self, state: Sequence[float]) -> list[float]:
        """Returns ``features`` for the entries of one state, without arrays."""
        return self._features(state, FLOATS)

    def seen_and_heading(self, state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
        """Returns the features, then cosine and sine of the heading: 1 and 0 for a robot without one."""
        heading = (1.0, 0.0) if self._rotation is None else self._rotation(state, operations)
        return [*self._features(state, operations), *heading]

    @property
    def turned(self) -> tuple[tuple[int, int], ...]:
        """Index pairs (x, y) of the state's vectors that turn with the heading."""
        return () if self._rotation is None else self._turned

    @property
    def functions(self) -> tuple[Callable[..., Any], ...]:
        """The robot's own functions: of the features, and of the heading if it has one."""
        return (self._features,) if self._rotation is None else (self._features, self._rotation)

    def own_increment_of_one(self, state: Sequence[float], following: Sequence[float]) -> list[float]:
        """Returns ``own_increment`` for the entries of one state and the next, without arrays."""
        return self._own(state, [after - before for before, after in zip(state, following, strict=True)], FLOATS)

    def turn_to_world(self, state: Sequence[float], rows: list[float], width: int) -> None:
        """Applies ``world_increment`` in place to ``width`` own-frame changes of one state, stored entry by entry."""
        if self._rotation is None:
            return
        cosine, sine = self._rotation(state, FLOATS)
        for x, y in self._turned:
            turn_rows(rows, x * width, y * width, width, cosine, sine)

    def own_increment(self, state: Array, following: Array) -> Array:
        """Returns the change from ``state`` to ``following`` (..., states) in the frame of ``state``.

        Differences of angles are wrapped to [-pi, pi).
        """
        change = [following[..., index] - state[..., index] for index in range(state.shape[-1])]
        return _stacked(self._own(_entries(state), change, operations_for(state)))

    def world_increment(self, state: Array, own: Array) -> Array:
        """Returns an own-frame change (..., states) as a change of the state: the inverse of ``own_increment``."""
        if self._rotation is None:
            return own
        cosine, sine = self._rotation(_entries(state), operations_for(state))
        change = _entries(own)
        for x, y in self._turned:
            change[x], change[y] = cosine * change[x] - sine * change[y], sine * change[x] + cosine * change[y]
        return _stacked(change)

    def _own(self, state: Sequence[Scalar], change: list[Scalar], operations: Operations) -> list[Scalar]:
        """Returns the change of each entry in the frame of the state, with angles wrapped."""
        if self._angle is not None:
            change[self._angle] = (change[self._angle] + np.pi) % (2.0 * np.pi) - np.pi
        if self._rotation is not None:
            cosine, sine = self._rotation(state, operations)
            for x, y in self._turned:
                change[x], change[y] = cosine * change[x] + sine * change[y], cosine * change[y] - sine * change[x]
        return change


def frame_of(robot: str) -> Frame:
    """Returns the frame of a robot. Raises InputError if the robot has no learned models."""
    known = robots()
    found: Frame | None = known[robot].frame() if robot in known else None
    if found is None:
        taught = [name for name, one in known.items() if one.frame() is not None]
        raise InputError(f"robot: got '{robot}', wanted one with learned models: {', '.join(taught)}")
    return found


def _stacked(entries: list[Array]) -> Array:
    if all(isinstance(entry, (np.ndarray, np.generic)) for entry in entries):
        return np.stack(np.broadcast_arrays(*entries), axis=-1)
    import torch

    return torch.stack(torch.broadcast_tensors(*entries), dim=-1)  # type: ignore[no-untyped-call]


def _entries(state: Array) -> list[Array]:
    return [state[..., index] for index in range(state.shape[-1])]
