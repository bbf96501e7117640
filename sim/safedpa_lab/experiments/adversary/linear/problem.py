"""A problem whose every answer can be checked: motion and barriers affine in state and action."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Verdict


@final
@dataclass(frozen=True, eq=False)
class LinearProblem:
    """x+ = f + g a and h = P x + q at one state, with a nominal action: what a filter is asked about, once.

    f and state (states,), g (states, actions), P (rows, states), q and epsilon (rows,), the rest (actions,).
    """

    shape: str
    """How it was drawn."""
    state: FloatArray
    f: FloatArray
    g: FloatArray
    P: FloatArray
    q: FloatArray
    low: FloatArray
    high: FloatArray
    nominal: FloatArray
    weights: FloatArray
    eta: float
    epsilon: FloatArray
    gradient: bool
    """Whether the filter gets the gradient of h."""
    witness: FloatArray | None = None
    """(actions,) an action that satisfies all conditions by construction."""

    def heights(self, state: FloatArray) -> FloatArray:
        """h (rows,) at a state (states,)."""
        return np.array([float(p @ state) + q for p, q in zip(self.P, self.q.tolist(), strict=True)])

    def after(self, action: FloatArray) -> FloatArray:
        """x+ (states,) under an action (actions,)."""
        return np.asarray(self.f + self.g @ action)

    def settings(self) -> FilterSettings:
        """The filter's settings for this problem: one margin a row, the middle of the box as the backup."""
        return FilterSettings(
            action_low=tuple(self.low.tolist()),
            action_high=tuple(self.high.tolist()),
            weights=tuple(self.weights.tolist()),
            backup_action=tuple(np.clip(0.5 * (self.low + self.high), self.low, self.high).tolist()),
            eta=self.eta,
            epsilon={f"row {index}": margin for index, margin in enumerate(self.epsilon.tolist())},
        )

    def barriers(self) -> list[FunctionBarrier]:
        """One barrier a row."""
        return [self._barrier(index) for index in range(len(self.q))]

    def filter(self) -> SafetyFilter:
        """The library's filter for this problem."""
        return SafetyFilter(lambda _: (self.f, self.g), self.barriers(), self.settings())

    def decide(self) -> Verdict:
        """What the library's filter says."""
        return self.filter().decide(self.state, nominal=self.nominal)

    def scaled(self, heights: FloatArray, states: FloatArray, actions: FloatArray) -> LinearProblem:
        """The same problem in other units: h_i times heights_i, x_j times states_j, a_k times actions_k."""
        return replace(
            self,
            state=self.state * states,
            f=self.f * states,
            g=self.g * states[:, None] / actions,
            P=self.P * heights[:, None] / states,
            q=self.q * heights,
            epsilon=self.epsilon * heights,
            low=self.low * actions,
            high=self.high * actions,
            nominal=self.nominal * actions,
            witness=None if self.witness is None else self.witness * actions,
        )

    def _barrier(self, index: int) -> FunctionBarrier:
        p, q = self.P[index], float(self.q[index])
        gradient = (lambda _: p) if self.gradient else None
        return FunctionBarrier(lambda x: float(p @ x) + q, gradient, (f"row {index}",), f"row {index}")


Random = np.random.Generator

_MOST_ROWS: Final = 12
_MOST_ACTIONS: Final = 4
_MOST_STATES: Final = 5


def random_problem(seed: int, number: int) -> LinearProblem:
    """The problem of this number: two of three in mixed units, the others at scale 1."""
    random = np.random.default_rng([seed, 1, number])
    shape = shape_of(number)
    problem = SHAPES[shape](random)
    rows, states, actions = len(problem.q), len(problem.f), len(problem.low)
    problem = replace(problem, shape=shape, gradient=bool(random.integers(2)))
    if random.integers(3) == 0:
        return problem
    return problem.scaled(_units(random, rows, 9.0), _units(random, states, 6.0), _units(random, actions, 6.0))


def shape_of(number: int) -> str:
    """The name of the shape of problem ``number``."""
    return tuple(SHAPES)[number % len(SHAPES)]


def _units(random: Random, count: int, most: float) -> FloatArray:
    """(count,) factors, evenly distributed in their logarithm between 10^-most and 10^most."""
    return np.asarray(10.0 ** random.uniform(-most, most, count))


