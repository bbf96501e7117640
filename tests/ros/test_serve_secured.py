"""``safedpa serve`` over mutual TLS: with temporary certificates or the user's; others are refused."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.certificates import Certificates
from safedpa.bus.transport import ports
from safedpa.errors import BusError
from safedpa_lab.ros.side import Side, robot_file
from safedpa_services.command_line.group import safedpa

BY_ITSELF = 'format = 2\nrobot = "car"\nname = "r1"\n'
QUIET = ("--headless", "--no-diagnosis")


def certificates(folder: Path, *robots: str) -> str:
    named = [word for robot in robots for word in ("--robot", robot)]
    assert safedpa.run(["certificates", str(folder), *named]) == 0
    return str(folder)


def await_that(true: Callable[[], object]) -> None:
    end = time.monotonic() + 120.0
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


@contextmanager
def served(folder: Path, file: Path, *options: str, wanted: Sequence[str]) -> Iterator[Callable[[str], str]]:
    """Runs the command; yields once ``wanted`` are on the bus, and ends it in order.

    The yielded function returns the log of a process by its name.
    """
    phrase = [sys.executable, "-m", "safedpa_services", "serve", str(file), *QUIET, "--out", str(folder / "runs")]
    notice = folder / "serve.log"
    with notice.open("wb") as log, subprocess.Popen([*phrase, *options], stdout=log, stderr=log) as process:

        def reports(name: str) -> str:
            paths = [notice] if name == "serve" else list((folder / "runs").glob(f"*/{name}.log"))
            return "".join(path.read_text(encoding="utf-8") for path in paths)

        try:
            for name in wanted:  # the logs are there long before
                await_that(lambda name=name: "is on the bus" in reports(name) or process.poll() is not None)
            yield reports
            process.send_signal(signal.SIGINT)
            assert process.wait(60.0) == 0, reports("serve")
        finally:
            process.kill()


def endpoint_in(log: str) -> str:
    events = [json.loads(line) for line in log.splitlines() if line.startswith("{")]
    opened = next(event for event in events if event["kind"] == "router.open")
    return str(opened["sentence"]).split(" on ")[1]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.parametrize("own", [False, True])
def test_a_ros_robot_drives_and_a_foreign_certificate_is_refused(side: Side, tmp_path: Path, own: bool) -> None:
    shown = ("--certificates", certificates(tmp_path / "own", "r1")) if own else ("--secure",)
    car = side.car(8.0, 11)
    file = robot_file(tmp_path / "r.toml", side.endpoint, 11)
    with served(tmp_path, file, *shown, wanted=("adaptation", "safety_filter", "robot")) as reports:
        endpoint = endpoint_in(reports("router"))
        foreign = Certificates(Path(certificates(tmp_path / "foreign", "r1")), "safety_filter")
        with pytest.raises(BusError, match="could not open"):
            ZenohTransport(ZenohSettings("client", (), (endpoint,), foreign, connect_timeout=3.0))
        car.send("go")
        if own:  # as a container's health check asks, again and again; a busy machine answers late
            assert any(healthy(endpoint, shown[1]) for _ in range(3)), reports("robot")
        found = car.reported()
    assert found["collisions"] == 0, reports("robot")
    assert found["moved"] > 0.3, reports("robot") + reports("serve")
    assert "bus.denied" not in reports("router"), "everybody may do what he has to do"
    assert "bus.handshake_refused" in reports("router")
    assert "the filter drives" in reports("serve")


def healthy(endpoint: str, folder: str) -> bool:
    phrase = ["robot", "--robot", "r1", "--connect", endpoint, "--certificates", folder, "--role", "healthcheck"]
    return not subprocess.run([sys.executable, "-m", "safedpa_services.healthcheck", *phrase], check=False).returncode


def robot(endpoint: str, folder: str, name: str, seconds: str) -> subprocess.CompletedProcess[str]:
    phrase = ["--name", name, "--seed", "3", "--seconds", seconds, "--connect", endpoint]
    shown = ["--certificates", folder, "--role", f"robot.{name}"]
    command = [sys.executable, "-m", "safedpa_sim.robots", *phrase, *shown]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=180)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_a_robot_joins_the_bus_with_its_own_key_and_another_key_moves_nothing(tmp_path: Path) -> None:
    folder, file = certificates(tmp_path / "own", "r1", "r2"), tmp_path / "robot.toml"
    (tmp_path / "own" / "robot.r1.key.pem").rename(tmp_path / "r1.key")  # it lies on the robot
    file.write_text(BY_ITSELF, encoding="utf-8")
    port = ports.free_port()
    where = ("--certificates", folder, "--listen", f"tls/0.0.0.0:{port}", "--policy", "goal_seeker")
    with served(tmp_path, file, *where, wanted=("adaptation", "policy", "safety_filter")) as reports:
        (tmp_path / "r1.key").rename(tmp_path / "own" / "robot.r1.key.pem")
        accounts: list[dict[str, Any]] = []
        for name, seconds in (("r2", "2"), ("r1", "5")):
            done = robot(f"tls/127.0.0.1:{port}", folder, name, seconds)
            assert done.stdout, done.stderr
            accounts.append(json.loads(done.stdout.splitlines()[-1]))
    another, known = accounts
    assert another["watchdog_ticks"] == another["ticks"], "no one answers a robot that was not named"
    assert known["ticks"] == 100
    assert known["watchdog_ticks"] < 60
    assert known["collisions"] == 0
    assert "with the certificate of role robot.r1" in reports("serve")
    assert "'safedpa/fleet/r2/state'" in reports("router")


def refused(capsys: pytest.CaptureFixture[str], *phrase: str) -> str:
    assert safedpa.run(["serve", *phrase, *QUIET, "--policy", "goal_seeker"]) == 2
    return capsys.readouterr().err


def test_conflicting_options_are_refused_before_anything_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file, folder = tmp_path / "robot.toml", certificates(tmp_path / "own", "r1")
    file.write_text(BY_ITSELF, encoding="utf-8")
    phrase = (str(file), "--out", str(tmp_path / "runs"))
    assert "--secure: got it for a robot that joins the bus itself" in refused(capsys, *phrase, "--secure")
    both = refused(capsys, *phrase, "--secure", "--certificates", folder)
    assert "--secure: got it together with --certificates" in both
    plain = refused(capsys, *phrase, "--certificates", folder, "--listen", "tcp/0.0.0.0:7447")
    assert "--listen: got 'tcp/0.0.0.0:7447' with certificates, wanted tls/HOST:PORT" in plain
    (tmp_path / "own" / "safety_filter.key.pem").unlink()
    missing = refused(capsys, *phrase, "--certificates", folder)
    assert "safety_filter.key.pem: does not exist; create it with 'safedpa certificates" in missing
    assert "authority.pem: does not exist" in refused(capsys, *phrase, "--certificates", str(tmp_path / "nowhere"))
