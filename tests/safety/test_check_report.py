"""What a check says: the worst first, and no more of it than a person reads."""

from __future__ import annotations

import pytest

from safedpa.safety.check_report import FilterIssue, FilterReport, gathered, shown

NAMES = ("a", "b", "c", "d", "e", "f")


def test_the_worst_is_named_first_and_gives_its_sentence() -> None:
    cases = {0: (1.0, "slightly"), 3: (7.0, "badly"), 5: (2.0, "somewhat")}
    assert gathered("scale", NAMES, cases) == [FilterIssue("scale", ("d", "f", "a"), "badly")]
    assert gathered("scale", NAMES, {}) == []


@pytest.mark.parametrize(
    ("count", "said"),
    [(0, "scale: x"), (1, "scale (a): x"), (4, "scale (a, b, c, d): x"), (5, "scale (a, b, c, d, ...): x")],
)
def test_four_names_are_said_and_that_there_are_more(count: int, said: str) -> None:
    assert str(FilterIssue("scale", NAMES[:count], "x")) == said


def test_a_report_is_its_issues() -> None:
    issues = [FilterIssue("scale", (), "x"), FilterIssue("margin", ("a",), "y")]
    report = FilterReport(issues, 7)
    assert (list(report), len(report), report[1], report[:1]) == (issues, 2, issues[1], (issues[0],))
    assert (report.subjects, str(report)) == ({"scale", "margin"}, "- scale: x\n- margin (a): y")
    assert not FilterReport([], 7)
    assert str(FilterReport([], 7)) == "Nothing amiss at 7 states."
    assert shown([1.0, -0.123456]) == "[1, -0.1235]"