def _plain(random: Random) -> LinearProblem:
    """Everything of size 1, most h positive now, margins from none to a tenth."""
    rows, actions, states = (int(random.integers(1, most + 1)) for most in (_MOST_ROWS, _MOST_ACTIONS, _MOST_STATES))
    state, P = random.normal(size=states), random.normal(size=(rows, states))
    now = random.exponential(1.0, rows)
    low, width = random.uniform(-2.0, 0.0, actions), random.uniform(0.5, 3.0, actions)
    return LinearProblem(
        shape="plain",
        state=state,
        f=state + random.normal(0.0, 0.3, states),
        g=random.normal(0.0, 0.3, (states, actions)),
        P=P,
        q=now - P @ state,
        low=low,
        high=low + width,
        nominal=low + width * random.uniform(-0.5, 1.5, actions),
        weights=np.ones(actions),
        eta=float(random.uniform(0.05, 1.0)),
        epsilon=random.choice([0.0, 0.01, 0.1], rows),
        gradient=True,
    )


def _tight(random: Random) -> LinearProblem:
    """Hardly any room: h now is a small share of what the actions can change."""
    problem = _plain(random)
    now = random.exponential(0.05, len(problem.q))
    return replace(problem, q=now - problem.P @ problem.state, epsilon=random.choice([0.0, 0.01], len(now)))


def _boundary(random: Random) -> LinearProblem:
    """h now is 0 exactly and there is no margin: whole numbers, so that nothing is rounded."""
    rows, actions, states = (int(random.integers(1, most + 1)) for most in (_MOST_ROWS, _MOST_ACTIONS, _MOST_STATES))
    state = random.integers(-3, 4, states).astype(np.float64)
    P = random.integers(-3, 4, (rows, states)).astype(np.float64)
    drift = random.integers(-1, 2, states).astype(np.float64)
    return replace(
        _with_actions(random, actions),
        state=state,
        f=state + drift,
        g=random.integers(-2, 3, (states, actions)).astype(np.float64),
        P=P,
        q=-(P @ state),
        epsilon=np.zeros(rows),
    )


def _with_actions(random: Random, actions: int) -> LinearProblem:
    """A problem with this number of actions, of range -1 to 1; callers replace the rest."""
    nothing = np.zeros(1)
    return LinearProblem(
        shape="",
        state=nothing,
        f=nothing,
        g=np.zeros((1, actions)),
        P=np.zeros((1, 1)),
        q=nothing,
        low=-np.ones(actions),
        high=np.ones(actions),
        nominal=random.integers(-2, 3, actions) / 2.0,
        weights=np.ones(actions),
        eta=0.25,
        epsilon=nothing,
        gradient=True,
    )


def _parallel(random: Random) -> LinearProblem:
    """Rows that are nearly multiples of one another, of either sign: narrow slabs and corners far away."""
    problem = _plain(random)
    P, now = problem.P.copy(), problem.heights(problem.state)
    for row in range(1, len(P)):
        if random.integers(3):
            nudge = 10.0 ** random.uniform(-13.0, -2.0)
            sign = random.choice([-1.0, 1.0])
            P[row] = sign * random.uniform(0.5, 2.0) * (P[row - 1] + nudge * random.normal(size=P.shape[1]))
    now *= random.choice([0.01, 0.1, 1.0])
    return replace(problem, P=P, q=now - P @ problem.state)


def _degenerate(random: Random) -> LinearProblem:
    """Rows twice, rows and actions without any influence, and margins that differ between equal rows."""
    problem = _plain(random)
    P, q, g = problem.P.copy(), problem.q.copy(), problem.g.copy()
    for row in range(1, len(P)):
        what = random.integers(4)
        if what == 0:
            P[row], q[row] = P[0], q[0]
        elif what == 1:
            P[row], q[row] = 0.0, random.choice([0.0, 1.0, 0.05])
    if random.integers(2):
        g[:, int(random.integers(g.shape[1]))] = 0.0
    return replace(problem, P=P, q=q, g=g)


def _meeting(random: Random) -> LinearProblem:
    """All rows meet in one action, which alone keeps them, or nearly alone: a corner of more rows than actions."""
    problem = _plain(random)
    rows, actions = len(problem.q), len(problem.low)
    corner = problem.low + (problem.high - problem.low) * random.uniform(0.2, 0.8, actions)
    room = random.choice([0.0, 1e-12, 1e-9, 1e-6, 1e-3]) * random.uniform(0.5, 1.0, rows)
    drift = problem.P @ (problem.after(corner) - problem.state)
    now = (problem.epsilon + room - drift) / problem.eta  # h(x+) = required + room at the corner
    problem = replace(problem, epsilon=problem.epsilon + np.maximum(-now, 0.0) * problem.eta)
    now = np.maximum(now, 0.0)
    return replace(problem, q=now - problem.P @ problem.state, witness=corner if room.min() > 1e-8 else None)


