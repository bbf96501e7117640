"""The search in a process of its own: it is restarted when it is killed, and ends when it is cancelled."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safedpa.adaptation import LatentEstimator
from safedpa.calibration.from_runs import live_margin
from safedpa.dynamics import Setting, load_model, write_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.live.finding import DriveHistory
from safedpa.live.search_jobs import SearchJob
from safedpa.records.run import Run, Stretch
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import margin_from_text
from safedpa_services.diagnosis.process_worker import ProcessWorker
from safedpa_services.diagnosis.work_files import read_work, write_work

PATIENCE = 300.0
"""s; the process has the lowest priority, and a busy machine leaves it little time."""


@pytest.fixture
def worker():
    """Leaves no process behind, whatever the test found."""
    made = ProcessWorker()
    yield made
    made.close()


@pytest.fixture(scope="module")
def prepare(car, drive_of):
    history = DriveHistory(car.system, car.period)
    for row in drive_of(300):
        history.add(*row)
    document = write_model(car.with_effect(effect("car", "steering_offset"), {"angle": Setting(0.05)}))
    run = history.excerpt(0, "r1")
    return SearchJob(
        "prepare", write_model(car), run, effect="steering_offset", document=document, footprint=(0.1, 0.4, 0.2)
    )


def awaited(worker):
    """The outcome. The process has the lowest priority; where permitted, it gets an ordinary one here."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        outcome = worker.outcome("r1")
        if outcome is not None:
            return outcome
        with contextlib.suppress(OSError):
            os.sched_setscheduler(worker.process_of("r1"), os.SCHED_OTHER, os.sched_param(0))
            os.setpriority(os.PRIO_PROCESS, worker.process_of("r1"), 0)
        time.sleep(0.05)
    raise AssertionError("the work never ended")


def gone(pid: int) -> bool:
    try:
        return "State:\tZ" in Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    except OSError:
        return True


def test_a_work_is_the_same_behind_the_files(tmp_path, prepare):
    write_work(prepare, tmp_path)
    again = read_work(tmp_path)
    for name in ("task", "model", "horizon", "effect", "document", "footprint", "folder"):
        assert getattr(again, name) == getattr(prepare, name)
    assert again.run.stretches == prepare.run.stretches
    assert (again.run.states == prepare.run.states).all()
    assert (again.run.actions == prepare.run.actions).all()


@pytest.mark.long
@pytest.mark.processes
def test_a_killed_work_is_begun_again_and_done(worker, prepare):
    worker.begin("r1", prepare)
    first = worker.process_of("r1")
    os.kill(first, signal.SIGKILL)
    outcome = awaited(worker)
    assert outcome.failure == ""
    assert margin_from_text(outcome.margin).coverage == 0.99
    assert outcome.documents == {"steering_offset": prepare.document}
    assert not worker.busy("r1")


@pytest.mark.processes
def test_a_work_that_always_dies_ends_in_a_sentence(worker, prepare):
    worker.begin("r1", prepare)
    outcome, killed = None, set()
    while outcome is None:
        pid = worker.process_of("r1")
        if pid not in killed:
            killed.add(pid)
            os.kill(pid, signal.SIGKILL)
        outcome = worker.outcome("r1")
    assert "code -9, 3 times" in outcome.failure


@pytest.mark.processes
def test_a_work_that_has_used_its_processor_time_is_not_begun_again(worker, prepare):
    worker.begin("r1", prepare)
    pid, outcome = worker.process_of("r1"), None
    os.kill(pid, signal.SIGXCPU)  # as the kernel does at the limit
    while outcome is None:
        outcome = worker.outcome("r1")
    assert outcome.failure == "its process took more than 300 s of processor time"
    assert gone(pid)


@pytest.mark.processes
def test_a_work_that_takes_longer_than_an_hour_is_given_up(prepare):
    now = [1000.0]
    worker = ProcessWorker(clock=lambda: now[0])
    try:
        worker.begin("r1", prepare)
        os.kill(worker.process_of("r1"), signal.SIGSTOP)
        now[0] += 3500.0
        assert worker.outcome("r1") is None
        now[0] += 200.0
        assert "took too long" in worker.outcome("r1").failure
        assert not worker.busy("r1")
    finally:
        worker.close()


