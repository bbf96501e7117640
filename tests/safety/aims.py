"""One question to the search for the least-violation action: h as a plain function of the action."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.safety import Barriers, FunctionBarrier, Prediction, QuadraticProgram
from safedpa.safety.solver.candidates import action_grid
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa.safety.solver.least_violation import least_violation
from safedpa.safety.solver.maximin_lp import MaxMinProgram

Values = NDArray[np.float64]


class Counted:
    """A program that counts how often it is asked."""

    def __init__(self, program: Any) -> None:
        self._program, self.solved = program, 0

    def solve(self, *arguments: Any) -> Any:
        """What the program says."""
        self.solved += 1
        return self._program.solve(*arguments)


class Case:
    """h(a) (rows,) of actions within -1 and 1, at a state whose h are ``now``; the state is a itself."""

    def __init__(
        self, h: Callable[[Values], Sequence[float]], now: Sequence[float], nominal: Sequence[float], *,
        eta: float = 1.0, epsilon: float = 0.0, limit: float = 1.0, affine: bool = True,
        backup: Sequence[float] | None = None, program: Any = None, highest: Any = None,
    ) -> None:  # fmt: skip
        self.h, self.nominal, actions = h, tuple(nominal), len(nominal)
        self.affine, self.resting, self.stuck = affine, backup, ("not run",)
        self.asked: list[tuple[float, ...]] = []
        start = (9.0,) * actions

        def heights(x: Values) -> Sequence[float]:
            if tuple(x) == start:
                return now
            return h(x)

        names = tuple(f"h{row}" for row in range(len(now)))
        low, high = np.full(actions, -limit), np.full(actions, limit)
        self.program = QuadraticProgram(low, high, np.ones(actions)) if program is None else program
        self.highest = MaxMinProgram(actions) if highest is None else highest
        self.sides = QuadraticProgram(low, high, np.ones(actions)).sides
        self.conditions = Constraints(
            Barriers([FunctionBarrier(heights, names=names)]), self._prediction(), start, None, None, eta,
            [epsilon] * len(now), self.sides,
        )  # fmt: skip

    def _prediction(self) -> Prediction:
        eye = np.eye(len(self.nominal))
        prediction = Prediction(lambda x, around: (0.0 * eye[0], eye), self._step)
        prediction.affine = self.affine
        return prediction

    def _step(self, state: Values, action: Values) -> Values:
        self.asked.append(tuple(action.tolist()))
        return action

    @property
    def backup(self) -> ActionCandidate:
        return self.conditions.evaluate(tuple(self.nominal if self.resting is None else self.resting))

    def run(self, *known: Sequence[float]) -> ActionCandidate:
        begun = [self.conditions.evaluate(tuple(action)) for action in known or [self.nominal]]
        spread = [self.conditions.evaluate(action) for action in action_grid(self.sides, affine=self.affine)]
        known = [*begun, *spread]
        found, self.stuck = least_violation(
            self.conditions, self.program, self.highest, self.nominal, self.backup, known
        )
        return found
