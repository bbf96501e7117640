"""The reference's linear program survives a solver that gives up."""

import pytest
import scipy.optimize
from tests.lab.adversary.problems import plane

from safedpa_lab.experiments.adversary.linear.judge import LinearJudge


def test_another_way_answers_if_the_first_solver_ends_in_an_unknown_status(monkeypatch: pytest.MonkeyPatch) -> None:
    """HiGHS once ended a program of a hundred thousand in a status that it does not know."""
    asked, solve = [], scipy.optimize.linprog

    def gives_up_once(*args, **options):
        asked.append(options["method"])
        found = solve(*args, **options)
        if len(asked) == 1:
            found.x = None
        return found

    monkeypatch.setattr(scipy.optimize, "linprog", gives_up_once)
    assert LinearJudge(plane(0.5, 0.5)).best_least_height()[0] == pytest.approx(0.75)
    assert len(set(asked)) == len(asked) == 2
