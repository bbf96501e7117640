"""Attack: the car in random states among obstacles, each answer held against a grid of actions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.safety import FilterSettings, SafetyFilter, car_barriers
from safedpa.safety.shipped import settings_named
from safedpa_sim.experiments.adversary.attack import AbstractAttack, Result, Row
from safedpa_sim.experiments.adversary.car_judge import FIELD, FOOTPRINT, CarJudge, CarQuestion

__all__ = ["CarGrid", "car_question"]

_FULL: Final = 12_000
_SMALL: Final = 120
_PIECE: Final = 100
_FAR: Final = 0.1
"""Weighted ranges beyond the grid's nearest."""
_MOST_FAR: Final = 0.5
"""Per cent of the corrections."""
_CLOSE: Final = 0.01


@final
@dataclass(frozen=True)
class _Answer:
    number: int
    status: str
    broken: float | None
    """Passed and corrected: in scales."""
    below: bool
    missed: bool
    excess: float | None
    shortfall: float | None
    untold: bool


@final
class CarGrid(AbstractAttack):
    """Which feasible actions of the grid are missed, and which of them are nearer to the wish."""

    name = "car"
    sentence = "the car in random states among obstacles, against a grid of 27 x 35 actions"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        count = _SMALL if small else _FULL
        return [(seed, first, min(first + _PIECE, count)) for first in range(0, count, _PIECE)]

    def work(self, piece: Any) -> list[_Answer]:  # noqa: D102
        seed, first, last = piece
        model, settings = load_model("car"), settings_named("car")
        safe = SafetyFilter.for_model(model, settings)
        return [_answered(safe, model, settings, seed, number) for number in range(first, last)]

    def told(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        items = [item for answer in answers for item in answer]
        rows = [Row(f"answers {status}", count) for status, count in sorted(Counter(i.status for i in items).items())]
        return Result([*rows, *_rows(items)], _worst(items))


def car_question(seed: int, number: int) -> CarQuestion:
    """A state with every h >= 0, one in eight anywhere; one to eight obstacles, most of them near; any wish."""
    settings, random = settings_named("car"), np.random.default_rng([seed, 3, number])
    while True:
        place = random.uniform(-3.5, 3.5, 2)
        state = np.array([*place, random.uniform(-np.pi, np.pi), random.uniform(-0.6, 2.0)])
        count = int(random.integers(1, 9))
        bearing, away = random.uniform(-np.pi, np.pi, count), random.uniform(0.25, 1.2, count)
        centres = place[:, None] + away * np.stack([np.cos(bearing), np.sin(bearing)])
        obstacles = np.vstack([centres, random.uniform(0.1, 0.35, count)]).T
        wish = random.uniform(settings.action_low, settings.action_high)
        question = CarQuestion(state, wish, obstacles)
        if number % 8 == 0 or CarJudge(load_model("car"), settings, question).now.min() >= 0.0:
            return question


def _answered(safe: SafetyFilter, model: PhysicsModel, settings: FilterSettings, seed: int, number: int) -> _Answer:
    question = car_question(seed, number)
    barriers = car_barriers(settings, FOOTPRINT, question.obstacles, FIELD)
    verdict = safe.decide(question.state, question.wish, model.latent, barriers=barriers)
    judge, status = CarJudge(model, settings, question), verdict.status.value
    own = judge.heights(verdict.action[None])[0]
    kept = status in ("passed", "corrected")
    feasible = ((judge.h - judge.required) / judge.scale >= 1e-9).all(axis=1)
    excess = None
    if status == "corrected" and feasible.any():
        excess = float(judge.distance(verdict.action[None])[0] - judge.distance(judge.grid[feasible]).min())
    best = float((judge.h / judge.scale).min(axis=1).max())
    return _Answer(
        number,
        status,
        max(0.0, -float(((own - judge.required) / judge.scale).min())) if kept else None,
        kept and bool((own / judge.scale).min() < -1e-12),
        status in ("relaxed", "fallback") and bool(feasible.any()),
        excess,
        None if kept else max(0.0, best - float((own / judge.scale).min())),
        bool(judge.now.min() < -1e-12) != (status == "violated"),
    )


def _rows(items: Sequence[_Answer]) -> list[Row]:
    kept = [item.broken for item in items if item.broken is not None]
    excess = [item.excess for item in items if item.excess is not None]
    rest = [item for item in items if item.broken is None]
    short = [item.shortfall for item in rest if item.shortfall is not None]
    relaxed = sum(item.status in ("relaxed", "fallback") for item in items)
    far = 100.0 * sum(value > _FAR for value in excess) / max(1, len(excess))
    return [
        Row("largest break of a condition, in scales", max(kept, default=0.0), len(kept), most=1e-9),
        Row("passed or corrected, predicted h < 0", sum(item.below for item in items), len(kept), most=0),
        Row("h < 0 now, and not told (or told wrongly)", sum(item.untold for item in items), len(items), most=0),
        Row("relaxed, though the grid keeps all", sum(item.missed for item in items), relaxed, most=0),
        Row("corrected 0.1 of a range beyond the grid", far, len(excess), most=_MOST_FAR, unit="%"),
        Row("largest excess, in ranges", max(excess, default=0.0), len(excess)),
        Row("relaxed or violated: 1 % of scale below the grid", sum(v > _CLOSE for v in short), len(short), most=0),
        Row("largest shortfall, in scales", max(short, default=0.0), len(short)),
    ]


def _worst(items: Sequence[_Answer]) -> list[dict[str, Any]]:
    faults: dict[str, list[tuple[float, int]]] = {
        "condition broken": [(i.broken or 0.0, i.number) for i in items if (i.broken or 0.0) > 1e-9],
        "missed": [(1.0, i.number) for i in items if i.missed],
        "too far": [(i.excess or 0.0, i.number) for i in items if (i.excess or 0.0) > _FAR],
        "not the least unsafe": [(i.shortfall or 0.0, i.number) for i in items if (i.shortfall or 0.0) > _CLOSE],
        "h < 0 now not told": [(1.0, i.number) for i in items if i.untold],
    }
    return [
        {"fault": fault, "size": size, "number": number, "count": len(cases)}
        for fault, cases in faults.items()
        for size, number in sorted(cases, reverse=True)[:3]
    ]
