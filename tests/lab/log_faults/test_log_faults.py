"""A drive is written with each fault of the matrix; what is read of it is compared with the drive."""

from pathlib import Path

import pytest

from safedpa_lab.log_faults.experiment import report, run
from safedpa_lab.log_faults.faults import FAULTS, FORMS, Fault
from safedpa_lab.log_faults.judge import read_spoilt

_MOST_LOST = 0.02
"""Share of the undamaged rows."""


def test_the_matrix_has_its_kinds_and_says_what_each_means_in_each_format() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) == 41
    assert {form for fault in FAULTS for form in fault.forms} == set(FORMS)
    assert all(
        (fault.meaning_in(form) == "cannot occur") == (form not in fault.forms) for fault in FAULTS for form in FORMS
    )


@pytest.mark.parametrize("form", FORMS)
def test_an_intact_log_is_read_whole_without_a_finding(form: str, tmp_path: Path) -> None:
    score = read_spoilt(None, form, 1, tmp_path)
    assert (score.wrong, score.lost, score.surplus, score.refused) == (0, 0.0, 0, "")


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_no_fault_pairs_a_row_wrongly_or_is_silent(fault: Fault, tmp_path: Path) -> None:
    for form in fault.forms:
        score = read_spoilt(fault, form, 3, tmp_path)
        assert (score.wrong, score.crashed) == (0, False), form
        assert score.reported or score.refused, form
        assert score.lost <= _MOST_LOST, (form, score)


def test_the_experiment_counts_each_fault_and_format() -> None:
    options = {"faults": ("gap",), "formats": ("csv", "ulg"), "seeds": 2, "first_seed": 0, "processes": 1}
    result = run(options, lambda done, everything: None)
    assert [(row["fault"], row["format"], row["logs"]) for row in result["rows"]] == [
        ("gap", "csv", 2),
        ("gap", "ulg", 2),
    ]
    assert result["totals"]["wrong_rows"] == 0
    assert "| gap | ulg | 1.5 s without messages | 2 | 0 |" in report(result)
