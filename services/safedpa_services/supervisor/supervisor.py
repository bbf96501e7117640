"""Runs the processes of a control loop: starts the robot when all services are ready, restarts what dies, ends all."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from safedpa.errors import InputError, SafedpaError
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.presence import RunPresence
from safedpa_services.supervisor.run_monitor import RunMonitor

_READY_SECONDS = 30.0
"""Time for the first heartbeat of a service that died and was restarted."""
_STARTING_SECONDS = 120.0
"""Time for the first heartbeat of a service. All start at once, possibly without compiled bytecode on a busy
machine."""
_TURN_SECONDS = 0.05
_ROBOT_PATIENCE_SECONDS = 8.0
"""Time for a robot to end; it brakes to a standstill first."""
_BRAKING_SECONDS = 5.0
_OTHERS_PATIENCE_SECONDS = 5.0
"""Time for the other robots to end after the first."""
_SERVICE_PATIENCE_SECONDS = 6.0
"""Time for a service to end; the filter waits up to 5 s until all robots that it serves are stationary."""
_HUNG_SECONDS = 10.0
"""A service without a heartbeat for this long is hung. Four are sent per second; a busy machine delays them by 1 to 2
s."""
_HUNG_DASHBOARD_SECONDS = 60.0
"""The same of the dashboard, on which no drive depends: at its low priority it is more often late than hung, and to
start it again makes a busy machine busier."""
_OWN_STALL_SECONDS = 2.0
"""A turn that is later than this finds every heartbeat old, because this process itself was stopped or starved."""
_LAST = ("recorder", "router")
"""End last: the recorder records the end of the other services, and all messages go through the router."""
_BAD_INPUT = 2
_BY_PRODUCTS = ("recorder", "dashboard")
"""The robot drives on when one of these is not restarted any more; the roster reports it."""


@dataclass
class Supervisor:
    """Runs the services and the robot until the robot ends by itself or ``stopped`` returns true."""

    services: list[Child]
    robot: Child | None
    """None: the robot is not started here, and the services do not end with it."""
    watch: RunMonitor
    stopped: Callable[[], bool]
    on_turn: Callable[[], None]
    """Called many times a second; updates the display."""
    hurried: Callable[[], bool] = lambda: False
    """Whether to end everything immediately, without braking."""
    others: Sequence[tuple[Child, RunMonitor]] = ()
    """Further robots. The run ends with the first robot."""
    presence: RunPresence | None = None
    """Publishes the roster; None: without a roster."""
    _turned: float | None = None
    """Time of the last turn [s]."""
    _judges_from: float = 0.0

    def run(self) -> int:
        """Returns the robot's exit code, or 0 if stopped. All processes have ended when this returns or raises.

        Raises SafedpaError if an essential service cannot be started, and InputError if a service or the robot rejects
        its input before the robot drives.
        """
        try:
            # Robots that wait for ``begin`` start together with the services, because they take as long to be ready.
            early = [robot for robot in self._robots if robot.waits]
            for child in (*early, *self.services):
                if child.pid == 0:  # the router is running already
                    child.start()
            self._await_services()
            if not self.stopped():
                for child in self._robots:
                    child.begin()
                if self.presence is not None:
                    self.presence.begin()
            return self._run_until_end()
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
        """Returns the essential and awaited services from which no heartbeat has arrived."""
        awaited = [child for child in self.services if child.essential or child.awaited]
        return [child for child in awaited if child.name not in self.watch.health]

    def _run_until_end(self) -> int:
        while not self.stopped():
            self._turn()
            for child in self._robots:
                if child.exit_code not in (None, 0, 1):
                    self._restart(child)
            code = None if self.robot is None else self.robot.exit_code
            if code in (0, 1):
                self._await_others()
                return code
        return 0

    def _await_others(self) -> None:
        """Waits for the other robots, which drive for the same time by their own clocks."""
        end = time.monotonic() + _OTHERS_PATIENCE_SECONDS
        while not self.stopped() and time.monotonic() < end and any(c.exit_code is None for c, _ in self.others):
            self._turn()

    def _may_judge(self) -> bool:
        """Whether this process itself has run for long enough to know that another one is silent."""
        return time.monotonic() >= self._judges_from

    def _turn(self) -> None:
        self.watch.listen(_TURN_SECONDS)
        for _, watch in self.others:
            watch.listen(0.0)
        now = time.monotonic()
        if self._turned is not None and now - self._turned > _OWN_STALL_SECONDS:
            self._judges_from = now + _OWN_STALL_SECONDS  # heartbeats of that time are still to be read
        self._turned = now
        for child in self.services:
            if child.exit_code is not None:
                self._restart(child)
            elif child.essential and self._may_judge():
                patience = _HUNG_DASHBOARD_SECONDS if child.name == "dashboard" else _HUNG_SECONDS
                if self.watch.has_hung(child.name, child.pid, patience):
                    child.kill(f"hung: no heartbeat for {patience:.0f} s")  # the next turn restarts it
        if self.presence is not None:
            self.presence.turn()
        self.on_turn()

    def _restart(self, child: Child) -> None:
        """Restarts a process.

        A process that rejected its input before the robot drives will do so again, which ends the run if it is
        essential. Once the robot drives, every process is restarted.
        """
        if child is self.robot and child.exit_code == _BAD_INPUT and "robot" not in self.watch.health:
            raise InputError(child.last_text())
        if child.exit_code != _BAD_INPUT or any(robot.has_begun for robot in self._robots):
            child.restart_if_due()
            # A loop without its filter or policy only brakes; other processes are missed, and the drive goes on.
            if child.given_up and (child in self._robots or (child.essential and child.name not in _BY_PRODUCTS)):
                raise SafedpaError(f"{child.name}: not restarted any more, {child.cause}")
        elif child.essential:
            raise InputError(child.last_text())

    def _end(self) -> None:
        """Stops the robots, then ends robots, services, and last recorder and router."""
        if self.presence is not None:
            self.presence.end()
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
        for child in reversed(self.services):  # the router is first in the list and ends last
            child.end(self._patience(_SERVICE_PATIENCE_SECONDS))
        self.watch.listen(_TURN_SECONDS)  # the recorder's last health message

    def _patience(self, seconds: float) -> float:
        return 0.0 if self.hurried() else seconds

    def _brake(self) -> None:
        """Orders the filter to stop the robots. If it does not answer, the robot brakes itself when it ends."""
        driving = [pair for pair in zip(self._robots, self._watches, strict=False) if _drives(pair[0])]
        braking = [pair for pair in driving if not self.hurried() and pair[1].stop_robot()]
        end = time.monotonic() + _BRAKING_SECONDS
        while braking and time.monotonic() < end and not self.hurried():
            time.sleep(_TURN_SECONDS)
            for watch in self._watches:
                watch.listen(0.0)
            self.on_turn()
            braking = [(child, watch) for child, watch in braking if _drives(child) and not watch.has_obeyed_stop()]


def _drives(child: Child) -> bool:
    return child.has_begun and child.exit_code is None
