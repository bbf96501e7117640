"""What networks see of a state, and in which frame they tell its change.

A car that stands elsewhere moves alike: its networks see no position, and tell the change of position along and across
the heading. So they need not learn what geometry knows. The equations run on the entries of one state, Python floats,
on numpy arrays and on torch tensors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safedpa.errors import InputError
from safedpa.networks.plain_rows import turn_rows
from safedpa.operations import FLOATS, Operations, Scalar, operations_for
from safedpa.robot import robots

__all__ = ["Frame", "frame_of"]

Array = Any
"""A numpy array or a torch tensor; what comes out is of the kind that went in."""


@dataclass(frozen=True)
class Frame:
    """Features of a state, and changes of state in the robot's own frame."""

    feature_names: tuple[str, ...]
    _features: Callable[[Sequence[Scalar], Operations], list[Scalar]]
    _rotation: Callable[[Sequence[Scalar], Operations], tuple[Scalar, Scalar]] | None
    """Cosine and sine of the heading, for robots that have one."""
    _angle: int | None
    """Which entry of the state is an angle."""
    _turned: tuple[tuple[int, int], ...] = ((0, 1),)
    """Entries of the state that are vectors of the world, x and y each: the position, a velocity."""

    def features(self, state: Array) -> Array:
        """What the networks see of states (..., states): shape (..., features)."""
        return _stacked(self._features(_entries(state), operations_for(state)))

    def features_of_one(self, state: Sequence[float]) -> list[float]:
        """``features`` of the entries of one state, without arrays."""
        return self._features(state, FLOATS)

    def own_increment_of_one(self, state: Sequence[float], following: Sequence[float]) -> list[float]:
        """``own_increment`` of the entries of one state and the one that follows, without arrays."""
        return self._own(state, [after - before for before, after in zip(state, following, strict=True)], FLOATS)

    def turn_to_world(self, state: Sequence[float], rows: list[float], width: int) -> None:
        """``world_increment`` of one state in place, for ``width`` own-frame changes: entry by entry, all of them."""
        if self._rotation is None:
            return
        cosine, sine = self._rotation(state, FLOATS)
        for x, y in self._turned:
            turn_rows(rows, x * width, y * width, width, cosine, sine)

    def own_increment(self, state: Array, following: Array) -> Array:
        """The change from ``state`` to ``following`` (..., states) in the frame of ``state``; angles the short way."""
        change = [following[..., index] - state[..., index] for index in range(state.shape[-1])]
        return _stacked(self._own(_entries(state), change, operations_for(state)))

    def world_increment(self, state: Array, own: Array) -> Array:
        """An own-frame change (..., states) as a change of the state's entries: the inverse of ``own_increment``."""
        if self._rotation is None:
            return own
        cosine, sine = self._rotation(_entries(state), operations_for(state))
        change = _entries(own)
        for x, y in self._turned:
            change[x], change[y] = cosine * change[x] - sine * change[y], sine * change[x] + cosine * change[y]
        return _stacked(change)

    def _own(self, state: Sequence[Scalar], change: list[Scalar], operations: Operations) -> list[Scalar]:
        """The change of each entry of the state, turned into its frame; angles the short way."""
        if self._angle is not None:
            change[self._angle] = (change[self._angle] + np.pi) % (2.0 * np.pi) - np.pi
        if self._rotation is not None:
            cosine, sine = self._rotation(state, operations)
            for x, y in self._turned:
                change[x], change[y] = cosine * change[x] + sine * change[y], cosine * change[y] - sine * change[x]
        return change


def frame_of(robot: str) -> Frame:
    """The frame of a kind of robot. Raises InputError when learned models of it are not known."""
    known = robots()
    found = known[robot].frame() if robot in known else None
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
