"""What can be made harder about an episode of the car experiment: its world, its robot, what is measured and when."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import hypot, inf, isfinite
from typing import Final, final

import numpy as np

from safedpa.bus import AbstractNode, StateMessage
from safedpa.errors import InputError, did_you_mean
from safedpa.policy import PolicyNode
from safedpa.safety import FilterSettings
from safedpa_lab.experiments.car.scenes import PASSAGE, car_scene
from safedpa_lab.experiments.driving.changed_nominal import ChangedNominal
from safedpa_sim.closed_loop import Robot
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS, CarParameters
from safedpa_sim.robots.car.robot import CarRobot, DelayedCommands
from safedpa_sim.robots.changes import PlannedChange

PERIOD: Final = 0.05
"""s; one tick."""
TOWING: Final = ("always", "never", "from_a_third", "to_a_third")
"""Whether the load hangs behind the car all the way, never, from a third of the way on, or up to there."""
_HITCHED: Final = "chair"
"""The only load that can be hitched while driving: ``PlannedChange`` knows when there is room for it."""
_THIRD: Final = 1.0 / 3.0
_YAW_BASE: Final = CAR_PARAMETERS.wheelbase
"""m between two marks on the car whose places, measured as well as x and y, would tell its yaw."""
_SPEED_BASE: Final = 0.2
"""s between two such places that would tell its speed."""


@final
@dataclass(frozen=True)
class Conditions:
    """Of an episode; what is not given is as everywhere else in the experiment. Raises InputError naming the field."""

    passage: float = PASSAGE
    """m of room beyond twice the footprint's radius that is left between any two solid things, at least."""
    row: bool = False
    """Whether the obstacles form a row from wall to wall, so that the car must take one of the passages."""
    towing: str = TOWING[0]
    """One of ``TOWING``; the obstacles are those of the load's footprint in any case."""
    speed: float = 1.0
    """What the policy's speeds are multiplied by, and with them the largest command that robot and filter allow (2 m/s)
    and the filter's barrier on speed (2.2 m/s)."""
    friction: float = 1.0
    """Of the tyres, as a share of the car's own (0.9)."""
    noise: float = 0.0
    """m; standard deviation of what is added to the measured x and y in every tick; to yaw [rad] this over the
    wheelbase (0.32 m), to the speed [m/s] this over 0.2 s."""
    delay: float = 0.0
    """s from the measurement of a state to the moment from which its action acts."""
    reported: bool = True
    """Whether the state reports it (``until_action``), so that the filter accounts for it."""

    def __post_init__(self) -> None:
        for name, low in (("passage", 0.0), ("speed", 0.0), ("friction", 0.0), ("noise", 0.0), ("delay", 0.0)):
            value = getattr(self, name)
            if not isfinite(value) or value < low or (value == 0.0 and name in ("speed", "friction")):
                above = "more than 0" if name in ("speed", "friction") else "0 or more"
                raise InputError(f"{name}: got {value!r}, wanted a finite number, {above}")
        if self.towing not in TOWING:
            raise InputError(f"towing '{self.towing}': {did_you_mean(self.towing, TOWING)}")

    @property
    def label(self) -> str:
        """What differs from the experiment's own conditions, such as ``friction=0.6``; empty when nothing does."""
        changed = [(item.name, getattr(self, item.name)) for item in fields(self)]
        usual = Conditions()
        return ",".join(
            f"{name}={value if isinstance(value, (str, bool)) else format(value, 'g')}"
            for name, value in changed
            if value != getattr(usual, name)
        )

    def robot(self, seed: int, load: str) -> CarRobot:
        """The pymunk car in the scene of a seed. Raises InputError for a load that cannot be hitched while driving."""
        if self.towing == "from_a_third" and load != _HITCHED:
            raise InputError(
                f"load hitched while driving: got '{load}', wanted '{_HITCHED}'; others are towed from the start"
            )
        scene = car_scene(seed, load, self.passage, row=self.row)
        if self.towing in ("never", "from_a_third"):
            scene = dataclasses.replace(scene, load=None)
        late = DelayedCommands(self.delay, self.delay) if self.delay else None
        reported = self.delay if self.reported else 0.0
        return CarRobot(scene, PERIOD, late=late, until_action=reported, parameters=self._parameters())

    def _parameters(self) -> CarParameters:
        own = CAR_PARAMETERS
        return dataclasses.replace(own, friction=self.friction * own.friction, speed_high=self.speed * own.speed_high)

    def measured(self, robot: CarRobot) -> Robot:
        """The robot as the nodes see it."""
        return NoisyRobot(robot, self.noise) if self.noise else robot

    def settings(self, settings: FilterSettings) -> FilterSettings:
        """The filter's settings, with its limits of speed."""
        if self.speed == 1.0:
            return settings
        fastest, *others = settings.action_high
        scaled = dataclasses.replace(settings, action_high=(self.speed * fastest, *others))
        return scaled.with_barriers(speed_high=self.speed * settings.barrier("speed_high"))

    def nodes(self, nodes: Sequence[AbstractNode]) -> list[AbstractNode]:
        """The nodes, the policy's speeds scaled."""
        if self.speed == 1.0:
            return list(nodes)
        return [QuickerPolicyNode(node, self.speed) if isinstance(node, PolicyNode) else node for node in nodes]


@final
class NoisyRobot:
    """A car whose state is measured with white noise; the noise depends on seed and tick only."""

    def __init__(self, robot: CarRobot, noise: float) -> None:
        self._robot = robot
        self._draw = np.random.default_rng([robot.scene.seed, 17])
        self._deviations = np.array([noise, noise, noise / _YAW_BASE, noise / _SPEED_BASE])
        self.receive, self.advance = robot.receive, robot.advance

    def state_message(self) -> StateMessage:
        """State k as measured; to be read once per tick."""
        true = self._robot.state_message()
        values = np.array(true.values) + self._deviations * self._draw.standard_normal(len(self._deviations))
        return dataclasses.replace(true, values=tuple(values.tolist()))


@final
class QuickerPolicyNode(ChangedNominal):
    """A policy whose nominal actions to drive forwards are so many times as fast, or as slow."""

    def __init__(self, policy: AbstractNode, factor: float) -> None:
        super().__init__(policy)
        self._factor = factor

    def changed(self, values: tuple[float, ...], state: StateMessage) -> tuple[float, ...]:  # noqa: D102
        del state
        speed, *others = values
        return (self._factor * speed, *others) if speed > 0.0 else values


@final
class LoadOnTheWay:
    """Hitches the load, or lets it go, once a third of the way to the goal is behind the car.

    It is hitched at the first tick from then on at which the car drives and there is room behind, next to and ahead.
    """

    def __init__(self, towing: str, robot: CarRobot) -> None:
        self._towing, self._robot = towing, robot
        self._change = PlannedChange("hitch", 0.0)
        self._near = (1.0 - _THIRD) * self._left() if towing in ("from_a_third", "to_a_third") else -inf
        self.tick: int | None = None
        """In which it was done; None while it is not."""

    def see(self) -> None:
        """Between two ticks."""
        if self.tick is not None or self._left() > self._near:
            return
        if self._towing == "to_a_third":
            self._robot.unhitch()
            self.tick = self._robot.tick
        elif self._change.try_apply(self._robot):
            self.tick = self._robot.tick

    def _left(self) -> float:
        """m from the car to its goal."""
        x, y, _, _ = self._robot.values
        return hypot(self._robot.goal[0] - x, self._robot.goal[1] - y)
