"""What a long run says of its processes: made-up looks, and quarters and medians that one finds by hand."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.errors import InputError
from safedpa_lab.commands.experiments.faults import command
from safedpa_lab.faults.endurance import Kept, Resources, Sample, kept_by
from safedpa_lab.faults.member import Member
from safedpa_lab.faults.report import markdown_of
from safedpa_lab.faults.table import all_faults, faults_for

pytestmark = pytest.mark.filterwarnings("error")


def life(name: str, pid: int, begin: float, mib: list[float], handles: int = 9) -> list[Sample]:
    """Of one process, seen every 10 s."""
    return [Sample(begin + 10.0 * i, name, pid, one, handles, 4) for i, one in enumerate(mib)]


def test_the_first_half_minute_of_a_life_is_left_out() -> None:
    (kept,) = kept_by(life("policy", 7, 100.0, [10.0, 20.0, 30.0, 50.0, 50.0, 52.0, 60.0]))
    assert kept == Kept("policy", 1, 60.0, (50.0, 60.0), (9, 9), (4, 4)), "looks at 130, 140, 150 and 160 s"


def test_quarters_are_of_the_time_and_not_of_the_lives() -> None:
    first = life("policy", 7, 0.0, [0.0, 0.0, 0.0, 40.0, 42.0, 44.0])
    second = life("policy", 8, 100.0, [0.0, 0.0, 0.0, 70.0, 80.0, 90.0], handles=30)
    (kept,) = kept_by([*first, *second])
    # warm looks at 30, 40, 50, 130, 140, 150 s: quarters of 30 s
    assert kept == Kept("policy", 2, 50.0, (42.0, 80.0), (9, 30), (4, 4))


def test_who_never_lived_for_half_a_minute_is_not_there_and_names_are_in_order() -> None:
    samples = [
        *life("robot", 3, 0.0, [5.0] * 4),
        *life("policy", 7, 0.0, [5.0] * 4),
        *life("adaptation", 8, 0.0, [5.0]),
    ]
    assert [kept.name for kept in kept_by(samples)] == ["policy", "robot"]


def test_the_number_of_another_process_that_comes_again_makes_nobody_older() -> None:
    samples = [*life("policy", 7, 0.0, [5.0] * 4), *life("robot", 7, 100.0, [1.0, 1.0, 1.0, 8.0])]
    policy, robot = kept_by(samples)
    assert (policy.name, robot.name) == ("policy", "robot")
    assert robot == Kept("robot", 1, 30.0, (8.0, 8.0), (9, 9), (4, 4))


@pytest.mark.parametrize(
    ("mib", "handles", "flat"),
    [
        ((100.0, 124.0), (20, 20), True),
        ((100.0, 126.0), (20, 20), False),
        ((20.0, 35.0), (20, 20), True),  # three quarters more, but 15 MiB
        ((20.0, 37.0), (20, 20), False),
        ((100.0, 50.0), (20, 36), True),
        ((100.0, 50.0), (20, 37), False),
    ],
)
def test_what_has_grown_is_told(mib: tuple[float, float], handles: tuple[int, int], flat: bool) -> None:
    assert Kept("policy", 1, 600.0, mib, handles, (4, 4)).flat is flat


def test_a_look_finds_this_process_and_no_other() -> None:
    resources = Resources(lambda: 12.5)
    with open(os.devnull, "rb") as one, open(os.devnull, "rb") as another:
        resources.look({"here": os.getpid(), "never started": 0, "gone": 2**22 + 1})
        del one, another
    resources.look({"here": os.getpid()})
    more, fewer = resources.samples
    assert (more.at, more.name, more.pid) == (12.5, "here", os.getpid())
    assert more.handles == fewer.handles + 2
    assert more.resident_mib > 10.0
    assert more.threads >= 1


def test_processes_are_looked_at_until_the_fleet_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("safedpa_lab.faults.endurance._EVERY_SECONDS", 0.01)
    resources = Resources()
    world: Any = SimpleNamespace(members={"here": SimpleNamespace(pid=os.getpid())})
    with resources.beside(world):
        for _ in range(500):
            time.sleep(0.01)
            if len(resources.samples) >= 3:
                break
    count = len(resources.samples)
    assert count >= 3
    time.sleep(0.05)
    assert {sample.name for sample in resources.samples} == {"here"}
    assert len(resources.samples) == count


def test_an_hour_of_faults_comes_in_rounds_of_all_that_one_fleet_can_suffer() -> None:
    once = {fault.name for fault in all_faults() if fault.diagnosis == "real"}
    faults = [fault.name for fault in faults_for(3600.0, seed=3)]
    assert len(faults) >= 1440, "at 2.5 s each"
    rounds = [faults[i : i + len(once)] for i in range(0, len(faults), len(once))]
    assert all(set(one) == once for one in rounds)
    assert rounds[0] != rounds[1]
    assert faults == [fault.name for fault in faults_for(3600.0, seed=3)]
    assert faults != [fault.name for fault in faults_for(3600.0, seed=4)]


def test_the_page_of_a_long_run_has_a_row_for_each_process() -> None:
    rows = [_row("kill policy", 0.4), _row("kill robot", 0.9), _row("stop policy", 0.1)]
    kept = {"name": "policy", "processes": 3, "longest_life_seconds": 612.4, "mib": (50.0, 90.0)}
    page = markdown_of(
        {
            "command": "safedpa experiment faults --minutes 60 --seed 3", "date": "2026-11-27 14:20", "seconds": 3600.0,
            "cores": 2, "load_before": 1.0, "load_after": 2.0, "collisions": 0, "stale_actions": 0, "periods": 72000,
            "acknowledged": 5, "recorded": 6, "rows": rows,
            "resources": [kept | {"handles": (9, 30), "threads": (4, 5), "flat": False}],
        }
    )  # fmt: skip
    assert "| policy | 3 | 612 | 50.0 to 90.0 | 9 to 30 | 4 to 5 | **grew** |" in page
    assert "| kill | 2 | 2 | 0%, 0% | 0.40 to 0.90 | 1.00 to 1.00 |" in page
    assert "kill policy" not in page, "of hundreds of faults only those that did not hold are told one by one"


def _row(name: str, recovery: float) -> dict[str, Any]:
    zero = dict.fromkeys(
        ("collisions", "stale_actions", "watchdog", "fallbacks", "states_not_recorded", "verdicts_not_recorded"), 0
    )
    return zero | {
        "name": name, "sentence": "", "held": True, "broken": (), "speed": 1.0, "periods": 60,
        "recovery_seconds": recovery, "whole_seconds": 1.0,
    }  # fmt: skip


def test_of_a_process_that_is_gone_the_fate_and_the_last_words_are_told(tmp_path: Path) -> None:
    member = Member("policy", "http.server", ("--bind", "nowhere.invalid", "0"), tmp_path / "policy.log")
    assert member.fate() == "its process lives", "it was not started, and did not end"
    member.start()
    process = member._process
    assert process is not None
    process.wait(20.0)
    assert member.fate().startswith("its process ended with 1: ")
    member.restart()
    member.kill()
    assert member.fate().startswith("its process ended with -9: ")


@pytest.mark.parametrize("minutes", ["nan", "inf", "1441"])
def test_a_time_without_an_end_is_refused(minutes: str) -> None:
    with pytest.raises(InputError, match=r"--minutes: got .*, wanted 1440 at most"):
        command.main(["--minutes", minutes], standalone_mode=False)
