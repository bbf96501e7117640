"""A fleet in real time, one process a service, a router between them and a proxy before it: what faults happen to.

Its observer hears everything on the bus from next to the proxy, and keeps what a fault is judged by.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from types import TracebackType
from typing import Literal, final

from safedpa.bus import (
    NO_ROBOT,
    TOPICS,
    ActionMessage,
    Answer,
    Bus,
    HealthMessage,
    LatentMessage,
    Message,
    ModelMessage,
    ReceivedMessage,
    Request,
    StateMessage,
    TakeoverMessage,
    VerdictMessage,
    ZenohSettings,
    ZenohTransport,
)
from safedpa.bus.transport.ports import free_port
from safedpa.errors import BusError, SafedpaError
from safedpa_lab.faults.proxy import Conduct, Proxy

_STARTING_PRIORITY = 1


@dataclass
class Member:
    """A Python module run as a process of its own, with what it writes in a file."""

    name: str
    module: str
    arguments: tuple[str, ...]
    log: Path
    environment: dict[str, str] = field(default_factory=dict)
    """On top of this process's own."""

    def __post_init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Of the process that runs now or ran last; 0 before the first start."""
        return 0 if self._process is None else self._process.pid

    @property
    def lives(self) -> bool:
        """Whether it runs, be it paused."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Starts the process; a later call starts it again."""
        command = [sys.executable, "-m", "safedpa_lab.faults.sabotaged", self.module, *self.arguments]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **self.environment}
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, env=environment
            )

        if "--realtime" in self.arguments:  # as the supervisor does
            with contextlib.suppress(OSError):
                os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(_STARTING_PRIORITY))

    def send(self, number: int) -> None:
        """Sends a signal to the process, if it still runs."""
        if self._process is not None:
            self._process.send_signal(number)

    def kill(self) -> None:
        """With SIGKILL; returns when it is gone."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def restart(self) -> None:
        """Kills it and starts a new one at once, as a supervisor would."""
        self.kill()
        self.start()

    def end(self, patience: float) -> None:
        """Asks it to end, waits up to ``patience`` [s], then kills it and its group."""
        if self._process is None:
            return
        self.send(signal.SIGCONT)
        self.send(signal.SIGTERM)
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def threads(self) -> list[int]:
        """Ids of its threads now."""
        return [int(entry.name) for entry in Path(f"/proc/{self.pid}/task").iterdir()]

    def fate(self) -> str:
        """Whether it runs, or how it ended: a negative number is the signal that ended it."""
        code = None if self._process is None else self._process.poll()
        return "its process lives" if code is None else f"its process ended with {code}: {self.last_text()}"

    def last_text(self) -> str:
        """The last line that it wrote."""
        lines = [line for line in self.log.read_text(errors="replace").splitlines() if line.strip()]
        return lines[-1] if lines else "it said nothing"


Stamp = tuple[int, int]
"""(epoch, tick)."""


@dataclass
class Observer:
    """Collects until asked; ``listen`` must be called often. ``robot`` is the one that is judged."""

    bus: Bus
    robot: str
    health: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By service: the newest heartbeat and when it came (monotonic, s)."""
    states: dict[Stamp, StateMessage] = field(default_factory=dict)
    verdicts: dict[Stamp, VerdictMessage] = field(default_factory=dict)
    actions: dict[Stamp, set[tuple[float, ...]]] = field(default_factory=dict)
    """All that were sent for a state."""
    latent_models: dict[Stamp, str] = field(default_factory=dict)
    """Fingerprint of the model to which the latent of a state belongs."""
    acknowledged: dict[int, int] = field(default_factory=dict)
    """By process of a recorder: how many messages it said were on the disk."""
    notice: list[tuple[float, ModelMessage | TakeoverMessage]] = field(default_factory=list)
    """When it came (monotonic, s), and every step of every change of the model."""
    heard: dict[Stamp, float] = field(default_factory=dict)
    """When each state came first; monotonic, s."""
    newest: Stamp = (0, -1)

    def __post_init__(self) -> None:
        self._inbox = self.bus.inbox(tuple(TOPICS.values()), keep_all=True)

    def listen(self, wait: float) -> None:
        """Takes in what arrived within ``wait`` [s]."""
        for item in self._inbox.take(wait):
            if isinstance(item, ReceivedMessage) and item.robot in (self.robot, NO_ROBOT):
                self._take(item.message, item.at)

    def lives(self, robot: str, service: str) -> bool:
        """Whether a sign of life of the service is seen now."""
        return bool(self.bus.instances(robot, service))

    def silent_for(self, service: str, now: float) -> float:
        """Seconds since the last heartbeat; infinite before the first."""
        return now - self.health[service][1] if service in self.health else float("inf")

    def _take(self, message: Message, at: float) -> None:
        stamp = (message.epoch, message.tick)
        match message:
            case HealthMessage():
                self.health[message.service] = (message, at)
                if message.service == "recorder":
                    self.acknowledged[message.pid] = message.acknowledged
            case StateMessage():
                self.states[stamp], self.newest = message, stamp
                self.heard.setdefault(stamp, at)
            case VerdictMessage():
                self.verdicts.setdefault(stamp, message)
            case ActionMessage():
                self.actions.setdefault(stamp, set()).add(message.values)
            case LatentMessage():
                self.latent_models[stamp] = message.model
            case ModelMessage() | TakeoverMessage():
                self.notice.append((at, message))
            case _:
                return

    def drives(self, ticks: int, since: float = 0.0, within: float = inf) -> bool:
        """Whether the newest ``ticks`` periods, all later than ``since``, were driven by a filter with all it needs.

        ``within``: s from the first to the last of them at most; a robot that is held up itself lives no period at all.
        """
        epoch, last = self.newest
        recent = [(epoch, tick) for tick in range(last - ticks + 1, last + 1)]
        driven = last >= ticks and all(self.heard.get(one, 0.0) > since and self._driven(one) for one in recent)
        return driven and self.heard[recent[-1]] - self.heard[recent[0]] <= within

    def _driven(self, stamp: Stamp) -> bool:
        state, before = self.states.get(stamp), self.verdicts.get((stamp[0], stamp[1] - 1))
        return state is not None and state.applied_by == "filter" and before is not None and before.status != "fallback"


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
        self.members = {
            "router": self._member(
                "router", "safedpa_services.router", "--listen", self.router_endpoint, "--plain", "--realtime"
            ),
            **{name: self._service(name) for name in SERVICES},
        }
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
