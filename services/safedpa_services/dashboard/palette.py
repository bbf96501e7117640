"""Colours that colour-blind people can distinguish (Okabe and Ito, Color Universal Design, 2008), as 0xRRGGBBAA."""

from __future__ import annotations

from typing import Final

from safedpa.safety.verdict import Status

INK: Final = 0xF2F2F2FF
GREY: Final = 0x9A9A9AFF
ORANGE: Final = 0xE69F00FF
SKY: Final = 0x56B4E9FF
GREEN: Final = 0x009E73FF
YELLOW: Final = 0xF0E442FF
BLUE: Final = 0x0072B2FF
VERMILION: Final = 0xD55E00FF
PURPLE: Final = 0xCC79A7FF

_SERIES: Final = (SKY, ORANGE, GREEN, PURPLE, VERMILION, YELLOW, INK, BLUE)

UNKNOWN_STATUS: Final = GREY
RED: Final = 0xFF2D2DFF

NO_VERDICT: Final = "none"
"""Shown in place of a status while there is no recent verdict."""
VERDICT_COLOURS: Final = {
    Status.passed.value: GREEN,
    Status.corrected.value: SKY,
    Status.relaxed.value: ORANGE,
    Status.violated.value: RED,
    Status.fallback.value: VERMILION,
    Status.disabled.value: PURPLE,
    Status.stopped.value: YELLOW,
    NO_VERDICT: GREY,
}
HEALTH_COLOURS: Final = {"ready": SKY, "running": GREEN, "failing": VERMILION, "silent": GREY}
IN_FORCE_COLOURS: Final = {"filter": GREEN, "watchdog": VERMILION, "none": GREY}


def faded(colour: int, opacity: float) -> int:
    """Returns the colour with an opacity from 0 to 1."""
    return (colour & 0xFFFFFF00) | round(255 * opacity)


def series_colour(index: int) -> int:
    """Returns the colour of a plot's curve number ``index``."""
    return _SERIES[index % len(_SERIES)]
