"""Rows of the benchmark: what they ask for, their targets, and what is reported where something is missing."""

import itertools
import json
import subprocess
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.errors import InputError, SafedpaError
from safedpa.safety import Status, Verdict
from safedpa.safety.decision import Decision
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa_lab.benchmarks import latency
from safedpa_lab.benchmarks.filter_problem import MODELS, problem_with
from safedpa_lab.benchmarks.fleet import FleetTrial
from safedpa_lab.benchmarks.results import Effort, Entry, Floor, Row
from safedpa_lab.benchmarks.rows import diagnosis, kernel, long_logs, sense_to_act, start, weights
from safedpa_lab.benchmarks.rows import largest_fleet as row
from safedpa_lab.benchmarks.rows.decision_parts import WHOLE, measure, parts
from safedpa_lab.benchmarks.rows.diagnosis import dart_drives, written
from safedpa_lab.benchmarks.rows.start import answers, seconds_to_pages
from safedpa_lab.benchmarks.table import row_lines
from safedpa_lab.benchmarks.users_models import ROBOTS
from safedpa_lab.experiments.diagnosis.real_logs_data import CAR
from safedpa_sim.training.configuration import load_configuration


@pytest.mark.parametrize("name", MODELS)
def test_parts_are_of_the_decisions_that_are_timed_as_a_whole(name: str) -> None:
    found = parts(problem_with(8), load_model(name))
    requests = found[WHOLE][1]
    assert {len(inputs) for _, inputs in found.values()} == {len(requests)}
    for index in range(0, len(requests), 9):
        each = {part: call(inputs[index]) for part, (call, inputs) in found.items()}
        whole = each[WHOLE]
        assert isinstance(whole, Verdict)
        assert whole.status is Status.corrected
        assert isinstance(each["inputs"], Decision)
        assert isinstance(each["the conditions at the state"], Constraints)
        assert isinstance(each["an outcome"], ActionCandidate)
        assert not each["an outcome"].is_feasible
        assert each["the search"].__class__ is tuple
        assert each["back towards the nominal action"].is_feasible
        assert each["the verdict"].h_now == whole.h_now
        assert each["the program"].solved
    assert ("the networks, within the conditions" in found) == (name == "car_learned")


def test_every_part_of_either_model_has_its_line() -> None:
    row = measure(Effort(quick=True))
    assert ({entry.problem for entry in row.ours}, len(row.ours)) == (set(MODELS.values()), 2 * 9 + 1)
    assert all(0.0 < entry.figures["p50"] <= entry.figures["p999"] for entry in row.ours)


@pytest.mark.long
def test_the_row_of_compiled_decisions_has_a_target_for_every_part_that_was_measured() -> None:
    """In a quick run: neither loop nor fleet. Where a part is missing, the row says why."""
    found = kernel.measure(Effort(quick=True))
    wanted = {"physics, 8 obstacles", "physics, no feasible action", "256 points of a scan", "the first decision"}
    assert all(any(part in target.what for target in found.targets) for part in wanted)
    assert all(target.got > 0.0 for target in found.targets)
    measured = {entry.problem for entry in found.ours if not entry.missing}
    assert {"networks f and g, 32 obstacles", "1,080 rays"} <= measured
    assert all(f"p99 of a RolloutBarrier, {name}" in str(found.targets) for name in measured & set(ROBOTS))
    assert all(entry.figures or entry.missing for entry in (*found.ours, *found.peers))


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


def test_the_cases_have_a_target_on_average_and_one_for_the_longest(tmp_path, monkeypatch) -> None:
    """With a clock that advances by the nominal time of a case, and a processor that works for half of it."""
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
    monkeypatch.setattr(diagnosis, "reported", lambda _: {})
    monkeypatch.setattr(diagnosis, "written", lambda *_: log)
    monkeypatch.setattr("safedpa_lab.experiments.diagnosis.diagnosing.diagnosed", diagnosed)
    monkeypatch.setattr("safedpa_lab.hidden.judge.judged", judged)
    monkeypatch.setattr("safedpa.diagnosis.search.forward_selection.run_search", searched)
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
        phrase = dict(itertools.pairwise(command))
        hours = int(phrase["--runs"]) * float(phrase["--seconds"]) / 3600.0
        row = {"seconds": 7.0 * hours, "processor_seconds": 6.0, "memory_mebibytes": 300.0, "added": ["drag"]}
        rows = [{"command": "compare"}, {"command": "diagnose", **row}]
        return SimpleNamespace(returncode=0, stdout=json.dumps({"rows": rows}))

    monkeypatch.setattr(subprocess, "run", run)
    seconds, memory, growth = long_logs.measure(Effort(full=True)).targets
    assert (seconds.what, seconds.wanted, seconds.got, seconds.reached) == ("seconds, 10 h", 60.0, 70.0, False)
    assert (memory.wanted, memory.got, memory.reached) == (2048.0, 300.0, True)
    assert (growth.wanted, growth.got) == (1.0, pytest.approx(1.0))
    assert all("seconds" not in target.what for target in long_logs.measure(Effort(quick=True)).targets)


