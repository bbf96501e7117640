"""What the supervisor receives on the bus, and its stop order."""

import json
from collections import Counter

import pytest
from tests.messages import finding_of, health_of, state_of, verdict_of

from safedpa.bus import FINDING, HEALTH, STATE, VERDICT, Answer, Bus, MemoryBroker, MemoryTransport
from safedpa.bus.messages.requests import ORDER
from safedpa.errors import SafedpaError
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.run_monitor import RunMonitor, run_summary

CORRIDOR = (0.1, 0.1)


@pytest.fixture
def broker():
    return MemoryBroker()


@pytest.fixture
def loop(broker):
    """The bus as seen by robot and services."""
    return Bus(MemoryTransport(broker), "fleet")


@pytest.fixture
def watch(broker):
    return RunMonitor(Bus(MemoryTransport(broker), "fleet"))


@pytest.mark.parametrize(
    ("state", "status", "has_obeyed"),
    [
        (None, None, False),
        (None, "stopped", False),
        (state_of(0.0, 0.0, 0.0, 0.0), None, False),
        (state_of(0.0, 0.0, 0.0, 0.0), "passed", False),
        (state_of(0.0, 0.0, 0.0, 0.019), "stopped", True),
        (state_of(0.0, 0.0, 0.0, -0.019), "stopped", True),
        (state_of(0.0, 0.0, 0.0, 0.021), "stopped", False),
        (state_of(0.0, 0.0, 0.0, -0.021), "stopped", False),
        (state_of(9.0, 9.0, 9.0, 0.0), "stopped", True),
        (state_of(0.0, 0.0, 0.0, 1.0, corridor=CORRIDOR), "stopped", True),
        (state_of(0.0, 1.0), "stopped", True),
    ],
)
def test_a_robot_has_obeyed_a_stop_order_when_the_verdict_is_stopped_and_a_car_when_it_is_also_stationary(
    watch, loop, state, status, has_obeyed
):
    if state is not None:
        loop.publish(STATE, "r1", state)
    if status is not None:
        loop.publish(VERDICT, "r1", verdict_of(status))
    watch.listen(0.0)
    assert watch.has_obeyed_stop() is has_obeyed


def test_a_repeated_verdict_counts_once_and_other_robots_do_not_count(watch, loop):
    for epoch, tick, robot in ((1, 0, "r1"), (1, 0, "r1"), (1, 1, "r1"), (2, 1, "r1"), (2, 2, "r2"), (2, 1, "r1")):
        loop.publish(VERDICT, robot, verdict_of("passed", epoch=epoch, tick=tick))
        watch.listen(0.0)
    loop.publish(FINDING, "r1", finding_of("raised"))
    loop.publish(FINDING, "r2", finding_of("learning"))
    watch.listen(0.0)
    assert watch.verdicts == {"passed": 3}
    assert watch.finding is not None
    assert watch.finding.stage == "raised"


@pytest.mark.parametrize(
    ("heard", "pid", "silent", "hung"),
    [(True, 4711, 10.5, True), (True, 4711, 9.5, False), (True, 7, 10.5, False), (False, 4711, 10.5, False)],
)
def test_only_the_process_that_fell_silent_has_hung(watch, loop, clock, heard, pid, silent, hung):
    """A restarted process has time to start."""
    if heard:
        loop.publish(HEALTH, "r1", health_of("policy"), "policy")
        watch.listen(0.0)
        clock.now = watch.health["policy"][1] + silent - clock.begin
    assert watch.has_hung("policy", pid, 10.0) is hung
    assert watch.silent_for("policy") == (pytest.approx(silent) if heard else float("inf"))


@pytest.mark.parametrize(
    ("state", "answer", "taken"),
    [
        (True, Answer(ok=True, sentence="so be it"), True),
        (True, Answer(ok=False, sentence="refused"), False),
        (True, None, False),
        (False, Answer(ok=True, sentence="so be it"), False),
    ],
)
def test_an_order_to_stop_is_taken_when_the_filter_says_so(watch, loop, state, answer, taken):
    asked: list[tuple[str, str]] = []

    def heard(robot, request):
        asked.append((robot, request.do))
        assert answer is not None
        return answer

    if answer is not None:
        loop.answer_requests(heard, kinds=(ORDER,))
    if state:
        loop.publish(STATE, "r1", state_of())
        watch.listen(0.0)
    assert watch.stop_robot() is taken
    assert asked == ([("r1", "stop")] if state and answer else [])


def test_a_robot_whose_bus_is_closed_takes_no_order(watch, loop):
    loop.publish(STATE, "r1", state_of())
    watch.listen(0.0)
    watch.bus.close()
    assert watch.stop_robot() is False


def test_a_long_stop_is_recorded_with_its_reason(watch, loop):
    loop.publish(
        VERDICT, "r1", verdict_of("corrected", tick=1, stationary_for=6.0, stationary_reason="the wall is near")
    )
    watch.listen(0.0)
    assert [stand["reason"] for stand in watch.standstills] == ["the wall is near"]


def test_listening_sleeps_for_the_given_time(watch, clock):
    watch.listen(0.25)
    assert clock.now == 0.25


def test_an_order_to_stop_is_waited_for_a_few_seconds_at_most(watch, monkeypatch):
    waited: list[float] = []
    monkeypatch.setattr(watch.bus, "request", lambda _robot, _what, seconds, _kind: waited.append(seconds))
    watch.state = state_of()
    assert watch.stop_robot() is False
    assert 1.0 <= waited[0] <= 4.0


def test_the_summary_contains_the_robots_summary_and_counts_interventions(tmp_path):
    account, other, missing = tmp_path / "robot.json", tmp_path / "robot-r2.json", tmp_path / "none.json"
    account.write_text(json.dumps({"ticks": 12}))
    other.write_text(json.dumps({"ticks": 11}))
    verdicts = Counter({"stopped": 1, "passed": 2, "disabled": 4, "corrected": 8, "fallback": 16, "relaxed": 32})
    child, recording = Child("policy", "none", (), tmp_path / "log", restarts=3), tmp_path / "recording.mcap"
    health = {"recorder": health_of("recorder", state="failing", detail="the disk is full")}
    found = run_summary(account, verdicts, [child], health, recording, [], {"r2": other})
    assert (found["ticks"], found["robots"]) == (12, {"r2": {"ticks": 11}})
    assert found["interventions"] == 8 + 16 + 32
    assert found["services"] == [{"name": "policy", "pid": 0, "restarts": 3, "cause": ""}]
    assert (found["recording"], found["recording_error"]) == (str(recording), "the disk is full")
    healthy = run_summary(account, verdicts, [], {"recorder": health_of("recorder")}, recording)
    assert healthy["recording_error"] is None
    assert "robots" not in healthy
    with pytest.raises(SafedpaError, match="the robot wrote no summary of its run"):
        run_summary(missing, verdicts, [], {}, recording)


@pytest.mark.processes
def test_a_recording_is_incomplete_if_its_recorder_had_to_be_killed(tmp_path):
    """Its last heartbeat says that all is well; the end of the file is missing all the same."""
    account, recorder = (
        tmp_path / "summary.json",
        Child("recorder", "timeit", ("-s", "while 1: pass"), tmp_path / "log"),
    )
    account.write_text("{}")
    recorder.start()
    recorder.end(0.0)
    found = run_summary(
        account, Counter(), [recorder], {"recorder": health_of("recorder")}, tmp_path / "recording.mcap"
    )
    assert "killed" in found["recording_error"]
