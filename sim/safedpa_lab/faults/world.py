"""A fleet in real time, one process a service, a router between them and a proxy before it: what faults happen to."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, final

from safedpa.bus import Answer, Bus, Request, ZenohSettings, ZenohTransport
from safedpa.bus.transport.ports import free_port
from safedpa.errors import BusError, SafedpaError
from safedpa_lab.faults.conduct import Conduct
from safedpa_lab.faults.member import Member
from safedpa_lab.faults.observer import Observer
from safedpa_lab.faults.proxy import Proxy

__all__ = ["DISK_BYTES", "FLEET", "LOOP", "ROBOT", "SERVICES", "World", "WorldSettings"]

FLEET = "faults"
ROBOT = "r1"
LOOP = ("adaptation", "policy", "safety_filter")
"""Without one of these the robot does not drive."""
SERVICES = (*LOOP, "diagnosis", "recorder")
DISK_BYTES = 96 * 1024 * 1024
_START_SECONDS = 40.0
_TURN_SECONDS = 0.02
_DRIVING_TICKS = 10
"""In a row, before the loop counts as driving again."""
_STEADY_SECONDS = 0.55
"""Ten periods of 0.05 s, and what two more would take."""
_ROBOT_PATIENCE_SECONDS = 8.0
_SERVICE_PATIENCE_SECONDS = 4.0


@dataclass(frozen=True)
class WorldSettings:
    """``diagnosis``: the product's own, or a stand-in that has an effect to accept at once (``ready``)."""

    seed: int = 1
    load: str = "box"
    diagnosis: Literal["real", "ready"] = "real"
    disk_bytes: int = DISK_BYTES
    """Of the recorder's own disk."""


