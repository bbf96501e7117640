"""The command's drives: what counts as holding, and the page that is written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from safedpa.errors import InputError
from safedpa_lab.benchmarks.hostile import offered
from safedpa_lab.benchmarks.hostile.floods import _longest
from safedpa_lab.benchmarks.hostile.offering import FREEZES, costly_model
from safedpa_lab.benchmarks.hostile.offers import account_of_offers
from safedpa_lab.benchmarks.hostile.page import write_page
from safedpa_lab.commands.experiments import hostile
from safedpa_services.command_line.group import safedpa

ABOUT = {"held": True, "date": "2026-11-23 00:00", "cores": 2, "load_average": [1.0, 2.0]}


def _account(tmp_path: Path, after: float | None = 0.004, state: str = "refused") -> dict[str, Any]:
    answer = {"offer": FREEZES, "service": "policy", "state": state, "reason": "r", "seconds": 0.02}
    seen = {"windows": [[5.0, 10.0], [15.0, 25.0]], "offers": 9, "refusals": [{**answer, "after_state_seconds": after}]}
    file = tmp_path / "offers.json"
    file.write_text(json.dumps(seen), encoding="utf-8")
    moments = {"counted": [0.0, 20.0], "late_at": [6.0, 11.0, 16.0], "acted": [[1.0, 0.002], [6.0, 0.003]]}
    return account_of_offers(file, moments, 160.0)


def test_late_ticks_are_counted_where_they_belong(tmp_path: Path) -> None:
    found = _account(tmp_path)
    assert (found["under_attack"]["seconds"], found["in_peace"]["seconds"]) == (10.0, 10.0)
    assert (found["under_attack"]["late_ticks"], found["in_peace"]["late_ticks"]) == (2, 1)
    assert found["under_attack"]["sense_to_act_ms"]["most"] == 3.0
    assert found["answers"][FREEZES]["after_state_ms"]["p50"] == 4.0


@pytest.mark.parametrize(
    ("after", "state", "late", "held"),
    [
        (0.004, "refused", 1, True), (0.013, "refused", 1, False), (None, "refused", 1, False),
        (0.004, "ready", 1, False), (0.004, "refused", 3, False),
    ],
)  # fmt: skip
def test_what_counts_as_holding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: float | None, state: str, late: int, held: bool
) -> None:
    found = _account(tmp_path, after, state)
    found["under_attack"]["late_ticks"] = late
    monkeypatch.setattr(offered, "fleet_benchmark", lambda trial, tell: {"offers": found, "collisions": 0})
    assert offered.offers_benchmark(20.0)["held"] is held


def test_the_longest_stretch_of_braking() -> None:
    assert _longest([]) == 0.0
    assert _longest([1.0]) == 0.05
    assert _longest([1.0, 1.05, 1.10, 2.0, 2.05]) == 0.15


def test_the_model_that_is_long_to_try_can_be_read() -> None:
    assert costly_model().count("[[effects]]") > 15


def test_each_attack_keeps_its_place_on_the_page(tmp_path: Path) -> None:
    target = {"target": "key", "inputs": 3, "refused": 2, "worst_ms": 0.1, "holes": []}
    write_page(tmp_path, "mutations", {**ABOUT, "command": "one", "targets": [target]})
    write_page(tmp_path, "offers", {**ABOUT, "held": False, "command": "two", "offers": _account(tmp_path)})
    page = (tmp_path / "hostile.md").read_text(encoding="utf-8")
    assert "| key | 3 | 2 | 0.1 | 0 |" in page
    assert "did not hold" in page
    assert page.index("`two`") < page.index("`one`")
    (tmp_path / "hostile.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match="--page"):
        write_page(tmp_path, "mutations", ABOUT)


def test_an_attack_that_did_not_hold_ends_with_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = {
        "exit_code": 1, "ticks": 3, "watchdog_ticks": 3, "restarts": 1, "joins": 0, "slowest_join_seconds": None,
        "collisions": 0,
    }  # fmt: skip
    monkeypatch.setattr(
        hostile, "_attacked", lambda *_: {**ABOUT, "held": False, "in_peace": drive, "under_attack": drive}
    )
    assert safedpa.run(["experiment", "hostile", "--attack", "silent"]) == 1
    said = capsys.readouterr()
    assert "under attack  exit code 1, 3 ticks" in said.out
    assert "did not hold" in said.err
