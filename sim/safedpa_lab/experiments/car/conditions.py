"""The scenes of the car experiment, and what can be made harder: world, robot, what is measured and when.

A scene is a start, a goal 4 m ahead and obstacles in between, as in the paper. What the paper leaves open (field,
number, size and places of the obstacles, spread of the start) is declared here.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, hypot, inf, isfinite, pi, sin
from typing import Final, final

import numpy as np

from safedpa.bus import NOMINAL, AbstractNode, Inputs, NominalMessage, Outputs, StateMessage
from safedpa.errors import InputError, did_you_mean
from safedpa.policy import PolicyNode
from safedpa.safety import FilterSettings
from safedpa_sim.closed_loop import Robot
from safedpa_sim.robots.car.loads import Load, footprint, load_named
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS
from safedpa_sim.robots.car.robot import CarRobot, DelayedCommands, PlannedChange
from safedpa_sim.robots.car.scene import Scene

CONFIGURATIONS = {"box": "Box", "chair": "Chair", "none": "Car", "large_chair": "Large Chair"}
"""Name of the load and the paper's name of the configuration, in the order of the paper's table."""

HEAVIER = {"two_cars": Load("two_cars", mass_ratio=2.0, deceleration=1.6, grip=6.0, side=0.45)}
"""As large as the large chair and twice as heavy as the car: heavier than what anything was trained with."""

TICKS = 300
"""Periods of 0.05 s until an episode ends without having reached its goal."""

FIELD = (-4.0, 4.0, -4.0, 4.0)
"""m; lowest x, highest x, lowest y, highest y."""

_START = (0.0, -2.0)
_AHEAD = 4.0
"""m from the start to the goal, along the field's y axis."""
_START_SPREAD = 0.2
"""m to either side."""
_YAW_SPREAD = 0.3
"""rad to either side of straight ahead."""
_COUNT = (3, 5)
"""Fewest and most obstacles."""
_RADII = (0.2, 0.35)
"""m; as the robot's other scenes."""
_BETWEEN = (-2.0, 2.0, -1.2, 1.2)
"""m; where the obstacles' centres lie: between the start and the goal."""
PASSAGE = 0.4
"""m of room beyond twice the footprint's radius between any two solid things."""
_ROW = (-0.4, 0.4)
"""m; position of a row, far enough from start and goal to turn before and behind it."""
_CLEARANCE = 0.35
"""m beyond the footprint's radius that start and goal keep to obstacles."""
_TRIES = 5000
_ROUNDS = 20

Circle = tuple[float, float, float]


def towed_named(name: str) -> Load | None:
    """The load of that name, one that only this experiment knows too. Raises InputError that lists what exists."""
    return HEAVIER[name] if name in HEAVIER else load_named(name)


def car_scene(seed: int, load: str = "none", passage: float = PASSAGE, *, row: bool = False) -> Scene:
    """The scene of a seed: start (0 +- 0.2, -2), yaw pi/2 +- 0.3, goal (0, 2), 3 to 5 obstacles between them.

    At least one obstacle stands in the straight way to the goal; between any two of them, and to the walls, the
    footprint of the configuration fits through with ``passage`` [m] to spare. As a ``row`` they stand side by side
    from wall to wall, each passage exactly so wide: there is no other way to the goal.
    """
    towed = towed_named(load)
    draw = np.random.default_rng([seed, 7])
    x = float(draw.uniform(-_START_SPREAD, _START_SPREAD))
    yaw = pi / 2 + float(draw.uniform(-_YAW_SPREAD, _YAW_SPREAD))
    start = (_START[0] + x, _START[1], yaw)
    goal = (_START[0], _START[1] + _AHEAD)
    if row:
        return Scene(seed, towed, FIELD, _row(draw, start, goal, towed, passage), start, (goal,))
    wanted = int(draw.integers(_COUNT[0], _COUNT[1] + 1))
    for _ in range(_ROUNDS):  # where the first ones stand, there may be no room for the others
        for count in range(wanted, _COUNT[0] - 1, -1):
            obstacles = _obstacles(draw, count, start, goal, towed, passage)
            if obstacles is not None:
                return Scene(seed, towed, FIELD, obstacles, start, (goal,))
    raise InputError(f"seed {seed}, load '{load}': {_COUNT[0]} obstacles found no place; choose another seed")


