"""docker-compose.yml keeps the bus inside, its commands make a loop that drives, and so do its containers."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

from safedpa.bus import ACTION, STATE, StateMessage
from safedpa.records import read_messages

ROOT = Path(__file__).resolve().parents[2]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
DOCKERFILE = (ROOT / "deploy" / "Dockerfile").read_text(encoding="utf-8")
LOOP = ("safety_filter", "adaptation", "policy", "recorder", "dashboard", "robot")

each_service = pytest.mark.parametrize("name", sorted(SERVICES))


def test_the_whole_loop_is_there() -> None:
    assert set(SERVICES) == set(LOOP)


@each_service
def test_a_container_may_write_nothing_but_its_scratch_space(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert [entry.split(":")[0] for entry in service["tmpfs"]] == ["/tmp"]
    assert service.get("volumes", []) == (["recordings:/recordings"] if name == "recorder" else [])


@each_service
def test_a_container_has_no_rights_to_spare(name: str) -> None:
    service = SERVICES[name]
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert not {"privileged", "cap_add", "network_mode", "pid", "ipc", "user", "devices"} & set(service)


@each_service
def test_a_container_has_limits_comes_back_and_is_checked(name: str) -> None:
    service = SERVICES[name]
    assert service["init"] is True
    assert service["restart"] == "always"
    assert {"mem_limit", "cpus", "pids_limit", "healthcheck"} <= set(service)


@each_service
def test_the_bus_is_not_published_and_the_dashboard_to_this_machine_alone(name: str) -> None:
    ports = SERVICES[name].get("ports", [])
    assert not [port for port in ports if "7447" in port]
    assert all(port.startswith("127.0.0.1:") for port in ports)
    assert bool(ports) is (name == "dashboard")


@each_service
def test_the_image_is_one_that_the_dockerfile_builds(name: str) -> None:
    built = {service["image"]: service["build"]["target"] for service in SERVICES.values() if "build" in service}
    target = built[SERVICES[name]["image"]]
    assert f"AS {target}\n" in DOCKERFILE


def test_images_run_as_an_ordinary_user_and_come_from_a_named_version() -> None:
    base = re.search(r"^ARG BASE_IMAGE=(\S+)$", DOCKERFILE, re.MULTILINE)
    assert base is not None
    assert re.fullmatch(r"python:3\.11[\w.-]*", base[1])
    assert base[1] in COMPOSE["x-arguments"]["BASE_IMAGE"]
    runtime = DOCKERFILE.split("AS runtime\n")[1]
    assert re.search(r"^USER 10001:10001$", runtime, re.MULTILINE)
    assert "USER" not in runtime.split("USER 10001:10001")[1]


def test_what_is_installed_by_name_has_a_pinned_version() -> None:
    pinned = {
        re.split("==", line)[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    }
    joined = DOCKERFILE.replace("\\\n", " ")
    named = re.findall(r"--constraint \S+((?: +[a-z][a-z-]*)+)", joined)
    assert {name for names in named for name in names.split()} <= pinned
    assert len(named) == 4


class OutsideContainers:
    """Runs the commands of the file on this machine: the same options, other endpoints, ports and folders."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder = folder
        self._stack = stack
        bus, web, grpc = _free_ports(3)
        self._places = {
            r"tcp/(safety_filter|0\.0\.0\.0|127\.0\.0\.1):7447": f"tcp/127.0.0.1:{bus}",
            r"^0\.0\.0\.0$": "127.0.0.1",
            r"^9090$": str(web),
            r"^9876$": str(grpc),
            r"^/recordings/": f"{folder}/",
            r"\$\$": "$",
        }
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self._environment = {**os.environ, "PATH": path, "PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": "1"}

    def _words(self, command: list[str]) -> list[str]:
        for pattern, place in self._places.items():
            command = [re.sub(pattern, place, word) for word in command]
        return command

    def start(self, name: str) -> subprocess.Popen[str]:
        """The process of a service; killed at the end of the test if it lives then."""
        given = SERVICES[name].get("environment", {})
        defaults = {key: re.sub(r"^\$\{\w+:-(.*)\}$", r"\1", value) for key, value in given.items()}
        with (self._folder / f"{name}.err").open("w") as errors:
            process = subprocess.Popen(
                self._words(SERVICES[name]["command"]),
                env={**self._environment, **defaults},
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        self._stack.enter_context(process)
        self._stack.callback(process.kill)
        return process

    def health(self, name: str) -> tuple[int, str]:
        """Exit code and words of the health check of a service."""
        kind, *words = SERVICES[name]["healthcheck"]["test"]
        command = ["sh", "-c", *words] if kind == "CMD-SHELL" else words
        done = subprocess.run(
            self._words(command), env=self._environment, capture_output=True, text=True, timeout=60, check=False
        )
        return done.returncode, done.stdout + done.stderr


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        probes = [stack.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in probes]


@pytest.mark.processes
def test_the_commands_of_the_file_make_a_loop_that_is_healthy_and_drives(tmp_path: Path) -> None:
    with ExitStack() as stack:
        outside = OutsideContainers(tmp_path, stack)
        processes = {name: outside.start(name) for name in LOOP}
        for name in LOOP:
            code, said = next(
                ((code, said) for code, said in (outside.health(name) for _ in range(5)) if code == 0),
                (1, (tmp_path / f"{name}.err").read_text(encoding="utf-8")),
            )
            assert code == 0, f"{name}: {said}"
        processes["policy"].kill()
        processes["policy"].wait()
        assert outside.health("policy")[0] == 1, "healthy without a process"
        robot = processes["robot"]
        robot.send_signal(signal.SIGTERM)
        account = json.loads(robot.communicate(timeout=20)[0])
        processes["recorder"].send_signal(signal.SIGTERM)
        processes["recorder"].wait(20)
    assert (account["load"], account["collisions"]) == ("box", 0)
    kinds = {key.split("/")[3] for key, _, _ in read_messages(tmp_path / "recording.mcap")}
    assert {STATE.name, ACTION.name} <= kinds


def _docker(*arguments: str, timeout: float = 60.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False)


@pytest.fixture
def compose() -> Iterator[list[str]]:
    """The command of Compose with a project of its own; what it started is gone afterwards."""
    if shutil.which("docker") is None or _docker("docker", "info").returncode != 0:
        pytest.skip("no docker engine answers here")
    program = ["docker", "compose"] if _docker("docker", "compose", "version").returncode == 0 else ["docker-compose"]
    if shutil.which(program[0]) is None:
        pytest.skip("docker is here, Compose is not")
    base = COMPOSE["x-arguments"]["BASE_IMAGE"].removeprefix("${SAFEDPA_BASE_IMAGE:-").removesuffix("}")
    if _docker("docker", "image", "inspect", base).returncode != 0:
        pytest.skip(f"the base image {base} is not here; pull it, or make it by deploy/base-image.sh")
    command = [*program, "--project-name", "safedpa-test"]
    yield command
    _docker(*command, "down", "--volumes", "--timeout", "5", timeout=120.0)


@pytest.mark.containers
@pytest.mark.slow
def test_containers_drive_and_the_loop_outlives_the_filter(compose: list[str], tmp_path: Path) -> None:
    built = _docker(*compose, "build", timeout=900.0)
    assert built.returncode == 0, built.stdout[-2000:] + built.stderr[-2000:]
    headless = [name for name in LOOP if name != "dashboard"]
    started = _docker(*compose, "up", "-d", "--no-build", *headless, timeout=120.0)
    assert started.returncode == 0, started.stderr
    _wait_until_healthy(compose, headless)
    filters = _docker(*compose, "ps", "-q", "safety_filter").stdout.strip()
    _docker("docker", "exec", filters, "sh", "-c", "kill -KILL -1")  # all but the init process, which then ends
    _wait_until_healthy(compose, headless)
    assert _docker("docker", "inspect", "--format", "{{.RestartCount}}", filters).stdout.strip() != "0"
    recorder = _docker(*compose, "ps", "-q", "recorder").stdout.strip()
    _docker(*compose, "stop", "recorder")
    copied = _docker("docker", "cp", f"{recorder}:/recordings/recording.mcap", str(tmp_path))
    assert copied.returncode == 0, copied.stderr
    states = [
        m for _, _, m in read_messages(tmp_path / "recording.mcap", topics=[STATE]) if isinstance(m, StateMessage)
    ]
    assert any(state.applied_by == "filter" and abs(state.values[3]) > 0.3 for state in states), "it never drove"
    assert {state.collisions for state in states} == {0}


def _wait_until_healthy(compose: list[str], names: list[str]) -> None:
    """Asks the health check of each service itself: it waits for the proof, so nothing here sleeps."""
    for name in names:
        kind, *words = SERVICES[name]["healthcheck"]["test"]
        command = ["sh", "-c", words[0].replace("$$", "$")] if kind == "CMD-SHELL" else words
        for _ in range(30):
            answer = _docker(*compose, "exec", "-T", name, *command)
            if answer.returncode == 0:
                break
        assert answer.returncode == 0, f"{name}: {answer.stdout}{answer.stderr}"
