"""Laws for which much speaks in few places: a carpet that few runs saw, one border told as three effects."""

from __future__ import annotations

import pytest

from safedpa_lab.experiments.diagnosing import diagnosed
from safedpa_lab.hidden import cases_of, write_case

pytestmark = pytest.mark.long


def told(suite, number, seed, folder):
    case = cases_of(suite, number + 1, seed)[number]
    log = write_case(case, folder)
    return case, diagnosed(log.model, log.runs)


def number_of(suite, seed, name):
    return next(index for index, case in enumerate(cases_of(suite, 10, seed)) if case.name.endswith(name))


@pytest.mark.parametrize(
    ("suite", "seed", "name"),
    [("patches", 7003, "2739099046"), ("speed_gains", 7002, "3890390788")],
    ids=["carpet_of_three_runs", "border_told_as_three_effects"],
)
def test_the_law_is_told_and_nothing_else(suite, seed, name, tmp_path):
    case, document = told(suite, number_of(suite, seed, name), seed, tmp_path)
    (effect,) = case.effects
    assert document["added"] == [effect]
    (condition,) = document["conditions"]
    assert condition["words"] == case.laws[effect].removeprefix("where ")
    for path, value in case.effects[effect].items():
        assert document["parameters"][f"{effect}.{path}"]["value"] == pytest.approx(value, rel=0.1, abs=0.1)
