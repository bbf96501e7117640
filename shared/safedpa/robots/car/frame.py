"""What the networks of a car see of its state."""

from __future__ import annotations

from collections.abc import Sequence

from safedpa.networks.frame import Frame
from safedpa.operations import Operations, Scalar

__all__ = ["FRAME"]


def _features(state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
    return [operations.cos(state[2]), operations.sin(state[2]), state[3]]


def _rotation(state: Sequence[Scalar], operations: Operations) -> tuple[Scalar, Scalar]:
    return operations.cos(state[2]), operations.sin(state[2])


FRAME = Frame(("cos(yaw)", "sin(yaw)", "speed"), _features, _rotation, 2)
