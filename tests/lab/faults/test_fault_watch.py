"""Who watches: the observer of a campaign, the supervisor, and the robot's own trace."""

import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
from tests.messages import latent_of, stamp, verdict_of

from safedpa.bus import (
    ACTION,
    HEALTH,
    LATENT,
    NO_ROBOT,
    STATE,
    TAKEOVER,
    VERDICT,
    ActionMessage,
    Answer,
    Bus,
    HealthMessage,
    MemoryBroker,
    MemoryTransport,
    Request,
    StateMessage,
    TakeoverMessage,
    ZenohSettings,
    ZenohTransport,
)
from safedpa.bus.messages.codec import decode
from safedpa.bus.messages.requests import ORDER
from safedpa.errors import RecordingError
from safedpa_lab.faults.model_changes import mixed_in
from safedpa_lab.faults.world import Observer
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.run_monitor import RunMonitor
from safedpa_sim.robots import CarRobot, Scene, TraceWriter, read_trace
from safedpa_sim.robots.loop import RobotLoop


class Fleet:
    """Says whatever a test wants to be heard of the robot r1."""

    def __init__(self) -> None:
        broker = MemoryBroker()
        self.bus = Bus(MemoryTransport(broker), "test")
        self.observer = Observer(Bus(MemoryTransport(broker), "test"), "r1")

    def tick(self, tick: int, epoch: int = 5, model: str = "old", status: str = "passed", by: str | None = None):
        header = stamp(tick, 0.0, epoch)
        state = CarRobot(Scene.random(1), epoch=epoch).state_message()
        self.bus.publish(STATE, "r1", replace(state, tick=tick, applied_by="filter"))
        self.bus.publish(LATENT, "r1", latent_of(**header, model=model))
        self.bus.publish(VERDICT, "r1", verdict_of(status, **header, model=model if by is None else by))
        self.bus.publish(ACTION, "r1", ActionMessage(**header, values=(1.0, 0.0)))
        self.observer.listen(0.0)

    def taken(self, tick: int, model: str, epoch: int = 5) -> None:
        message = TakeoverMessage(
            **stamp(tick, 0.0, epoch), service="safety_filter", change=1, fingerprint=model, state="taken"
        )
        self.bus.publish(TAKEOVER, "r1", message, "safety_filter")
        self.observer.listen(0.0)


@pytest.fixture
def fleet() -> Fleet:
    return Fleet()


def test_it_drives_after_enough_ticks_in_a_row_and_not_on_what_was_heard_before(fleet: Fleet) -> None:
    for tick in range(6):
        fleet.tick(tick)
    assert fleet.observer.drives(5)
    assert not fleet.observer.drives(6), "the first tick was driven by no one"
    assert not fleet.observer.drives(3, since=fleet.observer.heard[5, 4])
    fleet.tick(6, status="fallback")
    fleet.tick(7)
    assert not fleet.observer.drives(2)


def test_a_gap_in_the_ticks_is_no_driving(fleet: Fleet) -> None:
    for tick in (0, 1, 2, 4, 5):
        fleet.tick(tick)
    assert fleet.observer.drives(1)
    assert not fleet.observer.drives(3)


def test_periods_that_came_too_late_are_no_steady_driving(fleet: Fleet) -> None:
    for tick in range(6):
        fleet.tick(tick)
    fleet.observer.heard.update({(5, tick): 10.0 + 0.05 * tick for tick in range(6)})
    assert fleet.observer.drives(5, within=0.21)
    fleet.observer.heard[5, 5] += 0.1
    assert not fleet.observer.drives(5, within=0.21)
    assert fleet.observer.drives(5)


def test_models_are_mixed_only_where_the_filter_decided_by_another_one_than_the_latents(fleet: Fleet) -> None:
    for tick in range(3):
        fleet.tick(tick, model="old")
    fleet.tick(3, model="old", by="new", status="fallback")
    fleet.tick(4, model="new")
    fleet.tick(1, epoch=2, model="new")  # the robot restarts, with an epoch that is no larger
    assert mixed_in(fleet.observer) == []
    fleet.tick(5, model="old", by="new")  # with the latent of tick 4
    assert mixed_in(fleet.observer) == []
    fleet.tick(6, model="old", by="new")
    assert mixed_in(fleet.observer) == [(5, 6)]
    fleet.tick(2, epoch=2, model="new", by="old")
    assert mixed_in(fleet.observer) == [(5, 6), (2, 2)]


def test_heartbeats_report_services_and_acknowledged_messages(fleet: Fleet) -> None:
    message = HealthMessage(
        epoch=0, tick=0, robot_time=0.0, publish_time=0.0, service="recorder", pid=7, state="running", acknowledged=40
    )
    fleet.bus.publish(HEALTH, NO_ROBOT, message, "recorder")
    fleet.observer.listen(0.0)
    heard = fleet.observer.health["recorder"][1]
    assert fleet.observer.acknowledged == {7: 40}
    assert fleet.observer.silent_for("recorder", heard + 2.0) == pytest.approx(2.0)
    assert fleet.observer.silent_for("policy", heard) == float("inf")


