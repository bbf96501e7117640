"""What the networks of a pendulum see of its state."""

from __future__ import annotations

from collections.abc import Sequence

from safedpa.networks.frame import Frame
from safedpa.operations import Operations, Scalar

__all__ = ["FRAME"]


def _features(state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
    return [operations.cos(state[0]), operations.sin(state[0]), state[1]]


FRAME = Frame(("cos(angle)", "sin(angle)", "rate"), _features, None, 0)
