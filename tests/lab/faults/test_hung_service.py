"""The supervisor replaces a service that lives and does not work, and no other one."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from safedpa.bus import (
    HEALTH,
    NO_ROBOT,
    Answer,
    Bus,
    HealthMessage,
    MemoryBroker,
    MemoryTransport,
    Request,
    ZenohSettings,
    ZenohTransport,
)
from safedpa.bus.wire.requests import ORDER
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.watch import Watch
from safedpa_sim.robots import CarRobot, Scene


def told(service: str, pid: int) -> HealthMessage:
    return HealthMessage(
        epoch=0, tick=0, robot_time=0.0, publish_time=0.0, service=service, pid=pid, state="running"
    )  # fmt: skip


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watch:
    broker = MemoryBroker()
    watch = Watch(Bus(MemoryTransport(broker), "test"))
    sender = Bus(MemoryTransport(broker), "test")
    sender.publish(HEALTH, NO_ROBOT, told("policy", 77), "policy")
    watch.listen(0.0)
    heard = watch.health["policy"][1]
    monkeypatch.setattr(time, "monotonic", lambda: heard + 9.0)
    return watch


def test_only_a_process_that_spoke_and_fell_silent_has_hung(watch: Watch) -> None:
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
        watch = Watch(supervisor)
        watch.state = CarRobot(Scene.random(1)).state_message()
        end = time.monotonic() + 30.0
        while not watch.stop_robot():  # told at once while the filter is not known yet
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