def reported(service: str, pid: int) -> HealthMessage:
    return HealthMessage(
        epoch=0, tick=0, robot_time=0.0, publish_time=0.0, service=service, pid=pid, state="running"
    )  # fmt: skip


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> RunMonitor:
    broker = MemoryBroker()
    watch = RunMonitor(Bus(MemoryTransport(broker), "test"))
    sender = Bus(MemoryTransport(broker), "test")
    sender.publish(HEALTH, NO_ROBOT, reported("policy", 77), "policy")
    watch.listen(0.0)
    heard = watch.health["policy"][1]
    monkeypatch.setattr(time, "monotonic", lambda: heard + 9.0)
    return watch


def test_only_a_process_that_spoke_and_fell_silent_has_hung(watch: RunMonitor) -> None:
    assert watch.has_hung("policy", 77, 8.0)
    assert not watch.has_hung("policy", 77, 10.0), "not yet"
    assert not watch.has_hung("policy", 78, 8.0), "a new process that is still starting"
    assert not watch.has_hung("adaptation", 77, 8.0), "was never heard"


@pytest.mark.processes
def test_an_order_that_a_busy_filter_answers_late_was_taken(free_port: int) -> None:
    """Else the robot would be ended while the filter brakes it, and its watchdog would brake it a second time."""
    endpoint = f"tcp/127.0.0.1:{free_port}"

    def answer(robot: str, request: Request) -> Answer:
        time.sleep(0.9)
        return Answer(ok=True, sentence=f"{robot}: {request.do}")

    with (
        Bus(ZenohTransport(ZenohSettings(listen=(endpoint,))), "f") as supervisor,
        Bus(ZenohTransport(ZenohSettings(connect=(endpoint,))), "f") as filtering,
    ):
        filtering.answer_requests(answer, kinds=(ORDER,))
        watch = RunMonitor(supervisor)
        watch.state = CarRobot(Scene.random(1)).state_message()
        end = time.monotonic() + 30.0
        while not watch.stop_robot():  # repeated while the filter is not known yet
            assert time.monotonic() < end, "it does not wait for the filter's answer"
            time.sleep(0.01)


def test_a_hung_process_is_ended_at_once_and_counts_as_dead(tmp_path: Path) -> None:
    (tmp_path / "hangs.py").write_text("import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\ninput()\n")
    child = Child("hangs", "hangs", (), tmp_path / "log")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path))
        child.start()
    assert child.exit_code is None
    child.kill()
    assert child.exit_code == -signal.SIGKILL
    child.kill()  # again: nothing
    child.end(1.0)


class HeldUp:
    """A robot that is answered at once; its clock jumps by ``pause`` s while tick ``at`` is under way."""

    def __init__(self, file: Path, pause: float = 0.0, at: int = 3) -> None:
        broker = MemoryBroker()
        self.now, self._pause, self._at = 0.0, pause, at
        self._filter = MemoryTransport(broker)
        self._filter.subscribe("safedpa/test/r1/state", self._on_state)
        self._sender = Bus(self._filter, "test")
        self.robot = CarRobot(Scene.random(1), lockstep=False, epoch=9)
        with TraceWriter(file) as trace:
            RobotLoop(self.robot, Bus(MemoryTransport(broker), "test"), "r1", self._clock, trace=trace).run(
                lambda: False, 8
            )

    def _clock(self) -> float:
        self.now += 0.001
        return self.now

    def _on_state(self, _: str, payload: bytes) -> None:
        state = decode(STATE.message, payload)
        assert isinstance(state, StateMessage)
        action = ActionMessage(epoch=state.epoch, tick=state.tick, robot_time=0.0, publish_time=0.0, values=(1.0, 0.1))
        self._sender.publish(ACTION, "r1", action)
        if state.tick == self._at:
            self.now += self._pause  # SIGSTOP: the answer waits in the process, which does not run


def test_every_period_leaves_a_line(tmp_path: Path) -> None:
    robot = HeldUp(tmp_path / "trace").robot
    periods = list(read_trace(tmp_path / "trace"))
    assert ([one.tick for one in periods], {one.applied_by for one in periods}) == (list(range(8)), {"filter"})
    assert all((one.action_epoch, one.action_tick) == (9, one.tick) for one in periods)
    assert all(0.0 < one.age <= 2 * robot.period for one in periods)
    assert periods[3].applied == (1.0, 0.1)


def test_a_robot_that_was_held_up_does_not_act_on_what_it_saw_before(tmp_path: Path) -> None:
    robot = HeldUp(tmp_path / "trace", pause=2.0).robot
    periods = list(read_trace(tmp_path / "trace"))
    assert ([one.tick for one in periods if one.applied_by == "watchdog"], periods[3].action_tick) == ([3], -1)
    assert periods[3].age > 2.0
    assert robot.guard.refusals == {"too old": 1}


def test_a_short_delay_of_the_process_costs_nothing(tmp_path: Path) -> None:
    robot = HeldUp(tmp_path / "trace", pause=0.05).robot
    assert robot.watchdog_ticks == 0


def test_a_line_that_a_killed_robot_did_not_finish_is_left_out(tmp_path: Path) -> None:
    HeldUp(tmp_path / "trace")
    whole = (tmp_path / "trace").read_bytes()
    (tmp_path / "trace").write_bytes(whole[:-7])
    assert [one.tick for one in read_trace(tmp_path / "trace")] == list(range(7))


def test_a_trace_that_cannot_be_written_is_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="--trace"):
        TraceWriter(tmp_path / "nowhere" / "trace")
