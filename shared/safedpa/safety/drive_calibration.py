"""Margins over drives from what was predicted and measured along each, and what margins cover on other drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.ceiling import NO_CEILING, Ceiling
from safedpa.safety.margin import margins_over_drives, smallest_sample

__all__ = ["calibration_from_drives", "covered_shares"]

Values = NDArray[np.float64]
Drives = Sequence[Mapping[str, Values]]
"""Of each drive by kind (steps, 4): the least h as it was predicted, and as it was measured; see ``drive_heights``."""

_NOTHING = np.zeros((0, 4))
_NEAR = 10
"""Drives at least in which something has to have come near: from none a margin of 0 would follow."""
_DOUBLINGS = 40


def calibration_from_drives(
    drives: Drives,
    coverage: float,
    date: str,
    model_fingerprint: str,
    ceiling: Ceiling = NO_CEILING,
    origin: str = "",
) -> MarginCalibration:
    """Margins for a step near a boundary, and for a whole drive.

    Errors count below the ``ceiling``, which is doubled where a margin is too wide for it, or too few drives came near.
    A drive in which nothing of a kind came near counts as one without an error. Raises InputError when there are too
    few drives, or no step in any.
    """
    if len(drives) < smallest_sample(coverage):
        raise InputError(
            f"drives: got {len(drives)}, wanted at least {smallest_sample(coverage)} for a coverage of {coverage}; "
            "drive more or ask for less"
        )
    tables: tuple[dict[str, float], dict[str, float]] = ({}, {})
    tops: dict[str, float] = {}
    for kind in dict.fromkeys(kind for heights in drives for kind in heights):
        along = [heights.get(kind, _NOTHING) for heights in drives]
        for which, name in enumerate(("ceiling", "drive.ceiling")):
            margin, used = _fitted(kind, along, coverage, ceiling, which)
            tables[which][kind], tops[f"{name}.{kind}"] = margin, used.of(kind, 0.0)
    steps = sum(max(map(len, heights.values()), default=0) for heights in drives)
    told = {name: value for name, value in tops.items() if isfinite(value)}
    made = MarginCalibration(tables[0], coverage, steps, date, model_fingerprint, constants=told, drive=tables[1])
    return replace(made, drives=len(drives), origin=origin)


def _fitted(kind: str, along: Sequence[Values], coverage: float, ceiling: Ceiling, which: int) -> tuple[float, Ceiling]:
    """The margin of a step (0) or a whole drive (1), and the ceiling below which its errors were counted."""

    for _ in range(_DOUBLINGS):
        if sum(len(ceiling.errors(kind, heights)) > 0 for heights in along) >= min(_NEAR, len(along)):
            break
        ceiling = ceiling.doubled(kind)

    def margin(chosen: Ceiling) -> float:
        errors = [chosen.errors(kind, heights) for heights in along]
        return max(0.0, margins_over_drives([near if len(near) else (0.0,) for near in errors], coverage)[which])

    return ceiling.fitting(kind, margin)


def covered_shares(drives: Drives, kind: str, epsilon: float, ceiling: Ceiling = NO_CEILING) -> Values:
    """(drives,) what share of a drive's steps near a boundary a margin covers; 1 where nothing came near."""
    errors = [ceiling.errors(kind, heights.get(kind, _NOTHING), epsilon) for heights in drives]
    return np.array([float((near <= epsilon).mean()) if len(near) else 1.0 for near in errors])
