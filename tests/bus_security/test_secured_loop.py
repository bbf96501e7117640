"""The whole closed loop as processes over mutual TLS and access control, while it is attacked."""

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import HEALTH, ActionMessage, Bus, HealthMessage, ReceivedMessage
from safedpa.bus.messages.codec import decode
from safedpa.dynamics import load_model
from safedpa.errors import MessageError
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

pytestmark = pytest.mark.processes

SERVICES = ("adaptation", "policy", "safety_filter")
SECONDS = 4.0
SEED = 3
PATIENCE = 180.0
"""s; for a robot and its services to start and to drive, on a busy machine."""
CAPTURE, TOO_LARGE = b"\x81\xa5epoch\x01", bytes(70_000)


class Process:
    """A process of the fleet with its lines on standard error."""

    def __init__(self, module: str, *options: str) -> None:
        command = [sys.executable, "-m", module, *options, "--supervised"]
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.running = subprocess.Popen(command, text=True, **pipes)
        self.events: list[dict[str, Any]] = []
        self.notice: list[str] = []
        self._readers = [
            threading.Thread(target=self._hear, args=(pipe,), daemon=True)
            for pipe in (self.running.stdout, self.running.stderr)
        ]
        for reader in self._readers:
            reader.start()

    def _hear(self, pipe: Any) -> None:
        for line in pipe:
            self.notice.append(line)
            if line.startswith('{"time"'):
                self.events.append(json.loads(line))

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.events if event["kind"] == kind]

    def end(self) -> None:
        self.running.terminate()
        self.running.wait(60.0)
        for reader in self._readers:
            reader.join(60.0)
        for pipe in (self.running.stdin, self.running.stdout, self.running.stderr):
            pipe.close()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def start(stack: ExitStack, module: str, *options: str) -> Process:
    process = Process(module, *options)
    stack.callback(process.end)
    return process


def router(stack: ExitStack, network: Any) -> Process:
    robots = [option for robot in network.robots for option in ("--robot", robot)]
    options = ("--listen", network.endpoint, "--certificates", str(network.folder), "--fleet", network.fleet, *robots)
    process = start(stack, "safedpa_services.router", *options)
    assert network.until(lambda: process.of("router.open")), process.notice
    return process


def member(network: Any, role: str) -> tuple[str, ...]:
    bus = ("--fleet", network.fleet, "--connect", network.endpoint)
    return (*bus, "--certificates", str(network.folder), "--role", role)


def undisturbed() -> str:
    """The trajectory of the same robot with the same nodes, in memory."""
    model = load_model("car")
    filtering = SafetyFilterNode(model, settings_named("car"), margin_for(model, ""))
    robot = CarRobot(Scene.random(SEED, "none"))
    for _ in drive(robot, (AdaptationNode(model), PolicyNode(model), filtering), round(SECONDS * 20)):
        pass
    return robot.trajectory_hash


def attack(network: Any, stop: threading.Event) -> None:
    """Everybody but the filter commands the robot, and the filter itself sends what is larger than an action."""
    sessions = {role: network.raw(role) for role in ("intruder", "policy", "robot.r2", "recorder")}
    filtering = network.raw("safety_filter")
    while not stop.wait(0.02):
        for session in sessions.values():
            session.put("safedpa/f/r1/action", CAPTURE)
            session.put("safedpa/f/r1/state", CAPTURE)
        filtering.put("safedpa/f/r1/action", TOO_LARGE)


@pytest.mark.long
def test_it_drives_as_without_an_attack(network: Any, stack: ExitStack) -> None:
    routing = router(stack, network)
    services = [start(stack, f"safedpa_services.{name}", *member(network, name)) for name in SERVICES]
    stop = threading.Event()
    attacker = threading.Thread(target=attack, args=(network, stop), daemon=True)
    attacker.start()
    stack.callback(attacker.join, 5.0)
    stack.callback(stop.set)
    operator = Bus(network.join("operator"), network.fleet)
    inbox = operator.inbox((HEALTH,), "-")
    drives = ("--name", "r1", "--lockstep", "--seconds", str(SECONDS), "--seed", str(SEED))
    robot = start(stack, "safedpa_sim.robots", *member(network, "robot.r1"), *drives)
    assert robot.running.wait(PATIENCE) == 0, robot.notice
    assert network.until(lambda: any(line.startswith('{"ticks"') for line in robot.notice))
    account = next(json.loads(line) for line in robot.notice if line.startswith('{"ticks"'))
    assert account["trajectory_sha256"] == undisturbed()
    # A robot in lockstep that waits for long repeats its state, which is answered again: that answer alone may be late.
    assert set(account["refusals"]) <= {"late", "repeated"}, "nothing of it reached the robot"
    for sent in (CAPTURE, TOO_LARGE):  # would have been refused as no message, and under no other word
        with pytest.raises(MessageError):
            decode(ActionMessage, sent)
    assert {event["service"] for event in routing.of("bus.denied")} == {"intruder", "policy", "robot.r2", "recorder"}
    assert {event["service"] for event in routing.of("bus.too_large")} == {"safety_filter"}
    for event in routing.of("bus.denied"):
        assert event["key"] in ("safedpa/f/r1/action", "safedpa/f/r1/state")
    heartbeats: list[HealthMessage] = []

    def counted() -> bool:
        heartbeats.extend(
            item.message
            for item in inbox.take(0.1)
            if isinstance(item, ReceivedMessage) and item.key.endswith("/router")
        )
        return bool(heartbeats) and heartbeats[-1].refused > 10

    assert network.until(counted)
    assert all(service.running.poll() is None for service in services)


@pytest.mark.long
def test_no_role_is_denied_what_it_needs(network: Any, stack: ExitStack, tmp_path: Path) -> None:
    """Every process of a fleet, with its own role: the router denies none of them anything."""
    routing = router(stack, network)
    for name in (*SERVICES, "diagnosis"):
        start(stack, f"safedpa_services.{name}", *member(network, name))
    record = ("--out", str(tmp_path / "recording.mcap"))
    start(stack, "safedpa_services.recorder", *member(network, "recorder"), *record)
    drives = ("--name", "r1", "--lockstep", "--seconds", "2")
    robot = start(stack, "safedpa_sim.robots", *member(network, "robot.r1"), *drives)
    assert robot.running.wait(PATIENCE) == 0, robot.notice
    check = start(stack, "safedpa_services.healthcheck", "router", *member(network, "healthcheck"), "--seconds", "60")
    assert check.running.wait(PATIENCE) == 0, check.notice
    everybody = {*SERVICES, "diagnosis", "recorder", "robot.r1", "healthcheck"}
    assert network.until(lambda: everybody <= {event["service"] for event in routing.of("bus.joined")}), routing.notice
    assert not routing.of("bus.denied"), routing.of("bus.denied")
    assert not routing.of("bus.too_large")
    assert not routing.of("bus.handshake_refused")


def test_a_copied_certificate_is_seen(network: Any, stack: ExitStack) -> None:
    routing = router(stack, network)
    for _ in range(2):
        network.join("safety_filter")
    assert network.until(lambda: routing.of("bus.duplicate_certificate"))
    assert routing.of("bus.duplicate_certificate")[0]["service"] == "safety_filter"


def test_a_refused_handshake_is_reported(network: Any, stack: ExitStack) -> None:
    routing = router(stack, network)
    import socket

    host, port = network.endpoint.removeprefix("tls/").split(":")
    with socket.create_connection((host, int(port))) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert network.until(lambda: routing.of("bus.handshake_refused"))
