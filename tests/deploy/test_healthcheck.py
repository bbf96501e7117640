"""The health check says healthy for progress alone: not for silence, not for a loop that only breathes."""

from __future__ import annotations

import subprocess
import sys

import pytest

from safedpa.bus import HEALTH, NO_ROBOT, Bus, HealthMessage, MemoryBroker, MemoryTransport
from safedpa_services.healthcheck.__main__ import HealthCheck


class Service:
    """Sends heartbeats of a policy by hand."""

    def __init__(self, broker: MemoryBroker) -> None:
        self._bus = Bus(MemoryTransport(broker), "fleet")

    def beat(
        self, at: float, steps: int, state: str = "running", robot: str = "r1", service: str = "policy", pid: int = 7
    ) -> None:
        message = HealthMessage(
            epoch=1,
            tick=steps,
            robot_time=0.0,
            publish_time=at,
            service=service,
            pid=pid,
            state=state,
            detail="disk full" if state == "failing" else "",
            steps=steps,
        )
        self._bus.publish(HEALTH, robot, message, service)


@pytest.fixture
def broker() -> MemoryBroker:
    return MemoryBroker()


@pytest.fixture
def service(broker: MemoryBroker) -> Service:
    return Service(broker)


@pytest.fixture
def check(broker: MemoryBroker) -> HealthCheck:
    return HealthCheck(Bus(MemoryTransport(broker), "fleet"), "policy")


def test_steps_that_grow_between_two_heartbeats_are_healthy(service: Service, check: HealthCheck) -> None:
    service.beat(1.0, 10)
    service.beat(1.25, 15)
    assert check.run(0.0) == ""


def test_a_service_that_waits_for_a_robot_is_healthy_without_steps(service: Service, check: HealthCheck) -> None:
    service.beat(1.0, 0, "ready", NO_ROBOT)
    service.beat(1.25, 0, "ready", NO_ROBOT)
    assert check.run(0.0) == ""


def test_silence_is_not_healthy(check: HealthCheck) -> None:
    assert check.run(0.0) == "policy: no two heartbeats within 0 s"


def test_one_heartbeat_is_no_progress_even_when_it_comes_twice(service: Service, check: HealthCheck) -> None:
    service.beat(1.0, 10)
    service.beat(1.0, 10)
    assert "no two heartbeats" in check.run(0.0)


def test_a_loop_that_breathes_but_does_not_step_is_not_healthy(service: Service, check: HealthCheck) -> None:
    service.beat(1.0, 10)
    service.beat(1.25, 10)
    assert check.run(0.0) == "policy: alive, but it made no step after step 10"


def test_a_service_that_says_failing_is_not_healthy(service: Service, check: HealthCheck) -> None:
    service.beat(1.0, 10, "failing")
    service.beat(1.25, 15, "failing")
    assert check.run(0.0) == "policy: failing, disk full"


def test_heartbeats_of_two_processes_prove_nothing_together(service: Service, check: HealthCheck) -> None:
    service.beat(1.0, 10, pid=7)
    service.beat(1.25, 15, pid=8)
    assert "no two heartbeats" in check.run(0.0)


def test_another_service_does_not_count(service: Service, check: HealthCheck) -> None:
    service.beat(1.0, 10, service="adaptation")
    service.beat(1.25, 15, service="adaptation")
    assert "no two heartbeats" in check.run(0.0)


def test_another_robot_does_not_count(broker: MemoryBroker, service: Service) -> None:
    check = HealthCheck(Bus(MemoryTransport(broker), "fleet"), "policy", "r2")
    service.beat(1.0, 10)
    service.beat(1.25, 15)
    assert "no two heartbeats" in check.run(0.0)
    service.beat(1.0, 10, robot="r2")
    service.beat(1.25, 15, robot="r2")
    assert check.run(0.0) == ""


@pytest.mark.processes
def test_as_a_process_it_ends_with_one_in_silence(free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    command = [sys.executable, "-m", "safedpa_services.healthcheck", "policy", "--seconds", "0.2", "--listen", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout) == (1, "policy: no two heartbeats within 0.2 s\n")
