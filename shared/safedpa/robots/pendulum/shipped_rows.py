"""The barrier of the pendulum's corridor as C, compiled when a wheel or the environment is built."""

from __future__ import annotations

from safedpa.native.steps import rows_source
from safedpa.safety.barriers.equation import pattern_of, tape_of
from safedpa.safety.barriers.limits import CorridorBarrier

__all__ = ["sources"]

_STATES = 2


def sources() -> list[str]:
    """Returns its C."""
    return [rows_source(tape_of(pattern_of((CorridorBarrier(-1.0, 1.0, 1.0),)), _STATES))[0]]