@pytest.mark.long
@pytest.mark.processes
def test_a_work_pauses_for_at_most_half_of_the_time_while_a_drive_misses_ticks(prepare):
    now = [1000.0]
    worker = ProcessWorker(clock=lambda: now[0])
    try:
        worker.begin("r1", replace(prepare, task="search"))
        asleep = Path(f"/proc/{worker.process_of('r1')}/wchan")
        deadline = time.monotonic() + PATIENCE
        while "nanosleep" not in asleep.read_text():  # signals during its start have no effect
            assert time.monotonic() < deadline
            now[0] += 2.0
            worker.give_way()
            time.sleep(0.02)
        worker.give_way()
        time.sleep(1.5)
        assert "nanosleep" not in asleep.read_text(), "the second one came too soon after the first"
        assert awaited(worker).failure == ""
    finally:
        worker.close()


@pytest.mark.processes
def test_a_cancelled_work_leaves_nothing_behind(worker, prepare, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    worker.begin("r1", prepare)
    assert list(tmp_path.iterdir())
    pid = worker.process_of("r1")
    worker.cancel("r1")
    assert gone(pid)
    assert not list(tmp_path.iterdir())
    assert worker.outcome("r1") is None


@pytest.mark.processes
def test_a_work_ends_with_the_service_also_when_that_is_killed(tmp_path, prepare):
    given, temporary = tmp_path / "given", tmp_path / "temporary"
    given.mkdir()
    temporary.mkdir()
    write_work(prepare, given)
    code = (
        "import sys; from pathlib import Path\n"
        "from safedpa_services.diagnosis.process_worker import ProcessWorker\n"
        "from safedpa_services.diagnosis.work_files import read_work\n"
        "worker = ProcessWorker(); worker.begin('r1', read_work(Path(sys.argv[1])))\n"
        "print(worker.process_of('r1'), flush=True); sys.stdin.read()\n"
    )
    service = subprocess.Popen(
        [sys.executable, "-c", code, str(given)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    pid = int(service.stdout.readline())
    assert list(temporary.iterdir())
    service.kill()
    service.communicate()
    deadline = time.monotonic() + PATIENCE
    while not gone(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert gone(pid)
    assert not list(temporary.iterdir())


def test_the_margin_is_the_larger_one_of_everything_and_of_the_newest_half(car, prepare):
    run = prepare.run
    late = run.states.copy()
    late[len(late) // 2 :, 3] += 0.3 * (np.arange(len(late) - len(late) // 2) % 2)
    worse = type(run)(run.name, run.system, run.t, late, run.actions, run.stretches)
    calm = margin_from_text(live_margin(car, settings_named("car"), run, (0.08, 0.4, 0.12)))
    rough = margin_from_text(live_margin(car, settings_named("car"), worse, (0.08, 0.4, 0.12)))
    assert all(rough.epsilon[kind] >= calm.epsilon[kind] for kind in calm.epsilon)
    assert rough.epsilon["obstacle"] > 3.0 * calm.epsilon["obstacle"]


def test_a_model_with_free_numbers_is_calibrated_with_the_latent_that_is_estimated_along(car, prepare):
    free = load_model("car")
    fixed = margin_from_text(live_margin(free, settings_named("car"), prepare.run, (0.08, 0.4, 0.12)))
    along = margin_from_text(
        live_margin(free, settings_named("car"), prepare.run, (0.08, 0.4, 0.12), lambda: LatentEstimator(free))
    )
    assert fixed.epsilon != along.epsilon


def run_of(model):
    t = model.period * np.arange(3.0)
    zeros = np.zeros((3, len(model.system.state)))
    return Run("r", model.system, t, zeros, zeros[:, : len(model.system.action)], (Stretch(0, 3),))


def test_a_robot_that_names_no_barriers_around_a_state_has_no_margin_and_settings_of_another_car_none_either():
    assert live_margin(load_model("point_wind"), settings_named("point"), None, ()) == ""
    with pytest.raises(InputError, match=r"got bounds of -0\.6 to 2 1 for throttle"):
        live_margin(model := load_model("dart_car"), settings_named("car"), run_of(model), ())
