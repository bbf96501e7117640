"""A fleet of containers for tests: starting it, what can be done to its containers from outside, and what is seen."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PROJECT = "safedpa-fleet-test"
SERVICES = (
    *("authority", "router", "safety_filter", "adaptation", "policy"),
    *("diagnosis", "recorder", "dashboard", "robot"),
)
LOADS = ("none", "box", "chair", "large_chair")
"""Of the robots in turn."""
ROUTER = "tls/router:7447"
_ATTEMPTS = 5
"""To take a fleet away."""
LONGEST_SILENCE = 20.0
"""s; an observer that prints nothing for so long is broken."""


def run(
    *phrase: str, timeout: float = 120.0, check: bool = True, given: str = "", environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs a command in the repository with ``given`` as its input; its output is part of the error where it fails."""
    done = subprocess.run(
        phrase,
        cwd=ROOT,
        input=given,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        env={**os.environ, **(environment or {})},
    )
    if check and done.returncode:
        raise AssertionError(f"{' '.join(phrase)}: code {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done


def compose_program() -> list[str]:
    """Compose v2 where it is there, else v1."""
    if shutil.which("docker") and run("docker", "compose", "version", check=False).returncode == 0:
        return ["docker", "compose"]
    return ["docker-compose"]


class Fleet:
    """One project of docker-compose.yml."""

    def __init__(self, robots: int, loads: str) -> None:
        self.robots = tuple(f"robot-{number}" for number in range(1, robots + 1))
        self._loads = loads
        self._program = [*compose_program(), "--project-name", PROJECT]
        self._ids: dict[str, str] = {}

    def compose(self, *phrase: str, timeout: float = 180.0) -> str:
        # Another loopback address than the usual one: a dashboard that is in use stays where it is.
        settings = {"SAFEDPA_LOAD": self._loads, "SAFEDPA_ADDRESS": "127.0.0.77"}
        return run(*self._program, *phrase, timeout=timeout, environment=settings).stdout

    def build(self, services: Sequence[str]) -> float:
        """s that building took."""
        began = time.monotonic()
        self.compose("build", *services, timeout=900.0)
        return time.monotonic() - began

    def up(self, services: Sequence[str]) -> None:
        wanted = [name for name in services if name != "robot"]
        self.compose("up", "-d", "--no-build", *wanted)
        self.compose("up", "-d", "--no-build", "--no-recreate", "--scale", f"robot={len(self.robots)}", *services)

    def down(self) -> str:
        """Takes it away, and says what stays; again where docker says that an empty network has "active endpoints".

        A guest may be about to be removed, or docker forgot that it was (moby's issue 17217): then the network stays,
        and the next fleet takes it. Raises AssertionError where a container is left.
        """
        for _ in range(_ATTEMPTS):
            try:
                self.compose("down", "--volumes", "--remove-orphans", "--timeout", "3")
                return ""
            except AssertionError as error:
                if "active endpoints" not in str(error):
                    raise
                time.sleep(2.0)
        left = run("docker", "ps", "-aq", "--filter", f"label=com.docker.compose.project={PROJECT}").stdout.split()
        assert not left, f"containers {left} are not to be removed"
        return "a network without containers stays: docker takes it to have active endpoints"

    def container(self, service: str) -> str:
        """Identifier of the container of a service; ``robot-2`` is the second robot's."""
        if service not in self._ids:
            name, _, number = service.partition("-")
            phrase = ["docker", "ps", "-aq", "--filter", f"label=com.docker.compose.project={PROJECT}"]
            phrase += ["--filter", f"label=com.docker.compose.service={name}"]
            phrase += ["--filter", f"label=com.docker.compose.container-number={number or 1}"]
            self._ids[service] = run(*phrase).stdout.strip()
            assert self._ids[service], f"there is no container of {service}"
        return self._ids[service]

    def image(self, service: str) -> str:
        return run("docker", "inspect", "--format", "{{.Config.Image}}", self.container(service)).stdout.strip()

    def network(self, name: str = "bus") -> str:
        return f"{PROJECT}_{name}"

    def volume(self, name: str) -> str:
        return f"{PROJECT}_{name}"

    def inspect(self, service: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(run("docker", "inspect", self.container(service)).stdout)[0]
        return found

    def events(self, service: str, since: float) -> list[dict[str, Any]]:
        """The structured lines of a service's log since a time [s since 1970]."""
        log = run("docker", "logs", "--since", f"{since:.3f}", self.container(service))
        lines = [line for line in (log.stdout + log.stderr).splitlines() if line.startswith("{")]
        return [event for event in map(json.loads, lines) if event.get("time", 0.0) >= since]

    def watch(self) -> Watch:
        return Watch(self)

    def guest(self, script: str, key: str, *phrase: str) -> list[str]:
        """The command line of a script of this folder in a container on the bus that holds the key of one role."""
        volume = ["--volume", f"{self.volume(key)}:/certificates:ro"] if key else []
        return [
            *("docker", "run", "--rm", "--init", "--interactive", "--cap-drop", "ALL", "--network", self.network()),
            *("--cpu-shares", "2048", "--stop-timeout", "1", *volume),
            *("--volume", f"{ROOT / 'tests' / 'fleet' / script}:/guest.py:ro"),
            *("--entrypoint", "python", self.image("recorder"), "/guest.py", *phrase),
        ]

    def kill(self, service: str) -> None:
        """SIGKILL from outside, which the engine takes for a crash."""
        pid = self.inspect(service)["State"]["Pid"]
        assert pid > 1, f"{service} does not run"
        os.kill(pid, 9)

    def pause(self, service: str, seconds: float) -> None:
        run("docker", "pause", self.container(service))
        time.sleep(seconds)
        run("docker", "unpause", self.container(service))

    def cut_off(self, service: str, seconds: float) -> None:
        """Takes a container out of the bus's network and puts it back under its names."""
        container, network = self.container(service), self.network()
        names = self.inspect(service)["NetworkSettings"]["Networks"][network]["Aliases"] or []
        aliases = [word for name in names if not container.startswith(name) for word in ("--alias", name)]
        run("docker", "network", "disconnect", network, container)
        time.sleep(seconds)
        run("docker", "network", "connect", *aliases, network, container)

    def restart(self, service: str) -> None:
        run("docker", "restart", "--time", "5", self.container(service))

    def restarts(self, service: str) -> int:
        return int(self.inspect(service)["RestartCount"])


class Watch:
    """An observer on the bus, in a container of its own; the newest of what it said."""

    def __init__(self, fleet: Fleet) -> None:
        self._text = ("--connect", ROUTER, "--certificates", "/certificates", "--role", "recorder")
        self._process = subprocess.Popen(
            fleet.guest("fleet_observer.py", "recorder-key", *self._text), stdout=subprocess.PIPE, text=True
        )
        self._changed = threading.Condition()
        self._newest: dict[str, Any] = {"at": 0.0, "robots": {}, "services": {}}
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            reported = json.loads(line)
            with self._changed:
                self._newest = reported
                self._changed.notify_all()

    def now(self) -> dict[str, Any]:
        """Waits for a new report and returns it."""
        with self._changed:
            heard = self._changed.wait(LONGEST_SILENCE)
            assert heard, "the observer says nothing"
            return self._newest

    def until(self, holds: Callable[[dict[str, Any]], Any], seconds: float) -> dict[str, Any] | None:
        """Returns the first report for which ``holds`` is true, or None after ``seconds``."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            reported = self.now()
            if holds(reported):
                return reported
        return None

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(5)
        assert self._process.stdout is not None
        self._process.stdout.close()


if __name__ == "__main__":  # builds the images, for deploy/test-fleet --prepare
    print(f"images built in {Fleet(len(LOADS), ','.join(LOADS)).build(SERVICES):.0f} s")
