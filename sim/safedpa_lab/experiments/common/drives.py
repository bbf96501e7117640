"""Drives through the real nodes in lockstep: the nodes as they ship, and what every experiment counts in a drive."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, Final, final

from safedpa.adaptation import AdaptationNode
from safedpa.bus import (
    LATENT,
    NOMINAL,
    AbstractNode,
    Inputs,
    LatentMessage,
    NominalMessage,
    Outputs,
    ReceivedMessage,
    StateMessage,
)
from safedpa.calibration.from_drives import DriveTick
from safedpa.dynamics import PhysicsModel
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_sim.closed_loop import Robot, Tick, drive

PERIOD: Final = 0.05
"""s; one tick of the car."""
LOADS: Final = ("none", "box", "chair", "large_chair")
"""What the car tows."""


def shipped_nodes(
    model: PhysicsModel, settings: FilterSettings, *policy: AbstractNode, margin: MarginCalibration | None = None
) -> list[AbstractNode]:
    """Adaptation, policy and filter in the order of the data flow.

    ``policy`` are the nodes in place of the model's own. ``margin``: by default what ships for the model.
    """
    safe = SafetyFilterNode(model, settings, margin_for(model) if margin is None else margin)
    return [AdaptationNode(model), *(policy or (PolicyNode(model),)), safe]


@dataclass(frozen=True)
class Outcome:
    """What was counted in one drive."""

    collisions: int
    goals: int
    least_h: float
    """Smallest barrier value that was measured, in the barrier's unit."""
    statuses: Mapping[str, int]
    """Verdicts by status."""

    @property
    def ticks(self) -> int:
        """Periods driven."""
        return sum(self.statuses.values())

    @property
    def changed(self) -> int:
        """Ticks in which the filter did not pass the nominal action on."""
        return self.ticks - self.statuses.get("passed", 0) - self.statuses.get("disabled", 0)


def counted(robot: Any, ticks: Iterable[Tick]) -> Outcome:
    """Drives to the end of the ticks, and counts."""
    statuses: Counter[str] = Counter()
    least = inf
    for tick in ticks:
        statuses[tick.verdict.status] += 1
        least = min(least, tick.verdict.h_now)
    return Outcome(len(robot.collisions), robot.goals_reached, least, dict(statuses))


def statuses_of(each: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """The verdicts of several drives together, by status in alphabetical order."""
    together: Counter[str] = Counter()
    for statuses in each:
        together.update(statuses)
    return dict(sorted(together.items()))


def driven_with_latents(robot: Robot, nodes: list[AbstractNode], count: int) -> tuple[list[Tick], list[DriveTick]]:
    """The ticks of a drive, and each state with the latent of its tick, as a calibration takes them."""
    latents: dict[int, LatentMessage] = {}

    def hear(item: ReceivedMessage) -> None:
        if item.topic is LATENT and isinstance(item.message, LatentMessage):
            latents[item.message.tick] = item.message

    ticks = list(drive(robot, nodes, count, hear=hear))
    return ticks, [DriveTick(tick.state, latents.get(tick.state.tick)) for tick in ticks]


def stamp(state: StateMessage) -> dict[str, Any]:
    """The fields that a node's message of this tick shares with its state."""
    shared = {name: getattr(state, name) for name in ("epoch", "tick", "robot_time")}
    return {**shared, "publish_time": time.time()}


@final
class FunctionPolicyNode(AbstractNode):
    """Takes the policy's place on the bus and publishes ``nominal_action(state)``, in the action's units."""

    name = PolicyNode.name
    inputs = ()
    outputs = (NOMINAL,)
    share = 0.2
    defers_afterwards = False

    def __init__(self, nominal_action: Callable[[StateMessage], tuple[float, ...]], controller: str) -> None:
        self._nominal_action, self._controller = nominal_action, controller

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del robot, inputs
        values = self._nominal_action(state)
        return {NOMINAL: NominalMessage(**stamp(state), values=values, controller=self._controller)}
