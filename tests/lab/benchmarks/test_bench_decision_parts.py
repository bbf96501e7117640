"""The parts of a decision that are timed are those that it consists of."""

from __future__ import annotations

import pytest

from safedpa.dynamics import load_model
from safedpa.safety import Status, Verdict
from safedpa.safety.conditions import Conditions, Outcome
from safedpa.safety.decision import Decision
from safedpa_lab.benchmarks.filter_decisions import MODELS
from safedpa_lab.benchmarks.filter_problem import problem_with
from safedpa_lab.benchmarks.results import Effort
from safedpa_lab.benchmarks.rows.decision_parts import WHOLE, measure, parts


@pytest.mark.parametrize("name", MODELS)
def test_parts_are_of_the_decisions_that_are_timed_as_a_whole(name: str) -> None:
    found = parts(problem_with(8), load_model(name))
    requests = found[WHOLE][1]
    assert {len(inputs) for _, inputs in found.values()} == {len(requests)}
    for index in range(0, len(requests), 9):
        each = {part: call(inputs[index]) for part, (call, inputs) in found.items()}
        whole = each[WHOLE]
        assert isinstance(whole, Verdict)
        assert whole.status is Status.corrected
        assert isinstance(each["inputs"], Decision)
        assert isinstance(each["the conditions at the state"], Conditions)
        assert isinstance(each["an outcome"], Outcome)
        assert not each["an outcome"].kept
        assert each["the search"].__class__ is tuple
        assert each["back towards the wish"].kept
        assert each["the verdict"].h_now == whole.h_now
        assert each["the program"].solved
    assert ("the networks, within the conditions" in found) == (name == "car_learned")


def test_every_part_of_either_model_has_its_line() -> None:
    row = measure(Effort(quick=True))
    assert {entry.problem for entry in row.ours} == set(MODELS.values())
    assert len(row.ours) == 2 * 9 + 1
    assert all(0.0 < entry.figures["p50"] <= entry.figures["p999"] for entry in row.ours)
