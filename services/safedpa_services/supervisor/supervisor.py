"""Keeps the processes of a loop alive: the robot drives when all services are ready, and its end is the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from safedpa.errors import InputError, SafedpaError
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.watch import RunMonitor

__all__ = ["Supervisor"]

_READY_SECONDS = 30.0
"""Until a service is heard that died meanwhile."""
_STARTING_SECONDS = 120.0
"""The same for one that still starts: all do at once, at first with nothing compiled, on whatever else is busy."""
_TURN_SECONDS = 0.05
_ROBOT_PATIENCE_SECONDS = 8.0
"""A robot brakes to a standstill before it ends."""
_BRAKING_SECONDS = 5.0
_OTHERS_PATIENCE_SECONDS = 5.0
"""After the first robot's end, for the others to come to theirs."""
_SERVICE_PATIENCE_SECONDS = 6.0
"""The filter takes up to 5 s to see robots stand that it serves next to this loop's."""
_HUNG_SECONDS = 10.0
"""Without a heartbeat, of which there are four a second; a busy machine keeps one waiting for a second or two."""
_LAST = ("recorder", "router")
_BAD_INPUT = 2


@dataclass
class Supervisor:
    """Runs the services and the robot until the robot ends by itself or ``stopped`` says so."""

    services: list[Child]
    robot: Child | None
    """None: a robot that is started by others, and whose end is not the services'."""
    watch: RunMonitor
    stopped: Callable[[], bool]
    on_turn: Callable[[], None]
    """Called many times a second, to show what is going on."""
    hurried: Callable[[], bool] = lambda: False
    """Whether to end everything at once, in whatever state it is."""
    others: Sequence[tuple[Child, RunMonitor]] = ()
    """Further robots that drive next to the first, whose end is the end."""

    def run(self) -> int:
        """Returns the robot's exit code, or 0 when stopped. Everything has ended afterwards, whatever happened.

        Raises SafedpaError when a service that the loop needs cannot be brought up, InputError when it or the robot
        refuses its input before anything drives.
        """
        try:
            early = [robot for robot in self._robots if robot.waits]  # it takes as long to be ready as they do
            for child in (*early, *self.services):
                if child.pid == 0:  # the router runs already
                    child.start()
            self._await_services()
            if not self.stopped():
                for child in self._robots:
                    child.begin()
            return self._attend()
        finally:
            self._end()

    @property
    def _robots(self) -> list[Child]:
        return [*([] if self.robot is None else [self.robot]), *(child for child, _ in self.others)]

    @property
    def _watches(self) -> list[RunMonitor]:
        return [self.watch, *(watch for _, watch in self.others)]

    def _await_services(self) -> None:
        began = time.monotonic()
        while not self.stopped() and (silent := self._silent()):
            self._turn()
            waited = time.monotonic() - began
            for child in silent:
                if waited > (_READY_SECONDS if child.restarts else _STARTING_SECONDS):
                    raise SafedpaError(f"{child.name}: not ready after {waited:.0f} s: {child.last_text()}")

    def _silent(self) -> list[Child]:
        """Services that the loop needs and that were not heard yet."""
        return [child for child in self.services if child.essential and child.name not in self.watch.health]

    def _attend(self) -> int:
        while not self.stopped():
            self._turn()
            for child in self._robots:
                if child.exit_code not in (None, 0, 1):
                    self._revive(child)
            code = None if self.robot is None else self.robot.exit_code
            if code in (0, 1):
                self._await_others()
                return code
        return 0

    def _await_others(self) -> None:
        """Those that drive for as long a time, by clocks of their own."""
        end = time.monotonic() + _OTHERS_PATIENCE_SECONDS
        while not self.stopped() and time.monotonic() < end and any(c.exit_code is None for c, _ in self.others):
            self._turn()

    def _turn(self) -> None:
        self.watch.listen(_TURN_SECONDS)
        for _, watch in self.others:
            watch.listen(0.0)
        for child in self.services:
            if child.exit_code is not None:
                self._revive(child)
            elif child.essential and self.watch.has_hung(child.name, child.pid, _HUNG_SECONDS):
                child.kill()  # a process that lives and does not work is as good as dead; it is restarted
        self.on_turn()

    def _revive(self, child: Child) -> None:
        """Starts it again. What it refuses now it will refuse again; but once the robot drives no drive ends by that."""
        if child is self.robot and child.exit_code == _BAD_INPUT and "robot" not in self.watch.health:
            raise InputError(child.last_text())  # it never drove: no one would hear why
        if child.exit_code != _BAD_INPUT or any(robot.begun for robot in self._robots):
            child.restart_if_due()
        elif child.essential:
            raise InputError(child.last_text())

    def _end(self) -> None:
        """The robot stands first, then it ends, then the services, and the recorder last: it hears everything."""
        self._brake()
        for child in self._robots:
            child.terminate()
        for child in self._robots:
            child.end(self._patience(_ROBOT_PATIENCE_SECONDS))
        self.watch.listen(0.0)
        others = [child for child in self.services if child.name not in _LAST]
        for child in others:
            child.terminate()
        for child in others:
            child.end(self._patience(_SERVICE_PATIENCE_SECONDS))
        self.watch.listen(_TURN_SECONDS)
        for child in reversed(self.services):  # a router comes first and goes last
            child.end(self._patience(_SERVICE_PATIENCE_SECONDS))
        self.watch.listen(_TURN_SECONDS)  # the recorder's last word

    def _patience(self, seconds: float) -> float:
        return 0.0 if self.hurried() else seconds

    def _brake(self) -> None:
        """Has the filter brake while everything still runs; where it does not answer, the robot does so by itself."""
        driving = [pair for pair in zip(self._robots, self._watches, strict=False) if _drives(pair[0])]
        braking = [pair for pair in driving if not self.hurried() and pair[1].stop_robot()]
        end = time.monotonic() + _BRAKING_SECONDS
        while braking and time.monotonic() < end and not self.hurried():
            time.sleep(_TURN_SECONDS)
            for watch in self._watches:
                watch.listen(0.0)
            self.on_turn()
            braking = [(child, watch) for child, watch in braking if _drives(child) and not watch.stationary_for()]


def _drives(child: Child) -> bool:
    return child.begun and child.exit_code is None
