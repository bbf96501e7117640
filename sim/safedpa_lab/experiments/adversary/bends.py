"""Attack: random problems that no linear program describes, each answer compared with a fine grid of actions.

Kinks, plateaus, steps, holes and several ways round, in one or two actions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
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

Random = np.random.Generator

_PLANE: Final = 2
_NUDGE: Final = 1e-6


@final
@dataclass(frozen=True, eq=False)
class BentProblem:
    """x+ = moved(a) at a state in the plane, h (n, m) of states (n, 2); h in its unit, actions in theirs."""

    shape: str
    state: FloatArray
    moved: Callable[[FloatArray], FloatArray]
    """(n, 2) of actions (n, actions) between -1 and 1."""
    h: Callable[[FloatArray], FloatArray]
    actions: int
    nominal: FloatArray
    """(actions,) of -1 to 1, or beyond."""
    eta: float
    epsilon: float
    units: tuple[float, float]
    """Factors of h and of the actions."""

    def filter(self) -> SafetyFilter:
        """The library's filter; the model's gradients are central differences about the given action."""
        h_unit, action_unit = self.units
        bound = (action_unit,) * self.actions
        settings = FilterSettings(
            action_low=tuple(-value for value in bound),
            action_high=bound,
            backup_action=(0.0,) * self.actions,
            eta=self.eta,
            epsilon=self.epsilon * h_unit,  # type: ignore[arg-type]
        )
        count = self.h(self.state[None]).shape[1]
        names = tuple(f"h {index}" for index in range(count))
        barrier = FunctionBarrier(lambda x: h_unit * self.h(x[None])[0], names=names)
        return SafetyFilter(self._affine, [barrier], settings, step=self._step)

    def decide(self) -> Any:
        """What the library's filter says."""
        return self.filter().decide(self.state, nominal=self.nominal * self.units[1])

    def _step(self, state: Any, action: Any) -> Any:
        del state
        return self.moved(np.asarray(action)[None] / self.units[1])[0]

    def _affine(self, state: Any, around: Any = None) -> Any:
        del state
        about = np.zeros(self.actions) if around is None else np.asarray(around) / self.units[1]
        nudges = _NUDGE * np.eye(self.actions)
        g = (self.moved(about + nudges) - self.moved(about - nudges)).T / (2.0 * _NUDGE)
        return self.moved(about[None])[0] - g @ about, g / self.units[1]


def bent_problem(seed: int, number: int) -> BentProblem:
    """The problem of this number: every other in other units."""
    random = np.random.default_rng([seed, 8, number])
    shape = tuple(BENT_SHAPES)[number % len(BENT_SHAPES)]
    actions = 2 if shape in ("turning",) else int(random.integers(1, _PLANE + 1))
    state = random.uniform(-1.0, 1.0, _PLANE)
    moved, h = BENT_SHAPES[shape](random, state, actions)
    units = tuple(10.0 ** random.uniform(-6.0, 6.0, 2)) if number // len(BENT_SHAPES) % 2 else (1.0, 1.0)
    return BentProblem(
        shape,
        state,
        moved,
        h,
        actions,
        random.uniform(-1.3, 1.3, actions),
        float(random.uniform(0.1, 1.0)),
        float(random.choice([0.0, 0.005])),
        (float(units[0]), float(units[1])),
    )


Parts = tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]


def _straight(random: Random, state: FloatArray, actions: int) -> Callable[[FloatArray], FloatArray]:
    """Each action moves the point by up to 0.3 its own way."""
    ways = random.normal(size=(actions, _PLANE))
    ways *= 0.3 / np.linalg.norm(ways, axis=1)[:, None]
    drift = random.normal(0.0, 0.05, _PLANE)
    return lambda a: np.asarray(state + drift + a @ ways)


def _kinks(random: Random, state: FloatArray, actions: int) -> Parts:
    """h is the least of several planes: bent outwards, so that what is safe has no holes."""
    slopes, room = random.normal(size=(4, _PLANE)), random.exponential(0.3, 4)
    return _straight(random, state, actions), lambda x: ((x - state) @ slopes.T + room).min(axis=1)[:, None]


