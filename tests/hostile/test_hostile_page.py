"""The command's drives: what counts as holding, and the page that is written."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from safedpa.errors import InputError
from safedpa_lab.benchmarks.hostile import offered, silent
from safedpa_lab.benchmarks.hostile.offering import FREEZES, costly_model
from safedpa_lab.benchmarks.hostile.offers import account_of_offers
from safedpa_lab.benchmarks.hostile.page import write_page
from safedpa_lab.benchmarks.reference import held_up_seconds
from safedpa_services.command_line.group import safedpa

ABOUT = {"held": True, "date": "2026-11-23 00:00", "cores": 2, "load_average": [1.0, 2.0]}


def _account(tmp_path: Path, after: float | None = 0.004, state: str = "refused") -> dict[str, Any]:
    answer = {"offer": FREEZES, "service": "policy", "state": state, "reason": "r", "seconds": 0.02}
    chain = {"state": 5.96, "latent": 5.965, "action": 6.01}
    seen = {
        "windows": [[5.0, 10.0], [15.0, 25.0]],
        "offers": 9,
        "refusals": [{**answer, "after_state_seconds": after}],
        "chains": {"r1 3": chain},
    }
    file = tmp_path / "offers.json"
    file.write_text(json.dumps(seen), encoding="utf-8")
    moments = {
        "counted": [0.0, 20.0],
        "late": [[6.0, "r1", 3], [11.0, "r1", 9], [16.0, "r2", 4]],
        "acted": [[1.0, 0.002], [6.0, 0.003]],
    }
    references = [tmp_path / "0.json", tmp_path / "1.json"]
    references[0].write_text(json.dumps({"core": 0, "gaps": [[4.0, 4.5], [15.9, 15.97], [15.98, 16.2]]}))
    references[1].write_text(json.dumps({"core": 1, "gaps": [[10.97, 10.99]]}))
    return account_of_offers(file, moments, 160.0, references)


def test_late_ticks_are_counted_where_they_belong(tmp_path: Path) -> None:
    found = _account(tmp_path)
    assert (found["under_attack"]["seconds"], found["in_peace"]["seconds"]) == (10.0, 10.0)
    assert (found["under_attack"]["late_ticks"], found["in_peace"]["late_ticks"]) == (2, 1)
    assert found["under_attack"]["sense_to_act_ms"]["most"] == 3.0
    assert found["answers"][FREEZES]["after_state_ms"]["p50"] == 4.0


def test_delays_of_the_machine_are_reported_separately(tmp_path: Path) -> None:
    """A core without its reference loop for half the period of a late tick; 20 ms of 50 are not enough."""
    found = _account(tmp_path)
    assert [one["machine_held_up_ms"] for one in found["late"]] == [0.0, 20.0, 40.0]
    assert (found["under_attack"]["late_by_the_machine"], found["in_peace"]["late_by_the_machine"]) == (1, 0)
    assert found["late"][0]["seen_ms"] == {"state": 0.0, "latent": 5.0, "action": 50.0}


def test_a_reference_loop_sees_that_its_core_was_taken(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "safedpa_lab.benchmarks.reference", "--core", str(min(os.sched_getaffinity(0)))]
    process = subprocess.Popen([*command, "--account", str(tmp_path / "seen.json")])
    until = time.monotonic() + 60.0
    while not _hears(process.pid, signal.SIGTERM) and time.monotonic() < until:
        time.sleep(0.02)
    taken = []
    for _ in range(3):  # at the first attempt it may not have reached its loop yet
        time.sleep(0.1)
        process.send_signal(signal.SIGSTOP)
        stopped = time.monotonic()
        time.sleep(0.2)
        taken.append((stopped, time.monotonic()))
        process.send_signal(signal.SIGCONT)
    process.terminate()
    assert process.wait(60.0) == 0
    gaps = json.loads((tmp_path / "seen.json").read_text(encoding="utf-8"))["gaps"]
    assert max(held_up_seconds(gaps, *times) for times in taken) > 0.15


def _hears(process: int, number: int) -> bool:
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


@pytest.mark.parametrize(
    ("after", "state", "late", "held"),
    [
        (0.004, "refused", 1, True), (0.013, "refused", 1, False), (None, "refused", 1, False),
        (0.004, "ready", 1, False), (0.004, "refused", 3, False),
    ],
)  # fmt: skip
def test_what_counts_as_holding(tmp_path, monkeypatch, after, state, late, held):
    found = _account(tmp_path, after, state)
    found["under_attack"].update(late_ticks=late, late_by_the_machine=0)
    monkeypatch.setattr(offered, "fleet_benchmark", lambda trial, report_progress: {"offers": found, "collisions": 0})
    assert offered.offers_benchmark(20.0)["held"] is held


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
    older = json.loads((tmp_path / "hostile.json").read_text(encoding="utf-8"))
    del older["offers"]["offers"]["in_peace"]["late_by_the_machine"]
    (tmp_path / "hostile.json").write_text(json.dumps(older), encoding="utf-8")
    write_page(tmp_path, "mutations", {**ABOUT, "command": "one", "targets": [target]})
    assert "| in peace | 10.0 | 1600 | 1 | - |" in (tmp_path / "hostile.md").read_text(encoding="utf-8")
    (tmp_path / "hostile.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match="--page"):
        write_page(tmp_path, "mutations", ABOUT)


def test_an_attack_that_did_not_hold_ends_with_code_1(monkeypatch, capsys):
    drive = {
        "exit_code": 1, "ticks": 3, "watchdog_ticks": 3, "restarts": 1, "joins": 0, "slowest_join_seconds": None,
        "collisions": 0,
    }  # fmt: skip
    account = {**ABOUT, "held": False, "in_peace": drive, "under_attack": drive}
    monkeypatch.setattr(silent, "silent_benchmark", lambda *_, **__: account)
    assert safedpa.run(["experiment", "hostile", "--attack", "silent"]) == 1
    notice = capsys.readouterr()
    assert "| under attack | 1 | 3 |" in notice.out
    assert "did not hold" in notice.err
