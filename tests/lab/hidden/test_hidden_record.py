"""The record of a hidden-effects experiment: it comes back as it was, goes on where it stopped, and makes a page."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace

import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments import hidden_effects
from safedpa_lab.experiments.hidden_effects import hidden_effects_experiment
from safedpa_lab.experiments.hidden_page import page_of
from safedpa_lab.experiments.hidden_record import document_of, read_outcomes, write_document
from safedpa_lab.hidden.judge import Found, Outcome

DRAG = Outcome(
    suite="ordinary",
    case="ordinary-quadratic_drag-1",
    hidden=("quadratic_drag",),
    added=("quadratic_drag",),
    verdict="effect_missing",
    first_named=True,
    all_named=True,
    all_in_group=True,
    wrong=(),
    parameters=(Found("quadratic_drag.coefficient", 0.1208, 0.0005, 0.12),),
    error=0.011,
    error_ratio=1.02,
    seconds=9.0,
    processor_seconds=6.0,
)
ALARM = replace(
    DRAG, suite="none", case="none-nothing-2", hidden=(), added=("payload",), wrong=("payload",), parameters=(),
    error_ratio=float("nan"),
)  # fmt: skip


def test_the_record_holds_what_was_judged(tmp_path):
    path = tmp_path / "record.json"
    write_document(document_of([DRAG, ALARM], [7, 7]), path)
    document = json.loads(path.read_text())
    assert document["seeds"] == [7]
    assert {"python", "safedpa", "numpy"} <= set(document["versions"])
    assert document["date"].startswith("20")
    first, second = document["cases"]
    assert first["right"]
    assert first["parameters"][0]["deviation"] == pytest.approx(1.6)
    assert not second["right"]
    assert second["error_ratio"] is None
    outcomes, seeds = read_outcomes(path)
    assert seeds == [7]
    assert outcomes[0] == DRAG
    assert repr(outcomes[1]) == repr(ALARM)  # NaN is not equal to itself


def test_an_interrupted_experiment_goes_on(tmp_path, monkeypatch):
    asked = []

    def judged(cases):
        asked.extend(case.name for case in cases)
        return [replace(DRAG, suite=case.suite, case=case.name, hidden=tuple(case.effects)) for case in cases]

    monkeypatch.setattr(hidden_effects, "run_cases", judged)
    path = tmp_path / "record.json"
    first = hidden_effects_experiment(["ordinary"], 2, 3, processes=1, record=path)
    told = []
    more = hidden_effects_experiment(
        ["ordinary", "none"], 3, 3, processes=1, record=path, tell=lambda *counts: told.append(counts)
    )
    assert len(asked) == len(set(asked)) == 6
    assert told[-1] == (4, 4)
    names = {row["case"] for row in more["cases"]}
    assert {row["case"] for row in first["cases"]} < names
    kept = json.loads(path.read_text())
    assert kept.pop("provenance")["date"]
    assert kept == more
    assert [row["cases"] for row in more["suites"]] == [3, 3]
    again = hidden_effects_experiment(["none"], 3, 3, processes=1, record=path)
    assert again["cases"] == more["cases"]
    assert again["seeds"] == [3]


@pytest.mark.parametrize("text", ["{", "[]", '{"experiment": "car"}', '{"experiment": "hidden-effects", "cases": []}'])
def test_another_file_is_no_record(tmp_path, text):
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"other\.json.*name a new file"):
        hidden_effects_experiment(["none"], 1, processes=1, record=path)
    assert path.read_text() == text


def test_the_page_has_every_figure():
    page = page_of(document_of([DRAG, ALARM], [7]))
    rows = [line for line in page.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in rows[:4]}) == 1
    suite = [cell.strip() for cell in next(line for line in rows if line.startswith("| ordinary")).split("|")[1:-1]]
    assert suite[:7] == ["ordinary", "1", "100", "21 to 100", "100", "100", "0"]
    assert suite[7:] == ["0", "100", "1.020", "1.020", "100", "9.0", "9.0", "6.0", "6.0"]
    assert "- `none-nothing-2`: hidden nothing; effect_missing, added payload" in page
    assert re.search(r"^2 cases, seeds 7; finished 20\d\d-", page, re.MULTILINE), page


@pytest.mark.parametrize("cases", [[DRAG], [ALARM, DRAG, DRAG], [DRAG, ALARM, ALARM, DRAG]])
def test_the_cases_of_the_page_are_those_of_its_suites_and_of_its_list(cases):
    document = document_of([replace(case, case=f"{case.case}{at}") for at, case in enumerate(cases)], [7])
    page = page_of(document)
    assert int(re.search(r"^(\d+) cases", page, re.MULTILINE)[1]) == len(cases)
    begun = page[page.index("## By suite") : page.index("## By effect") if "## By effect" in page else None]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in begun.splitlines() if line.startswith("|")]
    told = {row[0]: int(row[1]) for row in rows[2:]}
    assert {name: told[name] for name in {case.suite for case in cases}} == Counter(case.suite for case in cases)
    wrong = sum(case.suite == "none" for case in cases)
    assert page.partition("## Missed")[2].count("\n- `") == wrong


def test_a_page_without_a_miss_says_none():
    assert page_of(document_of([DRAG], [7])).endswith("\n\nNone.\n")
