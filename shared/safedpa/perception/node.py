"""The perception service's step: surroundings[k] from state[k] and the scans before it."""

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
from safedpa.perception.overrides import SensorOverrides
from safedpa.perception.settings import PerceptionSettings
from safedpa.perception.surroundings import SurroundingsTracker
from safedpa.perception.zones import ActiveZones

__all__ = ["PerceptionNode"]

Rows = tuple[tuple[float, ...], ...]

_MOST_HEARD = 256
"""Scans whose numbers are told of one tick at most."""


@final
class PerceptionNode(AbstractNode):
    """Tells of each robot that has sources what is around it at the moment of its state; of others, nothing."""

    name = "perception"
    inputs = ()
    outputs = (SURROUNDINGS,)
    listens = (SCAN,)
    share = 0.0
    lingers = False

    def __init__(self, settings: PerceptionSettings | None = None, orders: Path | None = None) -> None:
        self._settings = settings or PerceptionSettings()
        self.switches = SensorOverrides(self._settings, orders)
        """What a person may switch while it runs."""
        self._robots: dict[str, SurroundingsTracker] = {}
        self._in_force: dict[str, ActiveZones] = {}
        """By robot, as of its last tick."""
        self._heard: dict[str, deque[tuple[int, str, int]]] = {}
        """By robot: epoch, source and number of each scan that came since its last tick."""

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        assert isinstance(message, ScanMessage)
        self._of(robot).hear(message)
        self._heard.setdefault(robot, deque(maxlen=_MOST_HEARD)).append((message.epoch, message.source, message.number))

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del inputs
        if not state.sources:
            return {}
        around = self._of(robot)
        in_force = self.switches.in_force(robot, state.sources, state.tick)
        if in_force != self._in_force.get(robot) and not self.switches.replays(robot):
            self._report(robot, state, in_force)
        seen = around.at(state, in_force)
        counting = in_force.at(state.values[3] if len(state.values) > 3 else None)
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
            off=tuple(name for name in state.sources if name in in_force.off),
            zones=counting.names,
            borders=counting.borders((state.values[0], state.values[1], state.values[2])),
            ordered=in_force.ordered,
        )
        return {SURROUNDINGS: message}

    def _scans(self, robot: str, state: StateMessage) -> Rows:
        """What was heard for this step. A scan of another epoch may have overtaken its state, and waits for that."""
        heard = self._heard.pop(robot, ())
        if others := [one for one in heard if one[0] != state.epoch]:
            self._heard[robot] = deque(others, maxlen=_MOST_HEARD)
        return tuple(
            (float(state.sources.index(name)), float(number))
            for epoch, name, number in heard
            if epoch == state.epoch and name in state.sources
        )

    def _report(self, robot: str, state: StateMessage, now: ActiveZones) -> None:
        """What takes something away from what is told: when a robot is met, and when someone switched."""
        known, self._in_force[robot] = self._in_force.get(robot), now
        report_progress = partial(log_event, level="warning", robot=robot, tick=state.tick, service=self.name)
        ignored = ", ".join(zone.name for zone in now.zones if zone.kind == "ignored")
        off, on = ", ".join(sorted(now.off)), ", ".join(zone.name for zone in now.zones)
        strange = ", ".join(name for name in self._settings.sources if name not in state.sources)
        if known is not None:
            report_progress("perception.switched", f"zones that count: {on or 'none'}; sources off: {off or 'none'}")
        elif strange:
            report_progress("perception.source_unknown", f"the file names the source {strange}, the robot does not")
        if ignored:
            report_progress(
                "perception.ignores", f"what is seen in {ignored} is not told, and no one is taken to hide there"
            )
        if off:
            report_progress("perception.source_off", f"not listened to: {off}; what only it sees is hidden")

    def _of(self, robot: str) -> SurroundingsTracker:
        if robot not in self._robots:
            self._robots[robot] = SurroundingsTracker(self._settings)
        return self._robots[robot]

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """Nothing: the filter brakes. What is remembered may be broken and begins again."""
        del state, reason
        self._robots.pop(robot, None)
        self._heard.pop(robot, None)
        return {}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)
        self._in_force.pop(robot, None)
        self._heard.pop(robot, None)
        self.switches.forget(robot)
