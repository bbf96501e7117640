"""Attack: the same question put differently must have the same answer, and a filter must not remember the last one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.safety import SafetyFilter, Verdict
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row, pieces_of
from safedpa_lab.experiments.adversary.linear.judge import LinearJudge
from safedpa_lab.experiments.adversary.linear.problem import LinearProblem, random_problem

Random = np.random.Generator
Back = Callable[[FloatArray], FloatArray]
Mirrored = tuple[LinearProblem, Back]
"""The same question in another form, and how its actions are read in the first one."""

_FULL: Final = 6_000
_SMALL: Final = 60
_PIECE: Final = 60
_SHAPES: Final = ("plain", "tight", "degenerate", "feeble", "crowded", "costly", "wide")
"""Others are borderline: the last digit decides between two answers."""
_SAME: Final = 1e-6
"""Ranges within which two actions are the same; of the least-violation ones the least h is compared."""
_AS_HIGH: Final = 0.01
"""Scales."""


@final
@dataclass(frozen=True)
class Reflected:
    """One answer next to that to the question as it was."""

    mirror: str
    number: int
    statuses: tuple[str, str]
    apart: float
    """Passed and corrected: weighted ranges between the actions; else scales between their least h."""
    same: bool


def _as_it_was(action: FloatArray) -> FloatArray:
    return action


def _rows_shuffled(problem: LinearProblem, random: Random) -> Mirrored:
    order = random.permutation(len(problem.q))
    return _with_rows(problem, order), _as_it_was


def _rows_doubled(problem: LinearProblem, random: Random) -> Mirrored:
    order = random.integers(len(problem.q), size=3)
    return _with_rows(problem, np.concatenate([np.arange(len(problem.q)), order])), _as_it_was


def _with_rows(problem: LinearProblem, rows: NDArray[np.int64]) -> LinearProblem:
    return replace(problem, P=problem.P[rows], q=problem.q[rows], epsilon=problem.epsilon[rows])


def _row_that_never_binds(problem: LinearProblem, random: Random) -> Mirrored:
    del random
    P, q = np.vstack([problem.P, np.zeros_like(problem.P[:1])]), np.append(problem.q, 1.0)
    return replace(problem, P=P, q=q, epsilon=np.append(problem.epsilon, 0.0)), _as_it_was


def _actions_shuffled(problem: LinearProblem, random: Random) -> Mirrored:
    order = random.permutation(len(problem.low))
    names = ("low", "high", "nominal", "weights")
    parts: dict[str, Any] = {name: getattr(problem, name)[order] for name in names}
    return replace(problem, g=problem.g[:, order], **parts), lambda action: action[np.argsort(order)]


def _actions_turned_round(problem: LinearProblem, random: Random) -> Mirrored:
    sign = random.choice([-1.0, 1.0], len(problem.low))
    low, high = np.minimum(sign * problem.low, sign * problem.high), np.maximum(sign * problem.low, sign * problem.high)
    turned = replace(problem, g=problem.g * sign, low=low, high=high, nominal=sign * problem.nominal)
    return turned, lambda action: sign * action


def _actions_counted_from_elsewhere(problem: LinearProblem, random: Random) -> Mirrored:
    shift = (problem.high - problem.low) * random.uniform(-10.0, 10.0, len(problem.low))
    moved = replace(
        problem,
        f=problem.f - problem.g @ shift,
        low=problem.low + shift,
        high=problem.high + shift,
        nominal=problem.nominal + shift,
    )
    return moved, lambda action: action - shift


def _states_turned(problem: LinearProblem, random: Random) -> Mirrored:
    states = len(problem.f)
    turn, _ = np.linalg.qr(random.normal(size=(states, states)))
    scale = np.abs(problem.state) + np.abs(problem.f) + np.abs(problem.g).sum(axis=1)
    if scale.max() > 1e3 * scale.min():  # mixed units: a turn would drown the small ones in the large ones' digits
        return problem, _as_it_was
    return replace(
        problem, state=turn @ problem.state, f=turn @ problem.f, g=turn @ problem.g, P=problem.P @ turn.T
    ), _as_it_was


def _gradient_reported_or_not(problem: LinearProblem, random: Random) -> Mirrored:
    del random
    return replace(problem, gradient=not problem.gradient), _as_it_was


MIRRORS: Final[Mapping[str, Callable[[LinearProblem, Random], Mirrored]]] = {
    "barriers in another order": _rows_shuffled,
    "barriers twice": _rows_doubled,
    "a barrier that never binds": _row_that_never_binds,
    "actions in another order": _actions_shuffled,
    "actions turned round": _actions_turned_round,
    "actions counted from elsewhere": _actions_counted_from_elsewhere,
    "states turned": _states_turned,
    "gradient given or not": _gradient_reported_or_not,
}
"""By name."""
_WORN: Final = "a filter that answered others before"
_AGAIN: Final = "its own answer requested"


@final
class Mirrors(AbstractAttack):
    """Answers that depend on the form of a question, or on earlier questions."""

    name = "mirrors"
    sentence = "the same problems put differently, and to a filter that has answered others before"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        return pieces_of(seed, _SMALL if small else _FULL, _PIECE)

    def work(self, piece: Any) -> list[Reflected]:  # noqa: D102
        seed, first, last = piece
        found: list[Reflected] = []
        worn = _Worn()
        for number in range(first, last):
            problem, random = _problem(seed, number), np.random.default_rng([seed, 9, number])
            answer = problem.decide()
            for name, mirror in MIRRORS.items():
                other, back = mirror(problem, random)
                found.append(_alongside(name, number, problem, answer, other.decide(), back))
            boxed = _in_the_unit_box(problem)
            found.append(_alongside(_WORN, number, boxed, boxed.decide(), worn.decide(boxed), _as_it_was))
            if answer.status.value == "corrected":
                again = replace(problem, nominal=answer.action.copy()).decide()
                found.append(_alongside(_AGAIN, number, problem, answer, again, _as_it_was))
        return found

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        items = [item for answer in answers for item in answer]
        rows: list[Row] = []
        for name in (*MIRRORS, _WORN, _AGAIN):
            own = [item for item in items if item.mirror == name]
            apart = max((item.apart for item in own), default=0.0)
            rows.append(Row(f"{name}: other answers", sum(not item.same for item in own), len(own), most=0))
            rows.append(Row(f"{name}: furthest apart", apart, len(own)))
        return Result(rows, _worst(items))


def _problem(seed: int, number: int) -> LinearProblem:
    """The problem of this number among those that are not borderline."""
    candidate = 5 * number
    while random_problem(seed, candidate).shape not in _SHAPES:
        candidate += 1
    return random_problem(seed, candidate)


@final
class _Worn:
    """Filters that have answered other questions before: one per number of actions."""

    def __init__(self) -> None:
        self._filters: dict[int, SafetyFilter] = {}
        self._motion: tuple[FloatArray, FloatArray] | None = None

    def decide(self, problem: LinearProblem) -> Verdict:
        """The answer to a problem in the unit box with the weights and eta of all of them."""
        self._motion = problem.f, problem.g
        actions = len(problem.low)
        if actions not in self._filters:
            empty = replace(problem, P=problem.P[:1], q=problem.q[:1], epsilon=np.zeros(1))
            self._filters[actions] = SafetyFilter(lambda _: self._motion, empty.barriers(), empty.settings())
        margins = {f"row {index}": margin for index, margin in enumerate(problem.epsilon.tolist())}
        return self._filters[actions].decide(
            problem.state, nominal=problem.nominal, barriers=problem.barriers(), epsilon=margins
        )


def _in_the_unit_box(problem: LinearProblem) -> LinearProblem:
    width = problem.high - problem.low
    return replace(
        problem,
        f=problem.f + problem.g @ problem.low,
        g=problem.g * width,
        low=np.zeros(len(width)),
        high=np.ones(len(width)),
        nominal=np.clip((problem.nominal - problem.low) / width, -9.0, 9.0),
        weights=np.ones(len(width)),
        eta=0.5,
        witness=None,
    )


def _alongside(
    name: str, number: int, problem: LinearProblem, answer: Verdict, other: Verdict, back: Back
) -> Reflected:
    judge, action = LinearJudge(problem), back(other.action)
    statuses = answer.status.value, other.status.value
    kept = ("passed", "corrected")
    if statuses[0] in kept and statuses[1] in kept:
        weights = problem.weights / problem.weights.max()
        apart = float((np.sqrt(weights) * np.abs(action - answer.action) / judge.width).max())
        return Reflected(name, number, statuses, apart, apart <= _SAME)
    apart = abs(float(judge.movable(action).min()) - float(judge.movable(answer.action).min()))
    return Reflected(name, number, statuses, apart, statuses[0] == statuses[1] and apart <= _AS_HIGH)


def _worst(items: Sequence[Reflected]) -> list[dict[str, Any]]:
    different = [item for item in items if not item.same]
    counts = Counter(item.mirror for item in different)
    worst: list[dict[str, Any]] = []
    for name, count in counts.items():
        own = sorted((item for item in different if item.mirror == name), key=lambda item: -item.apart)[:3]
        worst += [
            {"fault": name, "number": item.number, "statuses": item.statuses, "apart": item.apart, "count": count}
            for item in own
        ]
    return worst
