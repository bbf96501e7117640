"""The diagnosis' rows: their targets, and drives of a real car where their folder is named."""

from __future__ import annotations

import itertools
import json
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_lab.benchmarks.diagnosis_cases import written
from safedpa_lab.benchmarks.real_drives import dart_drives
from safedpa_lab.benchmarks.results import Effort, Entry
from safedpa_lab.benchmarks.rows import diagnosis, long_logs
from safedpa_lab.experiments.real_logs_data import CAR


def _drives(folder: Path, count: int, seconds: float = 12.0) -> Path:
    """Recordings in the car's own columns: throttle and steering that wander, a car that follows them."""
    for number in range(count):
        t = 0.01 * np.arange(round(100.0 * seconds))
        throttle, steer = 0.3 + 0.1 * np.sin(0.7 * t + number), 0.6 * np.sin(0.5 * t)
        speed = 1.0 + np.cumsum(0.01 * (throttle - 0.3))
        yaw = np.cumsum(0.01 * speed * np.tan(0.372 * steer) / 0.175)
        x, y = np.cumsum(0.01 * speed * np.cos(yaw)), np.cumsum(0.01 * speed * np.sin(yaw))
        table = np.column_stack([t + 0.01, throttle, steer, t + 1e9, x, y, yaw])
        head = "elapsed time sensors,throttle,steering,vicon time,vicon x,vicon y,vicon yaw"
        np.savetxt(folder / CAR.replace("*", f"10_0{number}_00"), table, delimiter=",", header=head, comments="")
    return folder


def test_drives_without_a_folder_are_left_out() -> None:
    entry, targets = dart_drives(Effort())
    assert "--data" in entry.missing
    assert not targets


def test_a_folder_without_the_drives_is_refused(tmp_path: Path) -> None:
    _drives(tmp_path, 3)
    with pytest.raises(InputError, match=r"got 3 files .* wanted 4"):
        dart_drives(Effort(quick=True, recordings=tmp_path))


@pytest.mark.long
@pytest.mark.slow
def test_drives_are_diagnosed_from_their_files(tmp_path: Path) -> None:
    assert "quick" in dart_drives(Effort(quick=True, recordings=_drives(tmp_path, 4)))[0].missing
    entry, targets = dart_drives(Effort(recordings=tmp_path))
    assert entry.figures["seconds"] > 0.0
    assert "4 drives, 47 s together" in entry.note
    assert (targets[0].wanted, targets[0].got) == (30.0, entry.processor["seconds"])


def test_the_cases_have_a_target_on_average_and_one_for_the_longest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a clock that goes on by what a case is said to take, and a processor that works for half of it."""
    clock, cases, log = [0.0], len(diagnosis.CASES), written(diagnosis.CASES[1], tmp_path, 2, 6.0)
    seconds = iter([9.0, *[(5.5 * cases - 9.0) / (cases - 1)] * (cases - 1), *[1.0] * 5])
    outcomes = iter([(True, True), (False, False), *[(True, False)] * (cases - 2)])

    def diagnosed(*_: Any) -> None:
        clock[0] += next(seconds)

    def searched(*_: Any) -> None:
        clock[0] += 3.0

    def judged(*_: Any) -> SimpleNamespace:
        return SimpleNamespace(**dict(zip(("right", "wrong"), next(outcomes), strict=True)))

    real = Entry("safedpa, DART drives", {"seconds": 20.0}, "s", {"seconds": 19.0}, "four drives of a real car")
    monkeypatch.setattr(diagnosis, "dart_drives", lambda _: (real, []))
    monkeypatch.setattr(diagnosis, "ask_peer", lambda *_: {"missing": "not asked"})
    monkeypatch.setattr(diagnosis, "told", lambda _: {})
    monkeypatch.setattr(diagnosis, "written", lambda *_: log)
    monkeypatch.setattr("safedpa_lab.experiments.diagnosing.diagnosed", diagnosed)
    monkeypatch.setattr("safedpa_lab.hidden.judge.judged", judged)
    monkeypatch.setattr("safedpa.diagnosis.search.search.searched", searched)
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(time, "process_time", lambda: 0.5 * clock[0])
    row = diagnosis.measure(Effort())
    targets = [(target.wanted, target.got, target.reached) for target in row.targets]
    assert targets == [(10.0, 9.0, True), (5.0, pytest.approx(5.5), False)]
    own = row.ours[0]
    assert row.ours == (own, real)
    assert own.processor == pytest.approx({"seconds": 2.75, "longest": 4.5})
    assert (own.figures["right"], own.more["cases"]) == (cases - 2, cases)
    assert [curve.series["safedpa"] for curve in row.curves] == [(0.5,) * 5, (1.5,) * 4]
    assert {peer.missing for peer in row.peers} == {"not asked"}


def test_ten_hours_have_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(command: list[str], **_: Any) -> SimpleNamespace:
        words = dict(itertools.pairwise(command))
        hours = int(words["--runs"]) * float(words["--seconds"]) / 3600.0
        row = {"seconds": 7.0 * hours, "processor_seconds": 6.0, "memory_mebibytes": 300.0, "added": ["drag"]}
        rows = [{"command": "compare"}, {"command": "diagnose", **row}]
        return SimpleNamespace(returncode=0, stdout=json.dumps({"rows": rows}))

    monkeypatch.setattr(subprocess, "run", run)
    seconds, memory, growth = long_logs.measure(Effort(full=True)).targets
    assert (seconds.what, seconds.wanted, seconds.got, seconds.reached) == ("seconds, 10 h", 60.0, 70.0, False)
    assert (memory.wanted, memory.got, memory.reached) == (2048.0, 300.0, True)
    assert (growth.wanted, growth.got) == (1.0, pytest.approx(1.0))
    assert all("seconds" not in target.what for target in long_logs.measure(Effort(quick=True)).targets)
