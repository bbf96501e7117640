"""The perception service's step: surroundings[k] from state[k] and the scans before it."""

from __future__ import annotations

import time
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
from safedpa.perception.settings import PerceptionSettings
from safedpa.perception.surroundings import Surroundings

__all__ = ["PerceptionNode"]


@final
class PerceptionNode(AbstractNode):
    """Tells of each robot that has sources what is around it at the moment of its state; of others, nothing."""

    name = "perception"
    inputs = ()
    outputs = (SURROUNDINGS,)
    listens = (SCAN,)
    share = 0.0
    lingers = False

    def __init__(self, settings: PerceptionSettings | None = None) -> None:
        self._settings = settings or PerceptionSettings()
        self._robots: dict[str, Surroundings] = {}

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        assert isinstance(message, ScanMessage)
        self._of(robot).hear(message)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del inputs
        if not state.sources:
            return {}
        around = self._of(robot)
        seen = around.at(state)
        message = SurroundingsMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            points=seen.points,
            movers=seen.movers,
            hidden=seen.hidden,
            ages=around.sources.ages(state.robot_time),
            amiss=around.sources.amiss(state.robot_time),
        )
        return {SURROUNDINGS: message}

    def _of(self, robot: str) -> Surroundings:
        if robot not in self._robots:
            self._robots[robot] = Surroundings(self._settings)
        return self._robots[robot]

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """Nothing: the filter brakes. What is remembered may be broken and begins anew."""
        del state, reason
        self._robots.pop(robot, None)
        return {}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)