def _fleet(capacity: int, broken: int) -> Any:
    def drive(trial: FleetTrial) -> dict[str, Any]:
        if trial.robots >= broken:
            raise SafedpaError("robots ended with exit code 1")
        late = 0 if trial.robots <= capacity else 50
        each = {"mib_begin": 9.0, "mib_end": 10.0 + 0.2 * trial.robots, "us_per_robot_tick": 60.0}
        used = {"robots": each, "stack_1": each, "stack_2": each, "gone": None}
        times = {"p50": 1000, "p99": 2000 + trial.robots}
        counted = {"robot_ticks": 100 * trial.robots, "late_ticks": late}
        return {"robots": trial.robots, **counted, "sense_to_act_us": times, "processes": used, "holds": late == 0}

    return drive


def test_the_search_ends_at_what_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row, "fleet_benchmark", _fleet(230, 390))
    found = row.measure(Effort())
    assert 215 <= found.ours[0].figures["robots"] <= 230
    assert found.targets[0].reached
    assert found.peers[0].figures["robots"] > found.ours[0].figures["robots"]  # one robot alone always holds here
    trials = found.ours[0].more["trials"]
    assert [trial["holds"] for trial in trials[:3]] == [True, True, False]
    assert "exit code 1" in trials[2]["failed"]
    assert list(found.curves[0].x) == sorted(found.curves[0].x)


