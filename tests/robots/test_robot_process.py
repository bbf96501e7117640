"""The robot as a process on a real bus."""

import json
import signal
import subprocess
import sys
import time
from math import inf
from pathlib import Path

import pytest

from safedpa.bus import (
    ACTION,
    STATE,
    ActionMessage,
    Bus,
    Inbox,
    ReceivedMessage,
    StateMessage,
    ZenohSettings,
    ZenohTransport,
)
from safedpa.bus.transport.ports import free_port

pytestmark = pytest.mark.processes

ROBOT = (sys.executable, "-m", "safedpa_sim.robots")


@pytest.fixture
def bus(free_endpoint):
    with Bus(ZenohTransport(ZenohSettings(listen=(free_endpoint,))), "test") as opened:
        yield opened


@pytest.fixture
def free_endpoint():
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def start(free_endpoint):
    """Starts a robot with some options; processes that still run after the test are killed."""
    started: list[subprocess.Popen[str]] = []

    def starter(*options: str) -> subprocess.Popen[str]:
        command = (*ROBOT, "--fleet", "test", "--connect", free_endpoint, *options)
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield starter
    for robot in started:
        if robot.poll() is None:
            robot.kill()
            robot.communicate()


def answer(bus: Bus, robot: subprocess.Popen[str], ticks: int, speed: float = -inf) -> list[StateMessage]:
    """Drives the robot for some ticks and until it reaches a speed; returns the received states."""
    inbox, states = bus.inbox((STATE,), "r1"), []
    for _ in range(600):
        for item in inbox.take(0.1):
            assert isinstance(item, ReceivedMessage)
            state = item.message
            assert isinstance(state, StateMessage)
            states.append(state)
            message = ActionMessage(
                epoch=state.epoch, tick=state.tick, robot_time=0.0, publish_time=0.0, values=(1.2, 0.05)
            )
            bus.publish(ACTION, "r1", message)
            if state.tick >= ticks - 1 and state.values[3] > speed:
                return states
        assert robot.poll() is None, robot.communicate()
    raise AssertionError("the robot did not come so far, or so fast")


def slower_than(speed: float, inbox: Inbox) -> bool:
    """Returns whether such a state is received; the last one of a process may arrive after its end."""
    patience = time.monotonic() + 60.0
    while time.monotonic() < patience:
        for item in inbox.take(0.1):
            assert isinstance(item, ReceivedMessage)
            assert isinstance(item.message, StateMessage)
            if abs(item.message.values[3]) < speed:
                return True
    return False


def reported(errors: str) -> list[str]:
    """Returns the kinds of the events on standard error, which may contain nothing else."""
    return [json.loads(line)["kind"] for line in errors.splitlines()]


def test_a_lockstep_run_ends_with_a_summary_and_repeats(bus, start, tmp_path):
    hashes = set()
    for run in range(2):
        path = tmp_path / f"{run}.json"
        robot = start("--lockstep", "--seconds", "2", "--seed", "3", "--summary", str(path))
        answer(bus, robot, 40)
        output, errors = robot.communicate(timeout=60)
        assert robot.returncode == 0
        assert reported(errors) == ["process.started", "process.ended"]
        account = json.loads(path.read_text())
        assert account == json.loads(output)
        assert (account["ticks"], account["watchdog_ticks"], account["end"]) == (40, 0, "time is over")
        assert 0.0 < account["latency_us"]["p50"] <= account["latency_us"]["p99"]
        hashes.add(account["trajectory_sha256"])
    assert len(hashes) == 1


def test_sigterm_brakes_first(bus, start):
    robot = start("--rate", "50")
    answer(bus, robot, 30, 0.5)  # on a busy machine actions may be late, and the watchdog brakes
    inbox = bus.inbox((STATE,), "r1")
    robot.send_signal(signal.SIGTERM)
    output, errors = robot.communicate(timeout=60)
    assert robot.returncode == 0
    assert set(reported(errors)) <= {
        "process.started",
        "message.refused",
        "process.ended",
    }  # late actions on a busy machine
    account = json.loads(output)
    assert account["end"] == "SIGTERM"
    assert account["watchdog_ticks"] > 3
    assert slower_than(0.2, inbox)


def test_a_second_robot_of_the_same_name_is_refused_in_one_line(bus, start):
    first = start()
    answer(bus, first, 1)
    second = start()
    output, errors = second.communicate(timeout=60)
    assert (second.returncode, output) == (2, "")
    assert errors.count("\n") == 1
    assert "'r1' of fleet 'test' is already running" in errors
    assert first.poll() is None


def test_of_two_robots_that_start_at_once_one_stays(bus, start):
    pair = [start(), start()]
    patience = time.monotonic() + 60.0
    while all(robot.poll() is None for robot in pair) and time.monotonic() < patience:
        time.sleep(0.05)
    (stays,) = [robot for robot in pair if robot.poll() is None]
    inbox = bus.inbox((STATE,), "r1")
    assert any(inbox.take(0.1) for _ in range(600)), "it drives"
    stays.send_signal(signal.SIGTERM)
    outcomes = [robot.communicate(timeout=60) for robot in pair]
    assert sorted(robot.returncode for robot in pair) == [0, 2], outcomes


@pytest.mark.long
@pytest.mark.parametrize(
    "options", [("--rate", "0"), ("--seconds", "-1"), ("--seconds", "nan"), ("--seed", "-3"), ("--name", "a/b")]
)
def test_bad_options_are_one_line_and_exit_code_two(options, start, bus):
    robot = start(*options)
    output, errors = robot.communicate(timeout=60)
    assert (robot.returncode, output) == (2, "")
    assert errors.count("\n") == 1


def test_a_summary_that_cannot_be_written_is_refused_at_the_start(tmp_path: Path, start, bus):
    robot = start("--summary", str(tmp_path / "nowhere" / "a.json"))
    _, errors = robot.communicate(timeout=60)
    assert robot.returncode == 2
    assert "--summary" in errors
