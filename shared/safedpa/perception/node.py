"""The node of the perception service: computes surroundings[k] from state[k] and the scans before it."""

from __future__ import annotations

import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import final

from safedpa.bus import (
    SCAN,
    SURROUNDINGS,
    AbstractNode,
    Inputs,
    Message,
    Outputs,
    ScanMessage,
    StateMessage,
    SurroundingsMessage,
)
from safedpa.bus.logging import log_event
from safedpa.perception.odometry import pose_of, speed_of
from safedpa.perception.overrides import SensorOverrides
from safedpa.perception.settings import PerceptionSettings
from safedpa.perception.surroundings import SurroundingsTracker
from safedpa.perception.zones import ActiveZones

__all__ = ["PerceptionNode"]

Rows = tuple[tuple[float, ...], ...]

_MAX_SCANS = 256
"""Largest number of scans that one message lists."""


@final
class PerceptionNode(AbstractNode):
    """Publishes the surroundings of each robot with sensors at the time of its state."""

    name = "perception"
    inputs = ()
    outputs = (SURROUNDINGS,)
    listens = (SCAN,)
    share = 0.0
    defers_afterwards = False

    def __init__(self, settings: PerceptionSettings | None = None, orders: Path | None = None) -> None:
        self._settings = settings or PerceptionSettings()
        self.switches = SensorOverrides(self._settings, orders)
        """Sources and zones that the user can switch at run time."""
        self._robots: dict[str, SurroundingsTracker] = {}
        self._active: dict[str, ActiveZones] = {}
        """Active zones in the last tick, by robot."""
        self._heard: dict[str, deque[tuple[int, str, int]]] = {}
        """Epoch, source and number of each scan since the last tick, by robot."""

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        assert isinstance(message, ScanMessage)
        self._of(robot).hear(message)
        self._heard.setdefault(robot, deque(maxlen=_MAX_SCANS)).append((message.epoch, message.source, message.number))

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del inputs
        if not state.sources:
            return {}
        around = self._of(robot)
        active = self.switches.in_force(robot, state.sources, state.tick)
        if active != self._active.get(robot) and not self.switches.replays(robot):
            self._report(robot, state, active)
        seen = around.at(state, active)
        counting = active.at(speed_of(state))
        message = SurroundingsMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            points=seen.points,
            movers=seen.movers,
            hidden=seen.hidden,
            ages=around.sources.ages(state.robot_time),
            problems=around.sources.problems(state.robot_time),
            scans=self._scans(robot, state),
            off=tuple(name for name in state.sources if name in active.off),
            zones=counting.names,
            borders=counting.borders(pose_of(state)),
            ordered=active.ordered,
        )
        return {SURROUNDINGS: message}

    def _scans(self, robot: str, state: StateMessage) -> Rows:
        """Scans used in this step. A scan of another epoch may arrive before its state; it is kept for that state."""
        heard = self._heard.pop(robot, ())
        if others := [one for one in heard if one[0] != state.epoch]:
            self._heard[robot] = deque(others, maxlen=_MAX_SCANS)
        return tuple(
            (float(state.sources.index(name)), float(number))
            for epoch, name, number in heard
            if epoch == state.epoch and name in state.sources
        )

    def _report(self, robot: str, state: StateMessage, now: ActiveZones) -> None:
        """Logs sources and zones that remove information, at the first tick of a robot and after each switch."""
        known, self._active[robot] = self._active.get(robot), now
        report = partial(log_event, level="warning", robot=robot, tick=state.tick, service=self.name)
        ignored = ", ".join(zone.name for zone in now.zones if zone.kind == "ignored")
        off, on = ", ".join(sorted(now.off)), ", ".join(zone.name for zone in now.zones)
        unknown = ", ".join(name for name in self._settings.sources if name not in state.sources)
        if known is not None:
            report("perception.switched", f"active zones: {on or 'none'}; sources off: {off or 'none'}")
        elif unknown:
            report("perception.source_unknown", f"the file names the source {unknown}, the robot does not")
        if ignored:
            report("perception.ignores", f"objects in {ignored} are not reported, and nothing is assumed to hide there")
        if off:
            report("perception.source_off", f"ignored: {off}; what only it sees counts as hidden")

    def _of(self, robot: str) -> SurroundingsTracker:
        if robot not in self._robots:
            self._robots[robot] = SurroundingsTracker(self._settings)
        return self._robots[robot]

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """Publishes nothing, so the filter brakes; the memory may be inconsistent and is cleared."""
        del state, reason
        self._robots.pop(robot, None)
        self._heard.pop(robot, None)
        return {}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)
        self._active.pop(robot, None)
        self._heard.pop(robot, None)
        self.switches.forget(robot)
