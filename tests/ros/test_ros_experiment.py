"""The experiment with a ROS 2 car: its page is generated from its figures, and its options are checked."""

import argparse
import json
import sys
from pathlib import Path
from subprocess import run

import pytest

from safedpa_lab.experiments.ros.experiment import FAULTS, page_of
from safedpa_lab.ros import car
from safedpa_services.command_line.group import safedpa

RESULTS = Path(__file__).parents[2] / "docs" / "evidence" / "results"


def test_the_page_of_the_stored_figures_reports_drives_and_faults() -> None:
    result = json.loads((RESULTS / "ros.json").read_text(encoding="utf-8"))
    page = page_of(result)
    assert all(f"| {fault} |" in page for fault in FAULTS)
    assert result["with_filter"]["drives"] == 100
    assert {one["fault"] for one in result["faults"]} == {*FAULTS}
    assert all(one["held"] for one in result["faults"])


def test_impossible_options_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for phrase, notice in (
        (["--fault", "filter kiled"], "did you mean 'filter killed'"),
        (["--drives", "0"], "--drives: got 0"),
        (["--out", str(tmp_path / "no" / "x.json")], "does not exist; create it"),
    ):
        assert safedpa.run(["experiment", "ros", *phrase]) == 2
        assert notice in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("module", ["car", "speaker", "router", "foreign"])
def test_the_robot_s_side_imports_nothing_of_ours_but_the_simulator(module: str) -> None:
    def loaded(names: str) -> set[str]:
        code = f"import sys, {names}; print(*[name for name in sys.modules if name.startswith('safedpa')])"
        return set(run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())

    simulator = loaded("safedpa_sim.robots.car.scene, safedpa_sim.robots.car.world")
    alongside = loaded(f"safedpa_lab.ros.{module}") - simulator
    assert {name for name in alongside if not name.startswith("safedpa_lab.ros.")} <= {"safedpa_lab", "safedpa_lab.ros"}


def _turns(monkeypatch: pytest.MonkeyPatch, seconds: float, delays: dict[int, float]) -> list[float]:
    """When the car drove its periods, if its process was suspended after some of them for so long [s]."""
    now, turns = [50.0], list[float]()
    monkeypatch.setattr(car.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(car.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    driven = object.__new__(car.Car)
    driven.options, driven.ended, driven.stalled = argparse.Namespace(seconds=seconds), False, 0.0

    def turn(k: int, at: float) -> None:
        turns.append(now[0])
        now[0] += delays.get(k, 0.0)
        driven.ended = k > 1000

    monkeypatch.setattr(driven, "turn", turn)
    monkeypatch.setattr(driven, "account", dict)
    driven.run()
    return turns


@pytest.mark.parametrize("stall", [0.04, 0.3])
def test_a_car_whose_process_was_suspended_does_not_drive_on_blindly(monkeypatch: pytest.MonkeyPatch, stall: float):
    """It would make up for missed periods in a burst under one command, without control by the gateway."""
    turns = _turns(monkeypatch, 1.0, {10: stall})
    assert max(turns.count(moment) for moment in turns) <= 3, "so many periods at once"
    assert len(turns) == 50, "a second of driving all the same"


@pytest.mark.parametrize("delay", [0.08, 0.15, 0.5])
def test_a_car_drives_at_its_own_rate_again_after_a_busy_machine(monkeypatch: pytest.MonkeyPatch, delay: float) -> None:
    turns = _turns(monkeypatch, 10.0, dict.fromkeys(range(20, 60), delay))
    assert max(turns.count(moment) for moment in turns) <= 6, "so many periods at once"
    assert turns[-1] - turns[-101] == pytest.approx(100 * 0.02), "the last 100 periods"
    assert len(turns) == pytest.approx(500, abs=1), "the drive lasts as long as asked"
