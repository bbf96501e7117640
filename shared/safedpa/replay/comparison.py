"""Compares a replayed message with the recorded one, field by field."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from math import isclose
from typing import Any

from safedpa.bus import Message

__all__ = ["TOLERANCE", "Difference", "differences"]

TOLERANCE = 1e-6
"""Numbers x agree if |difference| <= 1e-6 max(1, |x|).

On the machine and with the libraries of the recording, results are identical. On another processor numpy, BLAS and
the QP solver sum in another order: results differ by about 1e-12, and solutions by the solver's tolerance of 1e-9."""

_NOT_COMPARED = frozenset({"version", "publish_time", "microseconds", "step", "consumed", "skipped"})
"""Fields about time and inputs, which are not part of the decision."""
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class Difference:
    """A field of a message whose replayed value differs from the recorded one."""

    epoch: int
    tick: int
    robot_time: float
    topic: str
    field: str
    recorded: Any
    replayed: Any
    exact_only: bool
    """Whether the difference is within the tolerance."""


def differences(
    topic: str, recorded: Message, replayed: Message, recorded_fields: frozenset[str], tolerance: float = TOLERANCE
) -> Iterator[Difference]:
    """Yields every field in which two messages differ; ``recorded_fields`` are the fields that the recording has."""
    for item in fields(recorded):
        if item.name in _NOT_COMPARED or item.name not in recorded_fields:
            continue
        one, other = getattr(recorded, item.name), getattr(replayed, item.name)
        if one == other:
            continue
        near = _near(one, other, tolerance)
        yield Difference(
            recorded.epoch, recorded.tick, recorded.robot_time, topic, item.name, one, other, exact_only=near
        )


def _near(one: Any, other: Any, tolerance: float) -> bool:
    """Whether two values agree within the tolerance; also compares numbers inside sentences."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(_near(a, b, tolerance) for a, b in zip(one, other, strict=True))
    if isinstance(one, str) and isinstance(other, str):
        return _NUMBER.sub("#", one) == _NUMBER.sub("#", other) and _near(_numbers(one), _numbers(other), tolerance)
    if isinstance(one, float) and isinstance(other, float):
        return isclose(one, other, rel_tol=tolerance, abs_tol=tolerance)
    return bool(one == other)


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(found) for found in _NUMBER.findall(text))
