"""The page of a campaign."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from safedpa.errors import InputError
from safedpa_lab.faults.outcome import Campaign, Outcome, joined
from safedpa_lab.faults.report import markdown_of, write_report


def outcome(name: str, *broken: str, recovery: float | None = 0.5) -> Outcome:
    return Outcome(
        name=name, sentence=f"{name} happens", held=not broken, broken=broken, speed=1.2, collisions=0, stale_actions=0,
        periods=40, watchdog=10, fallbacks=2, recovery_seconds=recovery, whole_seconds=0.7, states_not_recorded=3,
        verdicts_not_recorded=1,
    )  # fmt: skip


def campaign(*outcomes: Outcome, collisions: int = 0, recorded: int = 90) -> Campaign:
    return Campaign(outcomes, 80, collisions, 0, acknowledged=85, recorded=recorded)


def result(found: Campaign) -> dict[str, Any]:
    about = {"command": "safedpa experiment faults", "date": "2026-11-21", "seconds": 9.0, "cores": 2}
    load = {"load_before": 1.0, "load_after": 2.0}
    return {**asdict(found), **about, **load, "rows": [asdict(one) for one in found.outcomes]}


def test_the_page_names_every_fault_its_kind_and_what_did_not_hold() -> None:
    faults = (
        outcome("kill policy"),
        outcome("kill robot", "2 collisions", recovery=None),
        outcome("change-take policy"),
        outcome("change-ready policy", "mixed"),
    )
    page = markdown_of(result(campaign(*faults)))
    assert "**2 of 4 held; 0 collisions, 0 stale actions in 80 periods" in page
    assert "| kill | 2 | 1 | 25%, 5% | 0.50, 1 never | 0.70 to 0.70 |" in page
    assert "| change | 2 | 1 | 25%, 5% | 0.50 to 0.50 | 0.70 to 0.70 |" in page, "whatever the moment of the change"
    assert "| kill robot | kill robot happens | **no** |" in page
    assert "- kill robot: 2 collisions" in page
    for line in page.splitlines():
        if line.startswith("| kill robot"):
            assert line.count("|") == 13


@pytest.mark.parametrize(
    ("found", "held"),
    [
        (campaign(outcome("kill policy")), True),
        (campaign(outcome("kill policy", "slow")), False),
        (campaign(outcome("kill policy"), collisions=1), False),
        (campaign(outcome("kill policy"), recorded=84), False),
        (campaign(outcome("kill policy"), recorded=85), True),
        (replace(campaign(outcome("kill policy")), stale_actions=1), False),
        (campaign(outcome("kill policy"), outcome("kill robot", "slow")), False),
        (joined([campaign(outcome("kill policy")), campaign(outcome("kill robot"), collisions=1)]), False),
    ],
)
def test_a_campaign_holds_only_if_everything_held_between_the_faults_too(found: Campaign, held: bool) -> None:
    assert found.held is held


def test_several_fleets_are_added_up() -> None:
    one, other = Campaign((outcome("a"),), 1, 2, 3, 4, 5), Campaign((outcome("b"), outcome("c")), 10, 20, 30, 40, 50)
    assert joined([one, other, one]) == Campaign((*one.outcomes, *other.outcomes, *one.outcomes), 12, 24, 36, 48, 60)
    assert joined([]) == Campaign((), 0, 0, 0, 0, 0)


def test_the_report_is_two_files_or_one_line_of_complaint(tmp_path: Path) -> None:
    told = result(campaign(outcome("kill policy")))
    write_report(told, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "faults.json").read_text())["rows"][0]["name"] == "kill policy"
    assert (tmp_path / "out" / "faults.md").read_text() == markdown_of(told)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out"):
        write_report(told, tmp_path / "file")
