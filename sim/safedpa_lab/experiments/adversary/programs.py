"""Attack: random linear problems of all shapes and units, each answer compared with the reference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Final, final

import numpy as np

from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row
from safedpa_lab.experiments.adversary.linear.judge import BROKEN, FAR, Judged, judged
from safedpa_lab.experiments.adversary.linear.problem import random_problem, shape_of

_FULL: Final = 100_000
_SMALL: Final = 330
_PIECE: Final = 500
_KEPT_CASES: Final = 3
"""Number of worst cases reported per fault."""
_CLOSE: Final = 0.01
"""Share of the scale within which the least-violation action counts as such."""


@final
class Programs(AbstractAttack):
    """Which conditions are broken unsaid, which actions are missed, and how unsafe the least-violation one is."""

    name = "programs"
    sentence = "random problems, linear in state and action, in all units and shapes, against linear programming"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        count = _SMALL if small else _FULL
        return [(seed, first, min(first + _PIECE, count)) for first in range(0, count, _PIECE)]

    def work(self, piece: Any) -> list[tuple[int, int, Judged]]:
        """(seed, number, what was wrong) of each problem."""
        seed, first, last = piece
        return [(seed, number, _answered(seed, number)) for number in range(first, last)]

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        found = [item for answer in answers for item in answer]
        items = [item for _, _, item in found]
        rows = [Row(f"answers {status}", count) for status, count in sorted(Counter(i.status for i in items).items())]
        return Result([*rows, *_rows(items)], _worst(found))


def _answered(seed: int, number: int) -> Judged:
    problem = random_problem(seed, number)
    try:
        verdict = problem.decide()
    except Exception as error:  # noqa: BLE001 - that nothing is raised is one of the questions
        return Judged(f"raised {type(error).__name__}", False, False, None, False, False, None, True, None, False)
    return judged(problem, verdict)


def _rows(items: Sequence[Judged]) -> list[Row]:
    kept = [item.broken for item in items if item.broken is not None]
    excess = [item.excess for item in items if item.excess is not None]
    corrected = sum(item.status == "corrected" and (item.broken or 0.0) <= BROKEN for item in items)
    rest = [item for item in items if item.broken is None]
    short = np.array([item.shortfall for item in rest if item.shortfall is not None])
    close = 100.0 * float(np.mean(short <= _CLOSE)) if len(short) else 100.0
    return [
        Row("raised an exception", sum(item.status.startswith("raised") for item in items), len(items), most=0),
        Row("action out of bounds", sum(item.out_of_bounds for item in items), len(items), most=0),
        Row("passed, but not the nominal action", sum(item.altered for item in items), len(items), most=0),
        Row("passed or corrected, condition broken", sum(b > BROKEN for b in kept), len(kept), most=0),
        Row("largest break, in scales", max(kept, default=0.0), len(kept), most=BROKEN),
        Row("passed or corrected, predicted h < 0", sum(item.below for item in items), len(kept), most=0),
        Row(
            "h < 0 now, and not reported (or reported wrongly)", sum(item.untold for item in items), len(items), most=0
        ),
        Row("no decision computed", sum(item.status == "fallback" for item in items), len(items), most=0),
        Row("corrected further than needed", sum(e > FAR for e in excess), len(excess), most=0),
        Row("largest excess, in ranges", max(excess, default=0.0), len(excess), most=FAR),
        Row("corrected, and the reference found nothing", corrected - len(excess), corrected),
        Row("not corrected, though an action keeps all", sum(item.missed for item in rest), len(rest), most=0),
        Row("within 1 % of the least-violation", close, len(short), least=99.9, unit="%"),
        Row("largest shortfall, in scales", float(short.max(initial=0.0)), len(short)),
        Row("h < 0 predicted, though h >= 0 attainable", sum(item.needless for item in rest), len(rest), most=0),
    ]


def _worst(found: Sequence[tuple[int, int, Judged]]) -> list[dict[str, Any]]:
    """Of each fault the numbers of the worst problems: ``random_problem(seed, number)`` draws them again."""
    faults: dict[str, list[tuple[float, int, int]]] = {}

    def add(fault: str, size: float, seed: int, number: int) -> None:
        faults.setdefault(fault, []).append((size, seed, number))

    for seed, number, item in found:
        marks = {
            "condition broken": item.broken if (item.broken or 0.0) > BROKEN else None,
            "predicted h < 0": 1.0 if item.below else None,
            "h < 0 now not reported": 1.0 if item.untold else None,
            "no decision": 1.0 if item.status == "fallback" or item.status.startswith("raised") else None,
            "too far": item.excess if (item.excess or 0.0) > FAR else None,
            "missed": 1.0 if item.missed else None,
            "not the least-violation": item.shortfall if (item.shortfall or 0.0) > _CLOSE else None,
            "h < 0 though h >= 0 attainable": 1.0 if item.needless else None,
        }
        for fault, size in marks.items():
            if size is not None:
                add(fault, size, seed, number)
    return [
        {"fault": fault, "size": size, "seed": seed, "number": number, "shape": shape_of(number), "count": len(cases)}
        for fault, cases in faults.items()
        for size, seed, number in sorted(cases, reverse=True)[:_KEPT_CASES]
    ]
