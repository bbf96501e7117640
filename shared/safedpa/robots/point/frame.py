"""What the networks of a point robot see of its state."""

from __future__ import annotations

from collections.abc import Sequence

from safedpa.networks.frame import Frame
from safedpa.operations import Operations, Scalar

__all__ = ["FRAME"]


def _rotation(state: Sequence[Scalar], operations: Operations) -> tuple[Scalar, Scalar]:
    return operations.cos(state[2]), operations.sin(state[2])


def _features(state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
    cosine, sine = _rotation(state, operations)
    x, y = state[3], state[4]
    return [cosine, sine, cosine * x + sine * y, cosine * y - sine * x]


FRAME = Frame(("cos(yaw)", "sin(yaw)", "speed along", "speed across"), _features, _rotation, 2, ((0, 1), (3, 4)))