def _feeble(random: Random) -> LinearProblem:
    """Actions that hardly move h: by a share of 1e-9 to 1 of it, as in a state that moves in small ticks."""
    problem = _plain(random)
    small = 10.0 ** random.uniform(-9.0, 0.0)
    drift = problem.f - problem.state
    now = problem.heights(problem.state) * random.choice([1.0, small])
    return replace(
        problem,
        g=small * problem.g,
        f=problem.state + small * drift,
        q=now - problem.P @ problem.state,
        epsilon=problem.epsilon * random.choice([0.0, small]),
    )


def _violated(random: Random) -> LinearProblem:
    """One or more h are below 0 now, from hardly to far."""
    problem = _plain(random)
    now = problem.heights(problem.state)
    below = random.uniform(size=len(now)) < random.choice([0.2, 1.0])
    below[int(random.integers(len(now)))] = True
    depth = 10.0 ** random.uniform(-9.0, 1.0, len(now))
    now = np.where(below, -depth, now)
    return replace(problem, q=now - problem.P @ problem.state)


def _whole(random: Random) -> LinearProblem:
    """Whole numbers everywhere: ties between rows, between corners and between actions."""
    problem = _boundary(random)
    now = random.integers(0, 4, len(problem.q)).astype(np.float64)
    margin = random.choice([0.0, 1.0], len(now))
    return replace(problem, q=now - problem.P @ problem.state, epsilon=margin)


def _costly(random: Random) -> LinearProblem:
    """Weights from 1e-6 to 1e6, and a nominal action up to nine ranges away."""
    problem = _plain(random)
    actions = len(problem.low)
    nominal = problem.low + (problem.high - problem.low) * random.uniform(-9.0, 9.0, actions)
    return replace(problem, weights=_units(random, actions, 6.0), nominal=nominal)


def _crowded(random: Random) -> LinearProblem:
    """Twelve rows around one action like a cage: whether anything is left within it is a matter of a hair."""
    problem = _plain(random)
    actions = len(problem.low)
    slopes = random.normal(size=(_MOST_ROWS, actions))
    slopes /= np.linalg.norm(slopes, axis=1)[:, None]
    middle, now = 0.5 * (problem.low + problem.high), random.exponential(0.5, _MOST_ROWS)
    room = random.uniform(-0.1, 0.2)  # the conditions are slopes (a - middle) + eta now - epsilon >= 0
    return replace(
        problem,
        state=np.zeros(actions),
        f=-middle,
        g=np.eye(actions),
        P=slopes,
        q=now,
        epsilon=np.maximum(problem.eta * now - room, 0.0),
    )


def _wide(random: Random) -> LinearProblem:
    """Five to eight actions and up to forty rows: more corners than can be enumerated."""
    actions, rows, states = int(random.integers(5, 9)), int(random.integers(1, 41)), int(random.integers(2, 9))
    state, P = random.normal(size=states), random.normal(size=(rows, states))
    now, middle = random.exponential(0.5, rows), random.uniform(-1.0, 1.0, actions)
    return replace(
        _with_actions(random, actions),
        state=state,
        f=state + random.normal(0.0, 0.1, states),
        g=random.normal(0.0, 0.2, (states, actions)),
        P=P,
        q=now - P @ state,
        low=middle - 1.0,
        high=middle + random.uniform(0.5, 2.0, actions),
        nominal=middle + random.uniform(-1.5, 2.5, actions),
        eta=float(random.uniform(0.05, 1.0)),
        epsilon=random.choice([0.0, 0.01], rows),
    )


SHAPES: Final[dict[str, Callable[[Random], LinearProblem]]] = {
    "plain": _plain,
    "tight": _tight,
    "boundary": _boundary,
    "parallel": _parallel,
    "degenerate": _degenerate,
    "meeting": _meeting,
    "feeble": _feeble,
    "violated": _violated,
    "whole": _whole,
    "costly": _costly,
    "crowded": _crowded,
    "wide": _wide,
}
"""By name; problem n has the (n modulo their number)-th."""
