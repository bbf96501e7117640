"""How two answers to one problem are compared: only the comparison itself takes two verdicts."""

import pytest
from tests.lab.adversary.problems import plane, verdict

from safedpa_lab.experiments.adversary.mirrors import _alongside


@pytest.mark.parametrize(
    ("statuses", "action", "apart", "same"),
    [(("passed", "corrected"), (0.5, 0.5), 0.25, False), (("corrected", "corrected"), (0.0, 1.0), 0.5, False),
     (("passed", "passed"), (1.0, 0.0), 0.25, False), (("passed", "passed"), (0.0, 0.0), 0.0, True),
     (("relaxed", "violated"), (0.0, 0.0), 0.0, False), (("relaxed", "relaxed"), (0.0, 0.0), 0.0, True)],
)  # fmt: skip
def test_two_answers_are_apart_by_the_root_of_the_weight(statuses, action, apart, same):
    """Weights of 1 and 4, of which the largest counts as one: 0.25 and 1; ranges of 2."""
    problem = plane(1.0, 1.0, weights=(1.0, 4.0))
    one, other = verdict(statuses[0], (0.0, 0.0)), verdict(statuses[1], action)
    found = _alongside("a", 1, problem, one, other, lambda value: value)
    assert found.apart == pytest.approx(apart)
    assert found.same is same
