"""Attack: random linear problems of all shapes and units, each answer compared with the reference."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, final

import numpy as np

from safedpa_lab.experiments.adversary.attack import (
    BROKEN,
    CLOSE,
    AbstractAttack,
    Answers,
    Judged,
    Result,
    Row,
    above,
    pieces_of,
)
from safedpa_lab.experiments.adversary.linear.judge import FAR, judged
from safedpa_lab.experiments.adversary.linear.problem import random_problem, shape_of

_FULL: Final = 100_000
_SMALL: Final = 330
_PIECE: Final = 500


@final
class Programs(AbstractAttack):
    """Which conditions are broken unsaid, which actions are missed, and how unsafe the least-violation one is."""

    name = "programs"
    sentence = "random problems, linear in state and action, in all units and shapes, against linear programming"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        return pieces_of(seed, _SMALL if small else _FULL, _PIECE)

    def work(self, piece: Any) -> tuple[int, list[Judged]]:
        """The seed, and what was wrong with the answer to each problem."""
        seed, first, last = piece
        return seed, [_answered(seed, number) for number in range(first, last)]

    def reported(self, answers: Sequence[Any]) -> Result:
        """In the worst cases ``random_problem(seed, number)`` draws the problem again."""
        found = Answers(item for _, items in answers for item in items)
        worst = [
            {"fault": case.pop("fault"), "size": case.pop("size"), "seed": answers[0][0], **case}
            for case in found.worst(_FAULTS)
        ]
        return Result([*found.statuses(), *_rows(found)], worst)


def _answered(seed: int, number: int) -> Judged:
    problem = random_problem(seed, number)
    known: dict[str, Any] = {"number": number, "shape": shape_of(number)}
    try:
        verdict = problem.decide()
    except Exception as error:  # noqa: BLE001 - that nothing is raised is one of the questions
        return Judged(status=f"raised {type(error).__name__}", missed=True, **known)
    return replace(judged(problem, verdict), **known)


def _rows(found: Answers) -> list[Row]:
    items, kept, rest, excess = len(found.items), len(found.broken), found.rest, len(found.excess)
    raised = sum(item.status.startswith("raised") for item in found.items)
    fallback = sum(item.status == "fallback" for item in found.items)
    corrected = sum(item.status == "corrected" and (item.broken or 0.0) <= BROKEN for item in found.items)
    short = np.array(found.shortfall)
    close = 100.0 * float(np.mean(short <= CLOSE)) if len(short) else 100.0
    return [
        Row("raised an exception", raised, items, most=0),
        Row("action out of bounds", found.count("out_of_bounds"), items, most=0),
        Row("passed, but not the nominal action", found.count("altered"), items, most=0),
        Row("passed or corrected, condition broken", sum(b > BROKEN for b in found.broken), kept, most=0),
        Row("largest break, in scales", max(found.broken, default=0.0), kept, most=BROKEN),
        Row("passed or corrected, predicted h < 0", found.count("below"), kept, most=0),
        Row("h < 0 now, and not reported (or reported wrongly)", found.count("untold"), items, most=0),
        Row("no decision computed", fallback, items, most=0),
        Row("corrected further than needed", sum(e > FAR for e in found.excess), excess, most=0),
        Row("largest excess, in ranges", max(found.excess, default=0.0), excess, most=FAR),
        Row("corrected, and the reference found nothing", corrected - excess, corrected),
        Row("not corrected, though an action keeps all", found.count("missed"), rest, most=0),
        Row("within 1 % of the least-violation", close, len(short), least=99.9, unit="%"),
        Row("largest shortfall, in scales", float(short.max(initial=0.0)), len(short)),
        Row("h < 0 predicted, though h >= 0 attainable", found.count("needless"), rest, most=0),
    ]


_FAULTS: Final[Mapping[str, Callable[[Judged], float | None]]] = {
    "condition broken": lambda item: above(item.broken, BROKEN),
    "predicted h < 0": lambda item: float(item.below),
    "h < 0 now not reported": lambda item: float(item.untold),
    "no decision": lambda item: float(item.undecided),
    "too far": lambda item: above(item.excess, FAR),
    "missed": lambda item: float(item.missed),
    "not the least-violation": lambda item: above(item.shortfall, CLOSE),
    "h < 0 though h >= 0 attainable": lambda item: float(item.needless),
}
