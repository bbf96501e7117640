"""What a long run reports about its processes, and how many faults it has."""

from __future__ import annotations

import os
import threading
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


def life(name: str, pid: int, begin: float, mib: list[float], handles: int = 9) -> list[Sample]:
    """Of one process, seen every 10 s."""
    return [Sample(begin + 10.0 * i, name, pid, one, handles, 4) for i, one in enumerate(mib)]


@pytest.mark.parametrize(
    ("samples", "kept"),
    [
        # the first half minute of a life is left out: samples at 130, 140, 150 and 160 s
        (life("policy", 7, 100.0, [10.0, 20.0, 30.0, 50.0, 50.0, 52.0, 60.0]),
         [Kept("policy", 1, 60.0, (50.0, 60.0), (9, 9), (4, 4))]),
        # quarters are of the time, not of the lives: samples at 30, 40, 50, 130, 140, 150 s have quarters of 30 s
        ([*life("policy", 7, 0.0, [0.0, 0.0, 0.0, 40.0, 42.0, 44.0]),
          *life("policy", 8, 100.0, [0.0, 0.0, 0.0, 70.0, 80.0, 90.0], handles=30)],
         [Kept("policy", 2, 50.0, (42.0, 80.0), (9, 30), (4, 4))]),
        # a process that lives for less than half a minute is left out; names are in order
        ([*life("robot", 3, 0.0, [5.0] * 4), *life("policy", 7, 0.0, [5.0] * 4), *life("adaptation", 8, 0.0, [5.0])],
         [Kept(name, 1, 30.0, (5.0, 5.0), (9, 9), (4, 4)) for name in ("policy", "robot")]),
        # a process with the pid of an earlier one is not as old as that one
        ([*life("policy", 7, 0.0, [5.0] * 4), *life("robot", 7, 100.0, [1.0, 1.0, 1.0, 8.0])],
         [Kept("policy", 1, 30.0, (5.0, 5.0), (9, 9), (4, 4)), Kept("robot", 1, 30.0, (8.0, 8.0), (9, 9), (4, 4))]),
    ],
)  # fmt: skip
def test_processes_are_summed_up_by_name(samples: list[Sample], kept: list[Kept]) -> None:
    assert kept_by(samples) == kept


@pytest.mark.parametrize(
    ("mib", "handles", "flat"),
    [
        ((100.0, 124.0), (20, 20), True),
        ((100.0, 126.0), (20, 20), False),
        ((20.0, 35.0), (20, 20), True),  # three quarters more, but only 15 MiB
        ((20.0, 37.0), (20, 20), False),
        ((100.0, 50.0), (20, 36), True),
        ((100.0, 50.0), (20, 37), False),
    ],
)
def test_growth_of_memory_or_open_files_is_reported(
    mib: tuple[float, float], handles: tuple[int, int], flat: bool
) -> None:
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


def test_processes_are_looked_at_every_few_seconds_until_the_fleet_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    wait, waits = threading.Event.wait, list[float]()

    def quickly(event: threading.Event, timeout: float | None = None) -> bool:
        waits.extend([] if timeout is None else [timeout])
        return wait(event, None if timeout is None else timeout / 500.0)

    monkeypatch.setattr(threading.Event, "wait", quickly)
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
    assert 1.0 <= min(waits) <= max(waits) <= 20.0


def test_an_hour_of_faults_comes_in_rounds_of_all_faults_of_one_fleet() -> None:
    once = {fault.name for fault in all_faults() if fault.diagnosis == "real"}
    faults = [fault.name for fault in faults_for(3600.0, seed=3)]
    assert len(faults) >= 1440, "at 2.5 s each"
    rounds = [faults[i : i + len(once)] for i in range(0, len(faults), len(once))]
    assert all(set(one) == once for one in rounds)
    assert rounds[0] != rounds[1]
    assert faults == [fault.name for fault in faults_for(3600.0, seed=3)]
    assert faults != [fault.name for fault in faults_for(3600.0, seed=4)]


def test_the_page_of_a_long_run_has_a_row_for_each_process() -> None:
    rows = [fault_row("kill policy", 0.4), fault_row("kill robot", 0.9), fault_row("stop policy", 0.1)]
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
    assert "kill policy" not in page, "of hundreds of faults only those that failed have a line"


def fault_row(name: str, recovery: float) -> dict[str, Any]:
    zero = dict.fromkeys(
        ("collisions", "stale_actions", "watchdog", "fallbacks", "states_not_recorded", "verdicts_not_recorded"), 0
    )
    return zero | {
        "name": name, "sentence": "", "held": True, "broken": (), "speed": 1.0, "periods": 60,
        "recovery_seconds": recovery, "whole_seconds": 1.0,
    }  # fmt: skip


def test_the_fate_of_a_process_includes_its_last_line(tmp_path: Path) -> None:
    member = Member("policy", "http.server", ("--bind", "nowhere.invalid", "0"), tmp_path / "policy.log")
    assert member.fate() == "its process lives", "it was not started, and did not end"
    member.start()
    end = time.monotonic() + 20.0
    while member.lives and time.monotonic() < end:
        time.sleep(0.02)
    assert member.fate().startswith("its process ended with 1: ")
    member.restart()
    member.kill()
    assert member.fate().startswith("its process ended with -9: ")


@pytest.mark.parametrize("minutes", ["nan", "inf", "1441"])
def test_an_endless_run_is_refused(minutes: str) -> None:
    with pytest.raises(InputError, match=r"--minutes: got .*, wanted 1440 at most"):
        command.main(["--minutes", minutes], standalone_mode=False)
