"""What a replay gave, held field by field against what was recorded."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from math import isclose
from typing import Any

from safedpa.bus import Message

__all__ = ["TOLERANCE", "Difference", "differences"]

TOLERANCE = 1e-6
"""Of numbers x: |difference| <= 1e-6 max(1, |x|). On the machine and with the libraries of the recording nothing
differs at all. Other processors add in another order (numpy, BLAS and the QP solver choose their code by processor),
which moves a result by some 1e-12, and what the solver stops at by its own tolerance of 1e-9 or so."""

_LEFT_OUT = frozenset({"version", "publish_time", "microseconds", "step", "consumed", "skipped"})
"""When, how long, and from what: not what was decided."""
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class Difference:
    """One field of one message that did not come out as it was recorded."""

    epoch: int
    tick: int
    robot_time: float
    topic: str
    field: str
    recorded: Any
    replayed: Any
    exact_only: bool
    """Whether it is within the tolerance: another last digit."""


def differences(
    topic: str, recorded: Message, replayed: Message, reported: frozenset[str], tolerance: float = TOLERANCE
) -> Iterator[Difference]:
    """Every field in which two messages differ; ``reported`` are the fields that the recording has at all."""
    for item in fields(recorded):
        if item.name in _LEFT_OUT or item.name not in reported:
            continue
        one, other = getattr(recorded, item.name), getattr(replayed, item.name)
        if one == other:
            continue
        near = _near(one, other, tolerance)
        yield Difference(
            recorded.epoch, recorded.tick, recorded.robot_time, topic, item.name, one, other, exact_only=near
        )


def _near(one: Any, other: Any, tolerance: float) -> bool:
    """Whether two values are the same but for rounding; numbers within a sentence, too."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(_near(a, b, tolerance) for a, b in zip(one, other, strict=True))
    if isinstance(one, str) and isinstance(other, str):
        return _NUMBER.sub("#", one) == _NUMBER.sub("#", other) and _near(_numbers(one), _numbers(other), tolerance)
    if isinstance(one, float) and isinstance(other, float):
        return isclose(one, other, rel_tol=tolerance, abs_tol=tolerance)
    return bool(one == other)


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(found) for found in _NUMBER.findall(text))