def _row(
    draw: np.random.Generator, start: Circle, goal: tuple[float, float], load: Load | None, passage: float
) -> tuple[Circle, ...]:
    """The first in the straight way, then to its left and to its right, the last of each side within the wall."""
    _, _, radius = footprint(load)
    gap = 2 * radius + passage
    y, size = float(draw.uniform(*_ROW)), float(draw.uniform(*_RADII))
    way = start[0] + (goal[0] - start[0]) * (y - start[1]) / (goal[1] - start[1])
    placed = [(way + float(draw.uniform(-size - radius, size + radius)), y, size)]
    for side, wall in ((-1.0, -FIELD[0]), (1.0, FIELD[1])):
        x, _, last = placed[0]
        while side * x + last < wall:
            following = float(draw.uniform(*_RADII))
            x, last = x + side * (last + gap + following), following
            placed.append((x, y, following))
    return tuple(placed)


def _obstacles(
    draw: np.random.Generator,
    count: int,
    start: Circle,
    goal: tuple[float, float],
    load: Load | None,
    passage: float,
) -> tuple[Circle, ...] | None:
    """The first of them across the straight way, the others anywhere in between; None when they find no place."""
    _, front, radius = footprint(load)
    gap = 2 * radius + passage
    nose = (start[0] + front * cos(start[2]), start[1] + front * sin(start[2]))
    placed: list[Circle] = []
    for _ in range(_TRIES):
        if len(placed) == count:
            return tuple(placed)
        size = float(draw.uniform(*_RADII))
        low, high, south, north = _BETWEEN
        x, y = float(draw.uniform(low, high)), float(draw.uniform(south, north))
        if not placed:
            aside = size + radius
            way = start[0] + (goal[0] - start[0]) * (y - start[1]) / (goal[1] - start[1])
            x = way + float(draw.uniform(-aside, aside))
        free = all(hypot(x - ox, y - oy) >= gap + size + other for ox, oy, other in placed)
        ends = (start[:2], nose, goal)
        away = all(hypot(x - ex, y - ey) >= size + radius + _CLEARANCE for ex, ey in ends)
        if free and away:
            placed.append((x, y, size))
    return None


class ChangedNominal(AbstractNode):
    """Replaces the policy's node on the bus and publishes ``changed`` of each of its nominal actions."""

    name = PolicyNode.name
    inputs = PolicyNode.inputs
    outputs = PolicyNode.outputs
    share = PolicyNode.share

    def __init__(self, policy: AbstractNode) -> None:
        self._policy = policy

    @abstractmethod
    def changed(self, values: tuple[float, ...], state: StateMessage) -> tuple[float, ...]:
        """The nominal action (actions,) in place of the policy's, in the action's units."""

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        outputs = dict(self._policy.step(robot, state, inputs))
        nominal = outputs[NOMINAL]
        assert isinstance(nominal, NominalMessage)
        outputs[NOMINAL] = dataclasses.replace(nominal, values=self.changed(nominal.values, state))
        return outputs

    def forget(self, robot: str) -> None:  # noqa: D102
        self._policy.forget(robot)


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
        for name in ("passage", "speed", "friction", "noise", "delay"):
            value, positive = getattr(self, name), name in ("speed", "friction")
            if not isfinite(value) or value < 0.0 or (positive and value == 0.0):
                raise InputError(
                    f"{name}: got {value!r}, wanted a finite number, {'more than 0' if positive else '0 or more'}"
                )
        if self.towing not in TOWING:
            raise InputError(f"towing '{self.towing}': {did_you_mean(self.towing, TOWING)}")

    @property
    def label(self) -> str:
        """What differs from the experiment's own conditions, such as ``friction=0.6``; empty when nothing does."""
        usual = vars(Conditions())
        return ",".join(
            f"{name}={value if isinstance(value, (str, bool)) else format(value, 'g')}"
            for name, value in vars(self).items()
            if value != usual[name]
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
        own = CAR_PARAMETERS
        friction, fastest = self.friction * own.friction, self.speed * own.speed_high
        parameters = dataclasses.replace(own, friction=friction, speed_high=fastest)
        return CarRobot(scene, PERIOD, late=late, until_action=reported, parameters=parameters)

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
        self.receive, self.advance, self.scans = robot.receive, robot.advance, robot.scans

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
        elif not self._change.try_apply(self._robot):
            return
        self.tick = self._robot.tick

    def _left(self) -> float:
        """m from the car to its goal."""
        x, y, _, _ = self._robot.values
        return hypot(self._robot.goal[0] - x, self._robot.goal[1] - y)
