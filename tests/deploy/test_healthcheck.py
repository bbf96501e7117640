"""The health check says healthy for progress alone: not for silence, not for a loop that only breathes."""

from __future__ import annotations

import subprocess
import sys

import pytest

from safedpa.bus import HEALTH, NO_ROBOT, Bus, HealthMessage, MemoryBroker, MemoryTransport
from safedpa_services.healthcheck.__main__ import HealthCheck


def beat(bus: Bus, at: float, steps: int, **other: object) -> None:
    """A heartbeat of the policy of robot r1, but for what is given."""
    robot = str(other.pop("robot", "r1"))
    plain = {"service": "policy", "pid": 7, "state": "running", "detail": ""}
    message = HealthMessage(epoch=1, tick=steps, robot_time=0.0, publish_time=at, steps=steps, **{**plain, **other})
    bus.publish(HEALTH, robot, message, message.service)


READY = {"state": "ready", "robot": NO_ROBOT}
FAILING = {"state": "failing", "detail": "disk full"}
SILENT = "policy: no two heartbeats within 0 s"


@pytest.mark.parametrize(
    ("beats", "said"),
    [
        ([(1.0, 10, {}), (1.25, 15, {})], ""),
        ([(1.0, 0, READY), (1.25, 0, READY)], ""),
        ([], SILENT),
        ([(1.0, 10, {}), (1.0, 10, {})], SILENT),
        ([(1.0, 10, {}), (1.25, 10, {})], "policy: alive, but it made no step after step 10"),
        ([(1.0, 10, FAILING), (1.25, 15, FAILING)], "policy: failing, disk full"),
        ([(1.0, 10, {"pid": 7}), (1.25, 15, {"pid": 8})], SILENT),
        ([(1.0, 10, {"service": "adaptation"}), (1.25, 15, {"service": "adaptation"})], SILENT),
    ],
    ids=[
        "steps that grow", "waiting for a robot", "silence", "one heartbeat twice", "alive without steps", "failing",
        "two processes", "another service",
    ],
)  # fmt: skip
def test_only_progress_between_two_heartbeats_of_one_process_is_healthy(
    beats: list[tuple[float, int, dict[str, object]]], said: str
) -> None:
    broker = MemoryBroker()
    check, bus = HealthCheck(Bus(MemoryTransport(broker), "fleet"), "policy"), Bus(MemoryTransport(broker), "fleet")
    for at, steps, other in beats:
        beat(bus, at, steps, **other)
    assert check.run(0.0) == said


def test_another_robot_does_not_count() -> None:
    broker = MemoryBroker()
    bus = Bus(MemoryTransport(broker), "fleet")
    check = HealthCheck(Bus(MemoryTransport(broker), "fleet"), "policy", "r2")
    for robot, said in (("r1", SILENT), ("r2", "")):
        beat(bus, 1.0, 10, robot=robot)
        beat(bus, 1.25, 15, robot=robot)
        assert check.run(0.0) == said


@pytest.mark.processes
def test_as_a_process_it_ends_with_one_in_silence(free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    command = [sys.executable, "-m", "safedpa_services.healthcheck", "policy", "--seconds", "0.2", "--listen", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout) == (1, "policy: no two heartbeats within 0.2 s\n")
