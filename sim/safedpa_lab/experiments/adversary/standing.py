"""Attack: two minutes with the shipped policy and every load: does the car stand, is it told, does it get on?

The point robot drives next to it, in winds: it has no way out of a stand, and here is what that costs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row
from safedpa_lab.experiments.long_drives import LongDrive, LongOutcome, long_summary, run_long_drive

__all__ = ["Standing"]

_LOADS: Final = ("none", "box", "chair", "large_chair")
_FULL: Final = (25, 120.0)
"""Drives of each load, and seconds of each."""
_SMALL: Final = (1, 4.0)
_LATENESS: Final = (0.0, 0.006)
"""s from sense to act, in turn: as in lockstep, and as a robot in real time tells it."""
_MOST_IS_STATIONARY: Final = 2
_GOALS: Final = 6.0
"""A minute, in the mean."""
_POINT: Final = "point"


@final
class Standing(AbstractAttack):
    """Stands of ten seconds and more, as the positions show them, and whether the verdicts tell them."""

    name = "standing"
    sentence = "two minutes of driving with every load: long stands, whether they are told, and goals"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        count, seconds = _SMALL if small else _FULL
        return [
            LongDrive(load, 1000 * seed + number, seconds, until_action=_LATENESS[number % len(_LATENESS)])
            for load in _LOADS
            for number in range(count)
        ] + [LongDrive(_POINT, 1000 * seed + number, seconds, driver=_POINT) for number in range(count)]

    def work(self, piece: Any) -> LongOutcome:  # noqa: D102
        return run_long_drive(piece)

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        found = long_summary(answer for answer in answers if answer.load != _POINT)
        point = long_summary(answer for answer in answers if answer.load == _POINT)
        drives = found["drives"]
        rows = [
            Row("drives with a stand of 10 s and more", found["stands"], drives, most=_MOST_IS_STATIONARY),
            Row("of these, not told", found["untold"], found["stands"], most=0),
            Row("drives with less than 1 m in any 20 s", found["crawls"], drives, most=_MOST_IS_STATIONARY),
            Row("goals a minute", found["goals_a_minute"], drives, least=_GOALS),
            Row("collisions", found["collisions"], drives, most=0),
            Row("point robot: drives with a stand of 10 s and more", point["stands"], point["drives"], most=0),
            Row("point robot: drives with less than 1 m in any 20 s", point["crawls"], point["drives"]),
            Row("point robot: goals a minute", point["goals_a_minute"], point["drives"]),
            Row("point robot: hazards entered", point["collisions"], point["drives"], most=0),
        ]
        longest = sorted(answers, key=lambda each: -each.longest_stand)[:5]
        worst = [
            {"fault": "stand", "load": each.load, "seed": each.seed, "seconds": each.longest_stand} for each in longest
        ]
        return Result(rows, [*worst, *found["standstills"], *point["standstills"]])
