"""Attack: the car in random states among obstacles, each answer compared with a grid of actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import FilterSettings, SafetyFilter
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.adversary.attack import (
    BROKEN,
    CLOSE,
    FAR,
    AbstractAttack,
    Answers,
    Judged,
    Result,
    Row,
    above,
    action_grid,
    judged_on_grid,
    pieces_of,
)

FOOTPRINT: Final = (0.08, 0.40, 0.12)
"""m; the segment's rear and front end and its radius."""
FIELD: Final = (-4.0, 4.0, -4.0, 4.0)
_GRID: Final = (27, 35)
"""Target speeds and steering angles."""


@final
@dataclass(frozen=True, eq=False)
class CarQuestion:
    """State (4,), nominal action (2,) and obstacles (m, 3)."""

    state: FloatArray
    nominal: FloatArray
    obstacles: FloatArray


@final
class CarJudge:
    """The conditions at one state, for any number of actions at once."""

    def __init__(self, model: PhysicsModel, settings: FilterSettings, question: CarQuestion) -> None:
        self._model, self._settings, self._question = model, settings, question
        self.now = self._h(question.state[None])[0]
        kinds = ["obstacle"] * len(question.obstacles) + ["field"] * 8 + ["speed"] * 2
        default = settings.epsilon.get("default", 0.0)
        margin = np.array([settings.epsilon.get(kind, default) for kind in kinds])
        self.required = (1.0 - settings.eta) * self.now + margin
        self.low, self.high = np.array(settings.action_low), np.array(settings.action_high)
        self.grid = action_grid(settings.action_low, settings.action_high, _GRID)
        self._least = np.maximum(np.abs(self.now), margin)

    @cached_property
    def h(self) -> FloatArray:
        """(grid, rows) predicted h."""
        return self.heights(self.grid)

    @cached_property
    def scale(self) -> FloatArray:
        """(rows,) of h now, of its margin, and of what the actions can change in it, the largest."""
        return np.asarray(np.maximum(self._least, self.h.max(axis=0) - self.h.min(axis=0)))

    def heights(self, actions: FloatArray) -> FloatArray:
        """(n, rows) predicted h for actions (n, 2)."""
        states = np.repeat(self._question.state[None], len(actions), axis=0)
        return self._h(np.asarray(self._model.step(states, actions, self._model.latent)))

    def distance(self, actions: FloatArray) -> FloatArray:
        """(n,) sqrt(sum weight_j ((a_j - nominal_j) / range_j)^2)."""
        weights = np.array(self._settings.weights or (1.0, 1.0))
        share = (actions - self._question.nominal) / (self.high - self.low)
        return np.asarray(np.sqrt((weights * share**2).sum(axis=1)))

    def _h(self, states: FloatArray) -> FloatArray:
        """h (n, rows): obstacles, walls at the front and at the rear end, and the two limits of speed."""
        x, y, yaw, v = (states[:, column, None] for column in range(4))
        c, s = np.cos(yaw), np.sin(yaw)
        front, rear = self._ends(v)
        obstacles = self._question.obstacles
        ahead = (obstacles[:, 0] - x) * c + (obstacles[:, 1] - y) * s
        aside = (obstacles[:, 1] - y) * c - (obstacles[:, 0] - x) * s
        beyond = ahead - np.minimum(np.maximum(ahead, rear), front)
        room = FOOTPRINT[2] + self._settings.barrier("clearance")
        parts = [np.sqrt(beyond**2 + aside**2) - obstacles[:, 2] - room]
        for end in (front, rear):
            across, along = x + end * c, y + end * s
            parts += [across - FIELD[0] - room, FIELD[1] - room - across]
            parts += [along - FIELD[2] - room, FIELD[3] - room - along]
        parts += [v - self._settings.barrier("speed_low"), self._settings.barrier("speed_high") - v]
        return np.concatenate(parts, axis=1)

    def _ends(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the swept segment ends, before and behind: D(v) as the page on safety has it."""
        b, k = self._settings.barrier("braking_deceleration"), self._settings.barrier("braking_gain")
        size = np.abs(v)
        stop = np.sign(v) * np.where(size <= b / k, size / k, b / k**2 + (size**2 - (b / k) ** 2) / (2.0 * b))
        return FOOTPRINT[1] + np.maximum(stop, 0.0), -FOOTPRINT[0] + np.minimum(stop, 0.0)


_PIECE: Final = 100
_MOST_FAR: Final = 0.5
"""Per cent of the corrections."""


@final
class CarGrid(AbstractAttack):
    """Which feasible actions of the grid are missed, and which of them are nearer to the nominal action."""

    name = "car"
    sentence = "the car in random states among obstacles, against a grid of 27 x 35 actions"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        return [
            (kind, *piece)
            for kind, (_, _, full, few) in _KINDS.items()
            for piece in pieces_of(seed, few if small else full, _PIECE)
        ]

    def work(self, piece: Any) -> tuple[str, list[Judged]]:  # noqa: D102
        kind, seed, first, last = piece
        name, drawn, _, _ = _KINDS[kind]
        model, settings = load_model(name), settings_named("car")
        safe = SafetyFilter.for_model(model, settings)
        return kind, [_answered(safe, model, settings, drawn(seed, n), n) for n in range(first, last)]

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        rows: list[Row] = []
        worst: list[dict[str, Any]] = []
        for kind in _KINDS:
            found = Answers(item for own, judged in answers if own == kind for item in judged)
            rows += [*found.statuses(f"{kind}: "), *_rows(kind, found)]
            worst += [
                {"kind": kind, **{key: value for key, value in case.items() if key != "shape"}}
                for case in found.worst(_FAULTS)
            ]
        return Result(rows, worst)


def odd_question(seed: int, number: int) -> CarQuestion:
    """Unusual scenes: an obstacle on the body, all of them twice, one as large as a hill, sixty."""
    question, random = car_question(seed, 8 * number), np.random.default_rng([seed, 11, number])
    state, obstacles = question.state, question.obstacles
    what = number % 5
    if what == 0:
        obstacles = np.vstack([obstacles, [*state[:2], 0.1]])
    elif what == 1:
        obstacles = np.vstack([obstacles, obstacles, obstacles])
    elif what == 2:
        bearing = random.uniform(-np.pi, np.pi)
        away = 1000.0 + random.uniform(0.4, 1.0)
        obstacles = np.array([[state[0] + away * np.cos(bearing), state[1] + away * np.sin(bearing), 1000.0]])
    elif what == 3:
        obstacles = np.column_stack([random.uniform(-4.0, 4.0, (60, 2)), random.uniform(0.0, 0.2, 60)])
    else:
        obstacles, state = obstacles * (1.0, 1.0, 0.0), state * (1.0, 1.0, 1.0, 0.0)
    return CarQuestion(state, question.nominal, obstacles)


def car_question(seed: int, number: int) -> CarQuestion:
    """A state with every h >= 0, one in eight anywhere; one to eight obstacles, most of them near."""
    settings, random = settings_named("car"), np.random.default_rng([seed, 3, number])
    while True:
        place = random.uniform(-3.5, 3.5, 2)
        state = np.array([*place, random.uniform(-np.pi, np.pi), random.uniform(-0.6, 2.0)])
        count = int(random.integers(1, 9))
        bearing, away = random.uniform(-np.pi, np.pi, count), random.uniform(0.25, 1.2, count)
        centres = place[:, None] + away * np.stack([np.cos(bearing), np.sin(bearing)])
        obstacles = np.vstack([centres, random.uniform(0.1, 0.35, count)]).T
        nominal = random.uniform(settings.action_low, settings.action_high)
        question = CarQuestion(state, nominal, obstacles)
        if number % 8 == 0 or CarJudge(load_model("car"), settings, question).now.min() >= 0.0:
            return question


def _answered(
    safe: SafetyFilter, model: PhysicsModel, settings: FilterSettings, question: CarQuestion, number: int
) -> Judged:
    barriers = car_barriers(settings, FOOTPRINT, question.obstacles, FIELD)
    verdict = safe.decide(question.state, question.nominal, model.latent, barriers=barriers)
    judge, status = CarJudge(model, settings, question), verdict.status.value
    own = judge.heights(verdict.action[None])[0]
    known = {
        "number": number,
        "untold": bool(judge.now.min() < -1e-12) != (status == "violated"),
        "below": bool((own / judge.scale).min() < -1e-12),
    }
    answer, grid = (verdict.action, own), (judge.grid, judge.h)
    return judged_on_grid(status, answer, grid, judge.required, judge.scale, judge.distance, **known)


def _rows(kind: str, found: Answers) -> list[Row]:
    kept, short = len(found.broken), len(found.shortfall)
    relaxed = sum(item.status in ("relaxed", "fallback") for item in found.items)
    far_below = sum(value > CLOSE for value in found.shortfall)
    unreported = f"{kind}: h < 0 now, and not reported (or reported wrongly)"
    return [
        Row(f"{kind}: largest break of a condition, in scales", max(found.broken, default=0.0), kept, most=BROKEN),
        Row(f"{kind}: passed or corrected, predicted h < 0", found.count("below"), kept, most=0),
        Row(unreported, found.count("untold"), len(found.items), most=0),
        Row(f"{kind}: relaxed, though the grid keeps all", found.count("missed"), relaxed, most=0),
        found.too_far(kind, _MOST_FAR),
        Row(f"{kind}: largest excess, in ranges", max(found.excess, default=0.0), len(found.excess)),
        Row(f"{kind}: relaxed or violated: 1 % of scale below the grid", far_below, short, most=0),
        Row(f"{kind}: largest shortfall, in scales", max(found.shortfall, default=0.0), short),
    ]


_FAULTS: Final[Mapping[str, Callable[[Judged], float | None]]] = {
    "condition broken": lambda item: above(item.broken, BROKEN),
    "missed": lambda item: float(item.missed),
    "too far": lambda item: above(item.excess, FAR),
    "not the least-violation": lambda item: above(item.shortfall, CLOSE),
    "h < 0 now not reported": lambda item: float(item.untold),
}
_KINDS: Final[dict[str, tuple[str, Callable[[int, int], CarQuestion], int, int]]] = {
    "car": ("car", car_question, 12_000, 120),
    "car with networks": ("car_learned", car_question, 2_000, 60),
    "odd scenes": ("car", odd_question, 2_000, 60),
}
"""By name: model, how a question is drawn, and how many of them."""