def test_one_that_breaks_down_takes_all_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The third of four robots with services of their own breaks down."""
    alone = itertools.count(1)

    def drive(trial: FleetTrial) -> dict[str, Any]:
        breaks = trial.robots == 1 and next(alone) == 3
        found: dict[str, Any] = _fleet(1000, 1 if breaks else 2000)(trial)
        return found

    monkeypatch.setattr(row, "fleet_benchmark", drive)
    first = row.measure(Effort()).peers[0].more["trials"][0]
    assert (first["robots"], first["robot_ticks"], first["holds"]) == (4, 300, False)


def test_the_asked_number_drives_for_ten_minutes_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[FleetTrial] = []
    fleet = _fleet(230, 390)
    monkeypatch.setattr(row, "fleet_benchmark", lambda trial: driven.append(trial) or fleet(trial))
    found = row.measure(Effort(full=True))
    assert (driven[-1].robots, driven[-1].seconds, driven[-1].stacks) == (200, 600.0, 2)
    entry = found.ours[1]
    assert (entry.figures["late_percent"], entry.figures["p99_ms"]) == (0.0, pytest.approx(2.2))
    assert entry.figures["mib_gained"] == pytest.approx(3 * 41.0)
    reported = {target.what.split(" ")[0]: target for target in found.targets}
    assert reported["late"].reached
    assert reported["p99"].reached
    assert (reported["memory"].wanted, reported["memory"].reached) == (40.0, False)
    assert (reported["processor"].got, reported["processor"].wanted, reported["processor"].reached) == (
        60.0,
        125.0,
        True,
    )
    assert len(row_lines(found.as_document() | {"name": "largest-fleet"})[1]) == 3


def test_ten_minutes_that_break_down_are_late_altogether(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row, "fleet_benchmark", _fleet(150, 180))
    found = row.measure(Effort(full=True))
    assert "exit code 1" in found.ours[1].missing
    late = [target for target in found.targets if target.what.startswith("late")]
    assert [(target.got, target.reached) for target in late] == [(100.0, False)]
    assert not any(target.what.startswith(("p99", "memory", "processor")) for target in found.targets)


def test_without_ten_minutes_the_largest_fleet_gives_the_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row, "fleet_benchmark", _fleet(230, 390))
    found = row.measure(Effort())
    assert len(found.ours) == 1
    cost, elsewhere = found.targets[1:]
    assert cost.what.startswith("processor of a stack, of two, a robot-tick")
    assert cost.got == 60.0
    assert 2.0 * cost.wanted * 400 * 20 == pytest.approx(2.0 * 1e6), "what two cores have"
    assert "400 robots simulated elsewhere" in elsewhere.what
    assert (elsewhere.got, elsewhere.wanted, elsewhere.reached) == (0.96, 2.0, True)


LOOP = {"p50": 900.0, "p99": 1210.0, "p999": 3000.0, "watchdog_ticks": 2}


def _sense_to_act(monkeypatch: pytest.MonkeyPatch, effort: Effort, watched: Any) -> tuple[Row, list[Any]]:
    asked: list[Any] = []

    def both(seconds: float, rate: float) -> dict[str, Any]:
        asked.append((seconds, rate))
        chain = {"p50": 800.0, "p99": 10.0 * rate + 800.0, "p999": 2000.0, "late_share": 1e-6 * rate}
        return {"real_loop_us": LOOP, "bare_chain_us": chain}

    monkeypatch.setattr(sense_to_act, "latency_benchmark", both)
    monkeypatch.setattr(sense_to_act, "real_loop", watched)
    return sense_to_act.measure(effort), asked


def test_the_loop_is_compared_with_the_bare_chain_of_its_run(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Any] = []

    def watched(seconds: float, rate: float, *, watched: bool) -> dict[str, Any]:
        looked.append((seconds, rate, watched))
        return {**LOOP, "watchdog_ticks": 0}

    row, asked = _sense_to_act(monkeypatch, Effort(full=True), watched)
    assert (asked, looked) == ([(600.0, 20.0), (600.0, 200.0)], [(120.0, 20.0, True)])
    wanted = [(target.wanted, target.got) for target in row.targets]
    assert wanted == [(1200.0, 1210.0), (0.0, 2.0), (3360.0, 1210.0), (0.0, 2.0), (1200.0, 1210.0), (0.0, 0.0)]
    assert [target.reached for target in row.targets] == [False, False, True, False, False, True]
    assert row.targets[0].floor == Floor("the bare chain", 1000.0)
    assert not row.targets[0].forbidden
    assert [target.floor for target in row.targets[1:4:2]] == [
        Floor("as late as the bare chain", 0.0),
        Floor("as late as the bare chain", 24.0),
    ]
    assert [target.forbidden for target in row.targets[1:4:2]] == [False, True]
    assert [set(entry.figures) for entry in row.peers] == [{"p50", "p99", "p999"}] * 2
    assert [entry.problem for entry in row.ours] == ["20 Hz", "200 Hz", "20 Hz, watched"]
    assert "workbench" in row.ours[-1].note


def test_the_chain_runs_before_and_after_the_loop_and_counts_late_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[Any] = []

    def times(seconds: float, rate: float) -> list[float]:
        reported.append(("chain", seconds, rate))
        return [1000.0] * (round(seconds * rate) - 2) + [5001.0]  # one is late, one never comes

    def loop(seconds: float, rate: float) -> dict[str, float]:
        reported.append(("loop", seconds, rate))
        return dict(LOOP)

    monkeypatch.setattr(latency, "bare_times", times)
    monkeypatch.setattr(latency, "real_loop", loop)
    found = latency.latency_benchmark(600.0, 200.0)
    assert reported == [("chain", 60.0, 200.0), ("loop", 600.0, 200.0), ("chain", 60.0, 200.0)]
    assert found["bare_chain_us"] == {
        "p50": 1000.0, "p99": 1000.0, "p999": 1000.0, "late_share": pytest.approx(4 / 24000),
    }  # fmt: skip
    reported.clear()
    latency.latency_benchmark(20.0, 20.0)
    assert reported[0] == ("chain", 10.0, 20.0)


def test_a_chain_from_which_nothing_arrives_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latency, "bare_times", lambda *_: [])
    with pytest.raises(SafedpaError, match="got none of 40 messages"):
        latency.bare_chain(2.0, 20.0)


def test_a_watched_loop_that_does_not_come_up_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def watched(*_: Any, **__: Any) -> dict[str, Any]:
        raise SafedpaError("safedpa up: ran without workbench")

    row, _ = _sense_to_act(monkeypatch, Effort(), watched)
    assert "without workbench" in row.ours[-1].missing
    assert len(row.targets) == 4
    quick, asked = _sense_to_act(monkeypatch, Effort(quick=True), watched)
    assert (asked, len(quick.ours)) == ([(2.0, 20.0)], 1)


def test_a_watched_loop_needs_every_watching_service(monkeypatch: pytest.MonkeyPatch) -> None:
    services = [{"name": name} for name in ("robot", "recorder", "diagnosis", "dashboard", "workbench")]

    def run(command: list[str], **_: Any) -> SimpleNamespace:
        there = services if "--headless" not in command and "7.0" in command else services[:3]
        summary = {"services": there, "latency_us": LOOP, "watchdog_ticks": 2}
        return SimpleNamespace(returncode=0, stdout=json.dumps(summary))

    monkeypatch.setattr(subprocess, "run", run)
    assert (latency.real_loop(7.0, 20.0, watched=True), latency.real_loop(5.0, 20.0)) == (LOOP, LOOP)
    with pytest.raises(SafedpaError, match="without dashboard, workbench"):
        latency.real_loop(5.0, 20.0, watched=True)


class _Site(BaseHTTPRequestHandler):
    """``/page`` is a page, ``/door`` lets in anyone who comes back with its cookie, nothing else is there."""

    def do_GET(self) -> None:
        let_in = self.path == "/page" or "key=1" in (self.headers.get("Cookie") or "")
        at_door = self.path == "/door" and not let_in
        self.send_response(303 if at_door else 200 if let_in else 404)
        if at_door:
            self.send_header("Set-Cookie", "key=1; Path=/")
            self.send_header("Location", "/inside")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Says nothing."""


