"""Attack: commands that arrive late, whether the model knows, the robot's clock tells, or no one does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row
from safedpa_lab.experiments.delayed_drives import DelayedDrives, Lateness, delayed_drives, margin_with_delay

__all__ = ["LateDrives"]

_CASES: Final = (
    *(Lateness(seconds) for seconds in (0.1, 0.2, 0.3, 0.4)),
    Lateness(0.2, reported="clock"),
    Lateness(0.1, reported="none"),
    Lateness(0.15, reported="none"),
)
_SMALL_CASES: Final = (Lateness(0.2), Lateness(0.15, reported="none"))
_FULL: Final = (40, 12.0)
"""Drives of each case, and seconds of each."""
_SMALL: Final = (1, 3.0)


@final
class LateDrives(AbstractAttack):
    """Collisions, what the verdicts are, and goals. A model that knows the delay has a margin that was measured so."""

    name = "late"
    sentence = "drives whose commands arrive late, known and unknown"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        return [(case, seed, small) for case in (_SMALL_CASES if small else _CASES)]

    def work(self, piece: Any) -> DelayedDrives:  # noqa: D102
        case, seed, small = piece
        count, seconds = _SMALL if small else _FULL
        margin = margin_with_delay(case) if case.reported == "model" and not small else None
        return delayed_drives(case, count, 1000 * seed, seconds, margin=margin)

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        return Result([row for found in answers for row in _rows(found)])


def _rows(found: DelayedDrives) -> list[Row]:
    """What is known is asked to be corrected more often than relaxed: else the condition came too late to be kept."""
    late, statuses = found.lateness, found.statuses
    who = {"model": "known to the model", "clock": "told by the clock", "none": "known to no one"}[late.reported]
    name, ticks = f"{1000 * late.seconds:.0f} ms, {who}", sum(statuses.values())
    beyond = sum(statuses[status] for status in ("relaxed", "violated", "fallback"))
    asked = None if late.reported == "none" else 0
    notice = ", ".join(f"{status} {100 * count / max(1, ticks):.1f} %" for status, count in sorted(statuses.items()))
    return [
        Row(f"{name}: drives with a collision ({notice})", found.collided, found.drives, most=0),
        Row(f"{name}: relaxed and worse beyond corrected", max(0, beyond - statuses["corrected"]), ticks, most=asked),
        Row(f"{name}: goals", found.goals, found.drives),
        Row(f"{name}: least h", found.least_h, found.drives, unit="m"),
    ]
