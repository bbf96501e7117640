"""Faults from outside while the loop runs: the car stays safe, and one line reports the fault."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from safedpa.bus import STATE, Bus, ZenohSettings, ZenohTransport
from safedpa.bus.transport.ports import free_port
from safedpa.errors import BusError
from safedpa.records import read_messages

pytestmark = [pytest.mark.long, pytest.mark.processes]


def test_a_full_disk_ends_the_recording_not_the_drive(tmp_path: Path) -> None:
    command = f"{sys.executable} -m safedpa_services up --headless --json --seconds 10 --lockstep --out {tmp_path}"
    limited = ["bash", "-c", f"ulimit -f 32; exec {command}"]  # no file may grow beyond 32 KiB
    done = subprocess.run(limited, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1, "the recording is incomplete"
    summary = json.loads(done.stdout)
    assert summary["ticks"] == 200
    assert summary["collisions"] == 0
    assert "recording.mcap" in summary["recording_error"]
    assert sum(1 for _ in read_messages(summary["recording"])) > 50, "what was written stays readable"


def _await_a_driving_robot(endpoint: str, fleet: str, running: subprocess.Popen[str]) -> None:
    """Returns once a state is heard on the bus that the running loop opened."""
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline and running.poll() is None:
        try:
            with Bus(ZenohTransport(ZenohSettings(connect=(endpoint,))), fleet) as bus:
                inbox = bus.inbox((STATE,))
                while time.monotonic() < deadline and running.poll() is None:
                    if inbox.take(0.5):
                        return
        except BusError:
            continue  # the loop has not opened its endpoint yet
    raise AssertionError("the robot never drove")


def test_a_second_robot_of_the_same_name_is_refused(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    first = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--json", "--seconds", "0"]
    first += ["--listen", endpoint, "--out", str(tmp_path), "--fleet", "twins"]
    with subprocess.Popen(first, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        try:
            _await_a_driving_robot(endpoint, "twins", running)
            second = [sys.executable, "-m", "safedpa_sim.robots", "--name", "r1", "--seconds", "1", "--fleet", "twins"]
            refused = subprocess.run(
                [*second, "--connect", endpoint, "--summary", str(tmp_path / "second.json")],
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            running.send_signal(signal.SIGINT)
            output, errors = running.communicate(timeout=60)
        finally:
            running.kill()
    assert refused.returncode == 2
    assert "r1" in refused.stderr
    assert "choose another" in refused.stderr
    assert refused.stderr.count("\n") == 1
    assert running.returncode == 0, errors
    summary = json.loads(output)
    assert summary["collisions"] == 0
    assert set(summary["refusals"]) <= {"late", "too old"}, "nothing but what a busy machine is late with"
