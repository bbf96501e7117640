"""The barriers of the differential drive as C, compiled when a wheel or the environment is built."""

from __future__ import annotations

from collections.abc import Sequence

from safedpa.native.steps import rows_source
from safedpa.robots.differential_drive.barriers import Shape, wheeled_barriers
from safedpa.safety.barriers.equation import AbstractEquationBarrier, pattern_of, tape_of
from safedpa.safety.settings import FilterSettings

__all__ = ["sources"]

_STATES = 5
_SHAPE = Shape(0.1, 0.2, 0.1, 0.3)
_FIELD = (-1.0, 1.0, -1.0, 1.0)


def sources() -> list[str]:
    """Returns their C, with and without walls."""
    settings = FilterSettings.for_robot("differential_drive")
    fields: tuple[Sequence[float], ...] = ((), _FIELD)
    every = [wheeled_barriers(settings, _SHAPE, (), field) for field in fields]
    equations = [[part for part in parts if isinstance(part, AbstractEquationBarrier)] for parts in every]
    return [rows_source(tape_of(pattern_of(parts), _STATES))[0] for parts in equations]
