"""Disks that are full, clocks that jump, processors that are wanted by others."""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import final

from safedpa.errors import SafedpaError
from safedpa_lab.faults.episode import Episode
from safedpa_lab.faults.fault import Fault
from safedpa_lab.faults.sabotaged import JUMP
from safedpa_lab.faults.world import FLEET, World

_LIBRARY = "faketime/libfaketime.so.1"
_SECONDS = 3.0
_GOES_ON_SECONDS = 10.0
"""The recorder looks for room every five seconds."""
_FILLER, _BLOCK = "filler", bytes(4096)
_HOUR = 3600
_CLOCK = "clock"
"""File by which the library learns how late it is."""
_JUMPS = (("robot", _HOUR), ("safety_filter", -_HOUR), ("safety_filter", _HOUR), ("router", _HOUR))


def disks() -> list[Fault]:
    """The recorder cannot write any more; then it can again."""
    return [
        Fault(
            "disk recorder",
            f"the disk of the recorder is full for {_SECONDS:.0f} s (no file may grow, where none could be mounted)",
            strike=_fill,
            repair=_make_room,
            seconds=_SECONDS,
            look=_reports_it,
            meanwhile="undisturbed",
            check=_goes_on,
            small=True,
        )
    ]


def _fill(world: World) -> None:
    if not world.has_own_disk:
        _limit(world, world.recordings[-1].stat().st_size)
        return
    with (world.disk / _FILLER).open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(_BLOCK)


def _make_room(world: World) -> None:
    if world.has_own_disk:
        (world.disk / _FILLER).unlink()
        return
    _limit(world, resource.RLIM_INFINITY)
    world.members["recorder"].restart()  # a file that may not grow is no full disk: nothing is waited for


def _limit(world: World, size: int) -> None:
    resource.prlimit(world.members["recorder"].pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def _reports_it(world: World) -> str:
    health, _ = world.observer.health["recorder"]
    return "" if health.state == "failing" and health.detail else f"the recorder's health is '{health.state}'"


def _goes_on(world: World, _episode: Episode) -> str:
    goes_on = world.until(lambda: world.observer.health["recorder"][0].state == "running", _GOES_ON_SECONDS)
    return "" if goes_on else "the recorder does not go on"


def clocks() -> list[Fault]:
    """The wall clock of one process jumps by an hour, and back. Its monotonic clock goes on, as clocks do when set.

    By libfaketime (Debian: libfaketime), which reaches the network library, too; where it is not installed, and for the
    recorder, whose sleep that library breaks, only as far as Python reports the time.
    """
    reported = [_reported_clock_fault("recorder"), *([] if _faketime() else [_reported_clock_fault("safety_filter")])]
    return [*([_clock_fault(name, step) for name, step in _JUMPS] if _faketime() else []), *reported]


def _reported_clock_fault(name: str) -> Fault:
    def jump(world: World) -> None:
        world.members[name].send(JUMP)

    sentence = f"the wall clock that Python reports {name} jumps back by {_HOUR} s, and forth after {_SECONDS:.0f} s"
    return Fault(f"clock {name} reported", sentence, jump, repair=jump, seconds=_SECONDS, meanwhile="undisturbed")


def _clock_fault(name: str, step: int) -> Fault:
    return Fault(
        f"clock {name} {step:+d}",
        f"the wall clock of {name} jumps by {step:+d} s, and back after {_SECONDS:.0f} s",
        strike=lambda world: _set_clock(world, step),
        repair=lambda world: _set_clock(world, 0),
        seconds=_SECONDS,
        meanwhile="drives",
        set_up=lambda world: _under_faketime(world, name),
        clean_up=lambda world: _as_before(world, name),
    )


def _set_clock(world: World, step: int) -> None:
    (world.folder / _CLOCK).write_text(f"{step:+d}s\n")


def _faketime() -> Path | None:
    return next(iter(sorted(Path("/usr/lib").glob(f"*/{_LIBRARY}"))), None)


def _under_faketime(world: World, name: str) -> None:
    library = _faketime()
    if library is None:
        raise SafedpaError("clock: libfaketime is not installed; say: apt-get install libfaketime")
    _set_clock(world, 0)
    world.members[name].environment = {
        "LD_PRELOAD": str(library),
        "FAKETIME_TIMESTAMP_FILE": str(world.folder / _CLOCK),
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "FAKETIME_DONT_RESET": "1",
        "FAKETIME_CACHE_DURATION": "1",
    }
    world.members[name].restart()


def _as_before(world: World, name: str) -> None:
    world.members[name].environment = {}
    world.members[name].restart()


def overload() -> list[Fault]:
    """A filter with too little of a processor, and one with too many robots."""
    starved, flooded = _Starved(), _Flooded()
    return [
        Fault(
            "starve safety_filter",
            f"a competitor takes three quarters of the filter's only core, in pieces of 60 ms, for {_SECONDS:.0f} s",
            strike=starved.strike,
            repair=starved.repair,
            seconds=_SECONDS,
        ),
        Fault(
            "flood services",
            f"eight robots that do not exist send 100 states a second each, for {_SECONDS:.0f} s",
            strike=flooded.strike,
            repair=flooded.repair,
            seconds=_SECONDS,
        ),
    ]


_COMPETITOR = """
import os, time
os.sched_setaffinity(0, {%d})
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
except PermissionError:
    pass
while True:
    end = time.monotonic() + 0.06
    while time.monotonic() < end:
        pass
    time.sleep(0.02)
"""
"""Comes before the services of the loop, which have the real-time priority 10, on one core: 60 ms of every 80."""


@final
class _Starved:
    """Binds the filter to one core, and to that core a process that seldom rests."""

    def __init__(self) -> None:
        self._competitor: subprocess.Popen[bytes] | None = None

    def strike(self, world: World) -> None:
        """Takes most of the processor away."""
        core = max(os.sched_getaffinity(0))
        _bind(world.members["safety_filter"].threads(), {core})
        self._competitor = subprocess.Popen([sys.executable, "-c", _COMPETITOR % core])

    def repair(self, world: World) -> None:
        """Gives it back."""
        if self._competitor is not None:
            self._competitor.kill()
            self._competitor.wait()
        _bind(world.members["safety_filter"].threads(), os.sched_getaffinity(0))


def _bind(threads: list[int], cores: set[int]) -> None:
    for thread in threads:
        with contextlib.suppress(ProcessLookupError):  # threads come and go
            os.sched_setaffinity(thread, cores)


@final
class _Flooded:
    """Robots that no one drives, in a process of their own."""

    def __init__(self) -> None:
        self._flood: subprocess.Popen[bytes] | None = None

    def strike(self, world: World) -> None:
        """Begins to send."""
        bus = ["--fleet", FLEET, "--mode", "client", "--connect", world.router_endpoint]
        command = [sys.executable, "-m", "safedpa_lab.faults.flood", *bus]
        self._flood = subprocess.Popen(command, stdin=subprocess.DEVNULL)

    def repair(self, _world: World) -> None:
        """Ends it."""
        if self._flood is not None:
            self._flood.terminate()
            self._flood.wait()
