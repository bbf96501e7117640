"""A real run with a robot, a service or the supervisor hung or killed, as another process on the bus sees it."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from safedpa.bus import Bus, ZenohSettings, ZenohTransport
from safedpa.bus.monitor import FleetOverview, fleet_alerts, headline
from safedpa_services.command_line.status import document_of
from safedpa_services.metrics.exporter import FleetCollector

pytestmark = [pytest.mark.long, pytest.mark.slow, pytest.mark.processes]

PATIENCE = 60.0
"""s; all processes of a run start on a busy machine."""
ABSENT = ("silent", "missing", "no heartbeat", "no verdict", "sends no state", "no supervisor")
LIMIT = 2.0 + 1.0
"""s; 2 s are promised, and this machine may do other work meanwhile."""


class Run:
    """A run of ``safedpa up``, and an observer in this process."""

    def __init__(self, folder: Path) -> None:
        options = ("--headless", "--no-diagnosis", "--out", str(folder / "run"))
        command = [sys.executable, "-m", "safedpa_services", "up", *options]
        self.output = folder / "up.txt"
        with self.output.open("wb") as log:
            self.up = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)
        self.until(lambda: "--connect" in self.printed(), "no endpoint")
        self.endpoint = re.findall(r"--connect (\S+)", self.printed())[0]

    def printed(self) -> str:
        return self.output.read_text()

    def until(self, done: Callable[[], bool], what: str, longest: float = PATIENCE) -> float:
        began = time.monotonic()
        while not done():
            assert time.monotonic() - began < longest, f"{what} within {longest:.0f} s: {self.printed()[-2000:]}"
            time.sleep(0.05)
        return time.monotonic() - began

    def command(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "safedpa_services", *arguments, "--connect", self.endpoint]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60.0)

    def pid_of(self, name: str) -> int:
        if name == "supervisor":
            return self.up.pid
        module = "safedpa_sim.robots" if name == "robot" else f"safedpa_services.{name}"
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                parts = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdecimal() else []
                if module.encode() in parts and self.endpoint.encode() in parts:
                    return int(entry.name)
        raise AssertionError(f"no process {name}")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    made = Run(tmp_path_factory.mktemp("run"))
    try:
        yield made
    finally:
        made.up.send_signal(signal.SIGCONT)
        made.up.send_signal(signal.SIGINT)
        made.up.wait(60.0)


@pytest.mark.parametrize(("victim", "number"), [
    ("robot", signal.SIGSTOP), ("adaptation", signal.SIGSTOP), ("policy", signal.SIGSTOP),
    ("safety_filter", signal.SIGSTOP), ("recorder", signal.SIGSTOP), ("safety_filter", signal.SIGKILL),
    ("robot", signal.SIGKILL), ("supervisor", signal.SIGSTOP),
])  # fmt: skip
def test_who_hangs_or_dies_is_trouble_within_two_seconds_and_until_it_returns(run: Run, victim: str, number: int):
    settings = ZenohSettings("client", connect=(run.endpoint,))
    with Bus(ZenohTransport(settings), "fleet") as bus:
        fleet = FleetOverview(bus)

        def about() -> list[str]:
            fleet.listen(0.1)
            lines = [f"{a.robot} {a.service} {a.sentence}" for a in fleet_alerts(fleet) if a.level == "trouble"]
            return [line for line in lines if any(word in line for word in ABSENT)]

        def robot_metric(name: str) -> float:
            samples = [s for family in FleetCollector(fleet).collect() for s in family.samples if s.name == name]
            return samples[0].value if samples else -1.0

        run.until(lambda: not about() and bool(fleet.robots), "not healthy")
        pid = run.pid_of(victim)
        os.kill(pid, number)
        if number == signal.SIGKILL:
            _judge_restart(run, victim, about)
            return
        seen = run.until(lambda: bool(about()), f"{victim}: no trouble", LIMIT)
        for _ in range(25):  # it stays right while it lasts
            assert about(), f"healthy although {victim} hangs"
            assert not document_of(fleet)["healthy"]
        now, robot = fleet.clock(), fleet.robots["r1"]
        if victim in ("robot", "safety_filter", "supervisor"):
            assert headline(now - robot.state_at, now - robot.verdict_at)
            assert robot_metric("safedpa_barrier_value") == -1.0, "an old h is not exported"
            assert robot_metric("safedpa_robot_healthy") == 0.0
        if victim != "supervisor":
            word = "r1: missing" if victim == "robot" else f"{victim}: missing"
            assert word in run.printed(), "the terminal says so"
            done = run.command("status", "--json")
            assert done.returncode == 1, "a status that joins later is right, too"
            assert not json.loads(done.stdout)["healthy"]
        os.kill(pid, signal.SIGCONT)
        left: list[str] = []

        def well() -> bool:
            left[:] = about()
            return not left

        try:
            back = run.until(well, f"{victim}: still trouble", 30.0)
        except AssertionError as error:
            raise AssertionError(f"{left}") from error
        print(f"{victim}: trouble after {seen:.1f} s, well {back:.1f} s after its return")


def test_a_dismissed_robot_is_no_trouble_and_stop_names_a_robot_that_did_not_answer(run: Run) -> None:
    pid = run.pid_of("robot")
    os.kill(pid, signal.SIGSTOP)
    try:
        time.sleep(2.5)
        assert run.command("stop").returncode == 1
        assert "r1: did not answer" in run.command("stop").stdout
        dismissed = run.command("dismiss", "r1", "policy", "--who", "Ann")
        assert (dismissed.returncode, dismissed.stdout) == (1, "r1: dismissed by Ann, until it returns\n")
        assert "policy: not missing" in dismissed.stderr
        status = run.command("status")
        assert status.returncode == 0, status.stdout
        assert "dismissed by Ann" in status.stdout
    finally:
        os.kill(pid, signal.SIGCONT)
        run.command("go")


def _judge_restart(run: Run, victim: str, about: Callable[[], list[str]]) -> None:
    """A killed process is restarted; the cause is on the terminal, and the trouble ends by itself."""
    run.until(lambda: f"{victim} was restarted" in run.printed(), "no restart reported", 20.0)
    assert "killed by signal 9 (SIGKILL)" in run.printed()
    run.until(lambda: not about(), f"{victim}: still trouble")
