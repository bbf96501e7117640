"""The differential drive as plain shapes."""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, sin

from safedpa.bus import StateMessage
from safedpa.drawing import Lines, Rings, Shape
from safedpa.robots.differential_drive.system import TRACK

__all__ = ["drawn"]

_WHEEL = 0.05
"""m; half of what is drawn of a wheel."""


def drawn(state: StateMessage, radius: float) -> Mapping[str, Shape]:
    """A disc with its two wheels and a nose."""
    x, y, yaw = state.values[:3]
    ahead, aside = (cos(yaw), sin(yaw)), (-sin(yaw), cos(yaw))

    def place(forward: float, left: float) -> tuple[float, float]:
        return x + forward * ahead[0] + left * aside[0], y + forward * ahead[1] + left * aside[1]

    wheels = [(place(-_WHEEL, side * TRACK / 2), place(_WHEEL, side * TRACK / 2)) for side in (-1.0, 1.0)]
    return {
        "body": Rings(((x, y),), (radius,), 0xE6EDF3FF, 0.012),
        "wheels": Lines((*wheels, ((x, y), place(radius, 0.0))), (0x8B949EFF, 0x8B949EFF, 0xE3B341FF), 0.03),
    }
