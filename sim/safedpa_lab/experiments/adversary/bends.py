"""Attack: random problems that no linear program describes, each answer compared with a fine grid of actions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row
from safedpa_lab.experiments.adversary.bent_problem import BENT_SHAPES, BentProblem, bent_problem

_FULL: Final = 20_000
_SMALL: Final = 200
_PIECE: Final = 200
_BROKEN: Final = 1e-9
_FAR: Final = 0.1
_CLOSE: Final = 0.01
_POINTS: Final = {1: 1001, 2: 61}
_SMOOTH: Final = ("kinks", "discs", "saturated", "curved", "flat", "turning")
"""Where h has a slope nearly everywhere that leads somewhere."""


@final
@dataclass(frozen=True)
class BentAnswer:
    """One answer, compared with the grid; None where a question does not arise."""

    number: int
    shape: str
    status: str
    broken: float | None = None
    below: bool = False
    missed: bool = False
    """Not passed or corrected, though a point of the grid satisfies all conditions with room."""
    excess: float | None = None
    """Distance from the nominal action beyond the grid's nearest, in ranges."""
    shortfall: float | None = None
    needless: bool = False


@final
class Bends(AbstractAttack):
    """What a local search misses, and whether it ever promises what does not hold."""

    name = "bends"
    sentence = "random problems with kinks, plateaus, steps, holes and several ways round, against grids of actions"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        count = _SMALL if small else _FULL
        return [(seed, first, min(first + _PIECE, count)) for first in range(0, count, _PIECE)]

    def work(self, piece: Any) -> list[BentAnswer]:  # noqa: D102
        seed, first, last = piece
        return [bent_answer(bent_problem(seed, number), number) for number in range(first, last)]

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        items = [item for answer in answers for item in answer]
        rows = [Row(f"answers {status}", count) for status, count in sorted(Counter(i.status for i in items).items())]
        for shape in BENT_SHAPES:
            rows += _rows(shape, [item for item in items if item.shape == shape])
        return Result(rows, _worst(items))


def bent_answer(problem: BentProblem, number: int = -1) -> BentAnswer:
    """Asks the filter, and the grid."""
    with np.errstate(all="ignore"):
        try:
            verdict = problem.decide()
        except Exception as error:  # noqa: BLE001 - that nothing is raised is one of the questions
            return BentAnswer(number, problem.shape, f"raised {type(error).__name__}")
        return _judged(problem, number, verdict.status.value, verdict.action / problem.units[1])


def _judged(problem: BentProblem, number: int, status: str, action: FloatArray) -> BentAnswer:
    grid = _grid(problem.actions)
    h = problem.h(problem.moved(grid))
    grid, h = grid[np.isfinite(h).all(axis=1)], h[np.isfinite(h).all(axis=1)]
    now, own = problem.h(problem.state[None])[0], problem.h(problem.moved(action[None]))[0]
    required = (1.0 - problem.eta) * now + problem.epsilon
    scale = np.maximum(np.maximum(np.abs(now), problem.epsilon), h.max(axis=0) - h.min(axis=0))
    scale[scale == 0.0] = 1.0
    keeping = grid[((h - required) / scale >= _BROKEN).all(axis=1)]
    if status in ("passed", "corrected"):
        excess = None
        if status == "corrected" and len(keeping):
            excess = float(_far(problem, action[None])[0] - _far(problem, keeping).min())
        broken = max(0.0, -float(((own - required) / scale).min())) if np.isfinite(own).all() else float("inf")
        return BentAnswer(number, problem.shape, status, broken, bool(own.min() < -1e-12), excess=excess)
    height = -float("inf") if not np.isfinite(own).all() else float((own / scale).min())
    return BentAnswer(
        number,
        problem.shape,
        status,
        missed=status != "violated" and len(keeping) > 0,
        shortfall=max(0.0, float((h / scale).min(axis=1).max()) - height),
        needless=status != "violated" and height < -_BROKEN and bool((h >= 0.0).all(axis=1).any()),
    )


def _grid(actions: int) -> FloatArray:
    side = np.linspace(-1.0, 1.0, _POINTS[actions])
    return np.stack(np.meshgrid(*[side] * actions), axis=-1).reshape(-1, actions)


def _far(problem: BentProblem, actions: FloatArray) -> FloatArray:
    return np.asarray(0.5 * np.linalg.norm(actions - problem.nominal, axis=1))


def _rows(shape: str, items: Sequence[BentAnswer]) -> list[Row]:
    """Steps, cliffs, holes and dead bands have no gradient: misses are reported there, without a limit."""
    kept = [item.broken for item in items if item.broken is not None]
    excess = [item.excess for item in items if item.excess is not None]
    rest = [item for item in items if item.broken is None]
    asked, few = (0.0, 0.5) if shape in _SMOOTH else (None, None)
    far = 100.0 * sum(value > _FAR for value in excess) / max(1, len(excess))
    short = sum((item.shortfall or 0.0) > _CLOSE for item in rest)
    return [
        Row(f"{shape}: raised, or no decision", _without(items), len(items), most=0),
        Row(f"{shape}: largest break of a condition, in scales", max(kept, default=0.0), len(kept), most=_BROKEN),
        Row(f"{shape}: passed or corrected, predicted h < 0", sum(i.below for i in items), len(kept), most=0),
        Row(f"{shape}: not corrected, though the grid keeps all", sum(i.missed for i in rest), len(rest), most=asked),
        Row(f"{shape}: corrected 0.1 of a range beyond the grid", far, len(excess), most=few, unit="%"),
        Row(f"{shape}: h < 0 predicted, grid keeps h >= 0", sum(i.needless for i in rest), len(rest), most=asked),
        Row(f"{shape}: 1 % of scale below the grid's least-violation", short, len(rest)),
    ]


def _without(items: Sequence[BentAnswer]) -> int:
    return sum(item.status.startswith("raised") or item.status == "fallback" for item in items)


def _worst(items: Sequence[BentAnswer]) -> list[dict[str, Any]]:
    faults: dict[str, list[tuple[float, int, str]]] = {
        "condition broken": [(i.broken or 0.0, i.number, i.shape) for i in items if (i.broken or 0.0) > _BROKEN],
        "no decision": [(1.0, i.number, i.shape) for i in items if _without([i])],
        "missed": [(1.0, i.number, i.shape) for i in items if i.missed],
        "too far": [(i.excess or 0.0, i.number, i.shape) for i in items if (i.excess or 0.0) > _FAR],
        "h < 0 though h >= 0 attainable": [(1.0, i.number, i.shape) for i in items if i.needless],
    }
    return [
        {"fault": fault, "size": size, "number": number, "shape": shape, "count": len(cases)}
        for fault, cases in faults.items()
        for size, number, shape in sorted(cases, reverse=True)[:3]
    ]