def _discs(random: Random, state: FloatArray, actions: int) -> Parts:
    """Discs in the plane: often one can pass on either side."""
    count = int(random.integers(1, 5))
    bearing, radius = random.uniform(-np.pi, np.pi, count), random.uniform(0.05, 0.3, count)
    away = radius + random.exponential(0.1, count)
    centres = state + away[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    return (
        _straight(random, state, actions),
        lambda x: np.hypot(x[:, :1] - centres[:, 0], x[:, 1:] - centres[:, 1]) - radius,
    )


def _saturated(random: Random, state: FloatArray, actions: int) -> Parts:
    """Only the middle third of the actions' range moves anything."""
    moved, h = _kinks(random, state, actions)
    return lambda a: moved(np.clip(3.0 * a, -1.0, 1.0)), h


def _dead(random: Random, state: FloatArray, actions: int) -> Parts:
    """Small actions move nothing."""
    moved, h = _kinks(random, state, actions)
    band = float(random.uniform(0.1, 0.6))
    return lambda a: moved(np.where(np.abs(a) < band, 0.0, a)), h


def _steps(random: Random, state: FloatArray, actions: int) -> Parts:
    """h comes in steps of 0.05: its slope is 0 or endless."""
    moved, h = _kinks(random, state, actions)
    return moved, lambda x: np.floor(20.0 * h(x)) / 20.0


def _cliff(random: Random, state: FloatArray, actions: int) -> Parts:
    """h falls by 1 at once where something begins."""
    moved, h = _kinks(random, state, actions)
    return moved, lambda x: np.where(h(x) > 0.05, h(x), h(x) - 1.0)


def _curved(random: Random, state: FloatArray, actions: int) -> Parts:
    """h bends either way, strongly."""
    bend, slope = random.normal(0.0, 3.0, (3, _PLANE)), random.normal(size=(3, _PLANE))
    room = random.exponential(0.2, 3)
    return (
        _straight(random, state, actions),
        lambda x: (x - state) @ slope.T + ((x - state) ** 2) @ bend.T + room,
    )


def _flat(random: Random, state: FloatArray, actions: int) -> Parts:
    """h saturates like a hyperbolic tangent: far away nothing seems to change it."""
    moved, h = _kinks(random, state, actions)
    sharp = 10.0 ** random.uniform(0.0, 2.0)
    return moved, lambda x: np.tanh(sharp * h(x))


def _holes(random: Random, state: FloatArray, actions: int) -> Parts:
    """Beyond 0.8 of the range of the first action the model has no answer."""
    moved, h = _kinks(random, state, actions)

    def holed(a: FloatArray) -> FloatArray:
        return np.where(np.abs(a[:, :1]) > 0.8, np.nan, moved(a))

    return holed, h


def _turning(random: Random, state: FloatArray, actions: int) -> Parts:
    """Speed and steering angle: the second action turns where the first one leads."""
    del actions
    _, h = _discs(random, state, 2)
    heading = float(random.uniform(-np.pi, np.pi))

    def moved(a: FloatArray) -> FloatArray:
        bearing = heading + 2.0 * a[:, 1]
        way = 0.15 * (a[:, 0] + 0.6)
        return np.asarray(state + way[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1))

    return moved, h


BENT_SHAPES: Final[dict[str, Callable[[Random, FloatArray, int], Parts]]] = {
    "kinks": _kinks,
    "discs": _discs,
    "saturated": _saturated,
    "dead band": _dead,
    "steps": _steps,
    "cliff": _cliff,
    "curved": _curved,
    "flat": _flat,
    "holes": _holes,
    "turning": _turning,
}
"""By name; problem n has the (n modulo their number)-th."""


_FULL: Final = 20_000
_SMALL: Final = 200
_PIECE: Final = 200
_POINTS: Final = {1: 1001, 2: 61}
_SMOOTH: Final = ("kinks", "discs", "saturated", "curved", "flat", "turning")
"""Where h has a slope nearly everywhere that leads somewhere."""


@final
class Bends(AbstractAttack):
    """What a local search misses, and whether it ever promises what does not hold."""

    name = "bends"
    sentence = "random problems with kinks, plateaus, steps, holes and several ways round, against grids of actions"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        return pieces_of(seed, _SMALL if small else _FULL, _PIECE)

    def work(self, piece: Any) -> list[Judged]:  # noqa: D102
        seed, first, last = piece
        return [bent_answer(bent_problem(seed, number), number) for number in range(first, last)]

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        found = Answers(item for answer in answers for item in answer)
        rows = found.statuses()
        for shape in BENT_SHAPES:
            rows += _rows(shape, Answers(item for item in found.items if item.shape == shape))
        return Result(rows, found.worst(_FAULTS))


def bent_answer(problem: BentProblem, number: int = -1) -> Judged:
    """Asks the filter, and the grid."""
    with np.errstate(all="ignore"):
        try:
            verdict = problem.decide()
        except Exception as error:  # noqa: BLE001 - that nothing is raised is one of the questions
            return Judged(status=f"raised {type(error).__name__}", number=number, shape=problem.shape)
        return _judged(problem, number, verdict.status.value, verdict.action / problem.units[1])


def _judged(problem: BentProblem, number: int, status: str, action: FloatArray) -> Judged:
    grid = action_grid([-1.0] * problem.actions, [1.0] * problem.actions, [_POINTS[problem.actions]] * problem.actions)
    h = problem.h(problem.moved(grid))
    grid, h = grid[np.isfinite(h).all(axis=1)], h[np.isfinite(h).all(axis=1)]
    now, own = problem.h(problem.state[None])[0], problem.h(problem.moved(action[None]))[0]
    required = (1.0 - problem.eta) * now + problem.epsilon
    scale = np.maximum(np.maximum(np.abs(now), problem.epsilon), h.max(axis=0) - h.min(axis=0))
    scale[scale == 0.0] = 1.0
    known = {"number": number, "shape": problem.shape, "below": bool(own.min() < -1e-12)}
    return judged_on_grid(status, (action, own), (grid, h), required, scale, partial(_far, problem), **known)


def _far(problem: BentProblem, actions: FloatArray) -> FloatArray:
    return np.asarray(0.5 * np.linalg.norm(actions - problem.nominal, axis=1))


def _rows(shape: str, found: Answers) -> list[Row]:
    """Steps, cliffs, holes and dead bands have no gradient: misses are reported there, without a limit."""
    kept, rest = len(found.broken), found.rest
    asked, few = (0.0, 0.5) if shape in _SMOOTH else (None, None)
    largest = max(found.broken, default=0.0)
    short = sum(value > CLOSE for value in found.shortfall)
    return [
        Row(f"{shape}: raised, or no decision", found.count("undecided"), len(found.items), most=0),
        Row(f"{shape}: largest break of a condition, in scales", largest, kept, most=BROKEN),
        Row(f"{shape}: passed or corrected, predicted h < 0", found.count("below"), kept, most=0),
        Row(f"{shape}: not corrected, though the grid keeps all", found.count("missed"), rest, most=asked),
        found.too_far(shape, few),
        Row(f"{shape}: h < 0 predicted, grid keeps h >= 0", found.count("needless"), rest, most=asked),
        Row(f"{shape}: 1 % of scale below the grid's least-violation", short, rest),
    ]


_FAULTS: Final[Mapping[str, Callable[[Judged], float | None]]] = {
    "condition broken": lambda item: above(item.broken, BROKEN),
    "no decision": lambda item: float(item.undecided),
    "missed": lambda item: float(item.missed),
    "too far": lambda item: above(item.excess, FAR),
    "h < 0 though h >= 0 attainable": lambda item: float(item.needless),
}
