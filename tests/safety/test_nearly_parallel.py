"""Constraints that are nearly parallel, of three or four actions: what can be satisfied together is satisfied."""

import numpy as np
import pytest
from scipy.optimize import linprog

from safedpa_lab.experiments.adversary.linear.problem import LinearProblem


def nearly_parallel(seed: int, number: int) -> LinearProblem:
    """Rows that are multiples of one another but for a share of 1e-9 to 0.1, and an action that satisfies all of them
    with a room of 1e-8 to 1e-3 of their reach."""
    random = np.random.default_rng([seed, number])
    actions = int(random.integers(3, 5))
    rows, base = int(random.integers(actions, 2 * actions + 1)), random.normal(size=actions)
    nudge = 10.0 ** random.uniform((-9.0, -4.0)[number % 2], (-3.0, -1.0)[number % 2], (rows, 1))
    near = base + nudge * random.normal(size=(rows, actions))
    P = random.choice([-1.0, 1.0], (rows, 1)) * random.uniform(0.5, 2.0, (rows, 1)) * near
    witness, state, eta = random.uniform(-0.9, 0.9, actions), random.normal(size=actions), 0.2
    room = 10.0 ** random.uniform(-8.0, -3.0, rows) * np.abs(0.3 * P).sum(axis=1)
    now = (room - 0.3 * P @ witness) / eta
    above = np.where(now < 0.0, 0.01 - now, 0.0)
    return LinearProblem(
        shape="nearly parallel", state=state, f=state, g=0.3 * np.eye(actions), P=P, q=now + above - P @ state,
        low=-np.ones(actions), high=np.ones(actions), nominal=random.uniform(-1.5, 1.5, actions),
        weights=np.ones(actions), eta=eta, epsilon=eta * above, gradient=True, witness=witness,
    )  # fmt: skip


def most_room(problem: LinearProblem) -> float:
    """The largest share of its reach by which one action satisfies every row, by an independent linear program."""
    A, rest = (
        problem.P @ problem.g,
        problem.heights(problem.f) - ((1.0 - problem.eta) * problem.heights(problem.state) + problem.epsilon),
    )
    reach, count = np.abs(A).sum(axis=1), len(problem.low)
    found = linprog(
        [*[0.0] * count, -1.0], A_ub=np.c_[-A / reach[:, None], np.ones(len(rest))], b_ub=rest / reach,
        bounds=[*zip(problem.low, problem.high, strict=True), (None, 1.0)], method="highs",
    )  # fmt: skip
    return float(found.x[-1])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 4))])
def test_no_verdict_is_relaxed_where_an_action_satisfies_every_nearly_parallel_constraint(seed: int) -> None:
    problems = [nearly_parallel(seed, number) for number in range(250)]
    statuses = [problem.decide().status.value for problem in problems]
    missed = [
        problem for problem, status in zip(problems, statuses, strict=True) if status not in ("passed", "corrected")
    ]
    assert [problem for problem in missed if most_room(problem) > 1e-8] == []
    assert statuses.count("corrected") > 100