@final
class World:
    """Runs from ``__enter__`` to ``__exit__``. Raises SafedpaError when the fleet does not come up."""

    def __init__(self, folder: Path, settings: WorldSettings) -> None:
        self.folder, self.settings = folder, settings
        folder.mkdir(parents=True, exist_ok=True)
        self.disk.mkdir(exist_ok=True)
        self.has_own_disk = _mounted(self.disk, settings.disk_bytes)
        port = free_port()
        self.router_endpoint = f"tcp/127.0.0.1:{port}"
        self.proxy = Proxy(("127.0.0.1", port), (*SERVICES, "robot"), settings.seed)
        self.members = {"router": self._router(), **{name: self._service(name) for name in SERVICES}}
        self.members["robot"] = self._robot()
        self._twins: list[Member] = []
        self._bus: Bus | None = None
        self._observer: Observer | None = None

    @property
    def observer(self) -> Observer:
        """Hears everything, straight from the router."""
        assert self._observer is not None
        return self._observer

    @property
    def trace(self) -> Path:
        """What the robot did, on its own disk."""
        return self.folder / "trace.jsonl"

    @property
    def disk(self) -> Path:
        """Where the recorder writes: a small file system of its own, where that is permitted."""
        return self.folder / "disk"

    @property
    def recordings(self) -> list[Path]:
        """Every file of every recorder that ran."""
        return sorted(self.folder.glob("**/*.mcap"))

    def bend(self, conduct: Conduct, *names: str) -> None:
        """Treats what these processes say and hear otherwise from now on; without names: everyone's."""
        for name in names or self.proxy.ports:
            self.proxy.set(name, conduct)

    def request(self, request: Request, timeout: float) -> Answer | None:
        """Asks the diagnosis about the robot; None when no one answers within ``timeout`` [s]."""
        return self.observer.bus.request(ROBOT, request, timeout)

    def until(self, condition: Callable[[], bool], patience: float) -> bool:
        """Listens until ``condition`` holds; False when it did not within ``patience`` [s]."""
        end = time.monotonic() + patience
        while not condition():
            if time.monotonic() > end:
                return False
            self.observer.listen(_TURN_SECONDS)
        return True

    def listen(self, seconds: float) -> None:
        """Listens for so long."""
        self.until(lambda: False, seconds)

    def drives(self, since: float = 0.0) -> bool:
        """Whether the loop has been driving for half a second, all of it later than ``since`` (monotonic, s)."""
        return self.observer.drives(_DRIVING_TICKS, since)

    def drives_steadily(self) -> bool:
        """Whether it does, and no period of the last half second was late by two periods."""
        return self.observer.drives(_DRIVING_TICKS, within=_STEADY_SECONDS)

    def missing(self, since: float) -> list[str]:
        """Processes that have not reported their health, themselves and later than ``since``."""
        heard = self.observer.health
        return [
            name
            for name in (*SERVICES, "robot")
            if name not in heard or heard[name][1] <= since or heard[name][0].pid != self.members[name].pid
        ]

    def __enter__(self) -> World:
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends everything in order: the robot brakes while it still has a network."""
        self.members["robot"].end(_ROBOT_PATIENCE_SECONDS)
        for member in (*(self.members[name] for name in SERVICES), *self._twins):
            member.end(_SERVICE_PATIENCE_SECONDS)
        if self._bus is not None:
            self._bus.close()
        self.members["router"].end(_SERVICE_PATIENCE_SECONDS)
        self.proxy.close()
        if self.has_own_disk:
            for file in self.disk.glob("*.mcap"):
                shutil.copy(file, self.folder / file.name)
            subprocess.run(["umount", str(self.disk)], check=True)
            self.has_own_disk = False

    def twin_of(self, name: str) -> Member:
        """A second process of a service, not started yet; it ends with the world."""
        first = self.members[name]
        twin = Member(name, first.module, first.arguments, self.folder / f"{name}-twin.log")
        self._twins.append(twin)
        return twin

    def _start(self) -> None:
        self.members["router"].start()
        self._bus = self._joined()
        self._observer = Observer(self._bus, ROBOT)
        for name in SERVICES:
            self.members[name].start()
        self._require(lambda: set(SERVICES) <= set(self.observer.health), "the services did not come up")
        self.members["robot"].start()
        self._require(self.drives, "the robot does not drive")

    def _require(self, condition: Callable[[], bool], trouble: str) -> None:
        if not self.until(condition, _START_SECONDS):
            phrase = "; ".join(f"{name}: {member.last_text()}" for name, member in self.members.items() if member.pid)
            raise SafedpaError(f"faults: {trouble} within {_START_SECONDS:.0f} s ({phrase}); see {self.folder}")

    def _joined(self) -> Bus:
        end = time.monotonic() + _START_SECONDS
        while True:
            try:
                return Bus(ZenohTransport(ZenohSettings("client", connect=(self.router_endpoint,))), FLEET)
            except BusError:
                if time.monotonic() > end:
                    raise

    def _router(self) -> Member:
        return self._member(
            "router", "safedpa_services.router", "--listen", self.router_endpoint, "--plain", "--realtime"
        )

    def _service(self, name: str) -> Member:
        bus = ("--mode", "client", "--connect", self.proxy.endpoint(name))
        if name == "recorder":
            return self._member(name, "safedpa_services.recorder", "--out", str(self.disk / "recording.mcap"), *bus)
        if name == "diagnosis" and self.settings.diagnosis == "ready":
            return self._member(name, "safedpa_lab.faults.coordinator", "--out", str(self.folder / "models"), *bus)
        retained = ("--versions", str(self.folder / "models")) if name == "diagnosis" else ("--realtime",)
        return self._member(name, f"safedpa_services.{name}", *retained, *bus)

    def _robot(self) -> Member:
        options = ["--name", ROBOT, "--load", self.settings.load, "--seed", str(self.settings.seed), "--realtime"]
        options += ["--trace", str(self.trace), "--summary", str(self.folder / "robot.json")]
        options += ["--mode", "client", "--connect", self.proxy.endpoint("robot")]
        return self._member("robot", "safedpa_sim.robots", *options)

    def _member(self, name: str, module: str, *arguments: str) -> Member:
        return Member(name, module, (*arguments, "--fleet", FLEET), self.folder / f"{name}.log")


def _mounted(folder: Path, size: int) -> bool:
    """Whether a small file system in memory could be put there; only the superuser may."""
    if shutil.which("mount") is None:
        return False
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "safedpa-faults", str(folder)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0
