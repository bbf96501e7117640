"""Both sides of the gateway as processes: a robot's router, its nodes; and the services of the loop."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from safedpa.bus.transport import ports
from safedpa.errors import SafedpaError
from safedpa_sim.robots.car.scene import Scene

_START_SECONDS = 60.0
_PATIENCE = 15.0


class Node:
    """A process of the robot's side, spoken to by lines."""

    def __init__(self, module: str, *phrase: str, home: Path) -> None:
        environment = {**os.environ, "HOME": str(home), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        command = [sys.executable, "-m", f"safedpa_lab.ros.{module}", *phrase]
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)
        if self.line(_START_SECONDS) != "there":
            raise SafedpaError(f"{module}: it did not start")

    def send(self, word: str) -> None:
        """A line to it."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{word}\n")
        self.process.stdin.flush()

    def line(self, seconds: float) -> str:
        """Its next line; ended after so long."""
        assert self.process.stdout is not None
        timer = threading.Timer(seconds, self.process.kill)
        timer.start()
        try:
            return self.process.stdout.readline().rstrip("\n")
        finally:
            timer.cancel()

    def reported(self, seconds: float = 300.0) -> dict[str, Any]:
        """What it says at its end. Raises SafedpaError where it ended without a word."""
        line = self.line(seconds)
        if not line:
            raise SafedpaError("the robot's process ended without a word")
        return dict(json.loads(line))

    def kill(self) -> None:
        """At once."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()


class Side:
    """A robot's router and its nodes."""

    def __init__(self, folder: Path) -> None:
        self.port, self.folder = ports.free_port(), folder
        self.nodes: list[Node] = []
        self.router = self._start("router", str(self.port))

    def _start(self, module: str, *phrase: str) -> Node:
        node = Node(module, *phrase, home=self.folder)
        self.nodes.append(node)
        return node

    @property
    def endpoint(self) -> str:
        """Where its router listens."""
        return f"tcp/127.0.0.1:{self.port}"

    def car(self, seconds: float, seed: int = 0, *options: str) -> Node:
        """A car that waits for ``go``."""
        return self._start("car", str(self.port), str(seconds), str(seed), *options)

    def speaker(self, topic: str, *options: str) -> Node:
        """One that commands a drive, from ``go`` on."""
        return self._start("speaker", str(self.port), topic, *options)

    def restart_router(self) -> None:
        """After it was killed."""
        self.router = self._start("router", str(self.port))

    def end(self) -> None:
        """Of everything."""
        for node in reversed(self.nodes):
            node.kill()


@contextmanager
def side(folder: Path) -> Iterator[Side]:
    """A robot's side, ended at the end."""
    found = Side(folder)
    try:
        yield found
    finally:
        found.end()


def robot_file(path: Path, endpoint: str, seed: int, tables: dict[str, dict[str, Any]] | None = None) -> Path:
    """The file of the robot in the scene of ``seed``; ``tables`` hold further or other keys."""
    scene = Scene.random(seed)
    whole: dict[str, dict[str, Any]] = {
        "wire": {"endpoint": endpoint},
        "odometry": {"topic": "/odom"},
        "nominal": {"topic": "/drive_in"},
        "command": {"topic": "/drive", "type": "ackermann_msgs/msg/AckermannDriveStamped"},
        "surroundings": {
            "field": list(scene.field),
            "footprint": list(scene.footprint),
            "obstacles": [list(one) for one in scene.obstacles],
        },
    }
    for name, keys in (tables or {}).items():
        whole[name] = {**whole.get(name, {}), **keys}
    lines = ["format = 2", 'robot = "car"', 'name = "r1"']
    for name, keys in whole.items():
        lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


class Loop:
    """Services and gateway as processes, each with its log. All are of this process's group."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.fleet = folder, f"fleet{os.getpid()}"
        self.endpoint = f"tcp/127.0.0.1:{ports.free_port()}"
        self.children: dict[str, subprocess.Popen[bytes]] = {}
        self._files = ExitStack()

    def start(self, name: str, *options: str) -> None:
        """One of them; the first is where the others meet."""
        where = ["--connect" if self.children else "--listen", self.endpoint]
        where += ["--mode", "client"] if "router" in self.children else []
        log = self._files.enter_context((self.folder / f"{name}.log").open("ab"))
        command = [sys.executable, "-m", f"safedpa_services.{name}", "--fleet", self.fleet, *where, *options]
        self.children[name] = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)

    def log(self, name: str) -> str:
        """What it said."""
        return (self.folder / f"{name}.log").read_text(encoding="utf-8", errors="replace")

    def wait_for(self, name: str, phrase: str, seconds: float = _START_SECONDS) -> str:
        """Until it reports so. Raises SafedpaError with its log where it does not."""
        end = time.monotonic() + seconds
        while phrase not in (text := self.log(name)):
            if time.monotonic() > end:
                raise SafedpaError(f"{name} did not say '{phrase}': {text[-2000:]}")
            time.sleep(0.05)
        return text

    def stop(self, name: str) -> None:
        """Ends one, and forgets what it said."""
        child = self.children.pop(name)
        _end(child)
        (self.folder / f"{name}.log").write_text("", encoding="utf-8")

    def end(self) -> None:
        """Of all."""
        for child in reversed(self.children.values()):
            if child.poll() is None:
                child.terminate()
        for child in self.children.values():
            _end(child)
        self._files.close()


def _end(child: subprocess.Popen[bytes]) -> None:
    if child.poll() is None:
        child.terminate()
    try:
        child.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


@contextmanager
def services(folder: Path, *, router: bool = False) -> Iterator[Loop]:
    """Adaptation and safety filter of the car, on the bus; they meet at the adaptation, or at a ``router``."""
    loop = Loop(folder)
    try:
        if router:
            loop.start("router", "--plain", "--robot", "r1")
        loop.start("adaptation", "--model", "car")
        loop.start("safety_filter", "--model", "car", "--settings", "car")
        for name in ("adaptation", "safety_filter"):
            loop.wait_for(name, "is on the bus", _START_SECONDS)
        yield loop
    finally:
        loop.end()