@pytest.fixture
def site() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Site)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_a_page_answers_when_a_browser_would_see_it(site: str) -> None:
    assert answers(f"{site}/page")
    assert answers(f"{site}/door")
    assert not answers(f"{site}/absent")
    assert not answers("http://127.0.0.1:9/page")


def _up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """A stand-in for ``safedpa up``."""
    package = tmp_path / "safedpa_services"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text(program, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


@pytest.mark.long
def test_the_first_page_is_waited_for(site: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    phrase = f"recording r\\nlive view {site}/page\\nworkbench {site}/door\\n"
    _up(tmp_path, monkeypatch, f"import sys, time\nsys.stderr.write('{phrase}')\nsys.stderr.flush()\ntime.sleep(60)\n")
    found = seconds_to_pages()
    assert set(found) == {"live view", "workbench"}
    assert all(0.0 < seconds < 60.0 for seconds in found.values())


@pytest.mark.long
def test_a_start_that_ends_or_shows_nothing_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _up(tmp_path, monkeypatch, "import sys\nsys.exit('no room for a page')\n")
    with pytest.raises(SafedpaError, match="ended with exit code 1"):
        seconds_to_pages()
    (tmp_path / "safedpa_services" / "__main__.py").write_text("import time\ntime.sleep(60)\n", encoding="utf-8")
    clock = time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: 100.0 * clock())  # a minute is over after 0.6 s
    began = clock()
    with pytest.raises(SafedpaError, match="no answer of live view, workbench"):
        seconds_to_pages()
    assert clock() - began > 0.3


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_the_start_has_a_target_of_each_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is measured is real, but for the pages, which need a browser's packages."""
    monkeypatch.setattr(start, "seconds_to_pages", lambda: {"live view": 4.5, "workbench": 5.0})
    row = start.measure(Effort(quick=True))
    figures = {entry.name: entry.figures.get("seconds") for entry in row.ours}
    got = {target.what: (target.wanted, target.got) for target in row.targets}
    assert got["start to the first action"] == (2.0, figures["safedpa up to the first action"])
    assert got["start to the live view"] == (4.0, 4.5)
    assert got["safedpa compare of a recording"] == (2.0, figures["safedpa compare"])
    assert got["import safedpa"] == (0.15, figures["import safedpa"])
    acting = {figures[f"import of {name}"] for name in ("adaptation", "policy", "safety_filter")}
    assert row.targets[0].floor is not None
    assert row.targets[0].floor.value == max(acting), "an action needs no dashboard"
    assert row.targets[1].floor == Floor("import of dashboard", figures["import of dashboard"])
    memory = {entry.name: entry.figures["mib"] for entry in row.ours if entry.problem == "memory"}
    assert min(memory.values()) > 5.0
    assert len(memory) >= 5


Commands = list[tuple[list[str], dict[str, str]]]


def _answering(monkeypatch: pytest.MonkeyPatch, code: int) -> Commands:
    asked: Commands = []

    def run(command: list[str], **settings: Any) -> subprocess.CompletedProcess[str]:
        asked.append((command, settings["env"]))
        return subprocess.CompletedProcess(command, code, "{}", "no disk left\n")

    monkeypatch.setattr(subprocess, "run", run)
    return asked


@pytest.mark.parametrize("effort", [Effort(quick=True), Effort(full=True)])
def test_every_robot_that_ships_weights_is_trained_whole_on_one_thread(effort, monkeypatch) -> None:
    asked = _answering(monkeypatch, 0)
    row = weights.measure(effort)
    robots = [command[command.index("train") + 1] for command, _ in asked]
    assert sorted(robots) == ["car", "pendulum", "point"]
    assert all(load_configuration(robot) for robot in robots)
    assert all(environment["OMP_NUM_THREADS"] == "1" for _, environment in asked)
    assert all("--phases" not in command for command, _ in asked)
    assert [("--small" in command) for command, _ in asked] == [effort.quick] * 3
    assert [target.wanted for target in row.targets] == ([] if effort.quick else [60.0])
    assert row.ours[0].figures["minutes"] >= max(entry.figures["minutes"] for entry in row.ours[1:])
    assert len({command[command.index("--out") + 1] for command, _ in asked}) == 3


def test_a_failing_training_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    _answering(monkeypatch, 1)
    with pytest.raises(SafedpaError, match=r"train car: no disk left$"):
        weights.measure(Effort(full=True))
