"""The pymunk car with something hidden in it that the filter's model does not know, and drives that show it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa_lab.hidden.towing import drive_in
from safedpa_sim.robots.car.loads import Load, load_named
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.world import CarWorld

PERIOD: Final = 0.05
"""s"""
_OPEN: Final = (-200.0, 200.0, -200.0, 200.0)
"""m; the field of the training drives."""


@dataclass(frozen=True)
class Hidden:
    """What acts on the car, and the effect of the library that says so."""

    effect: str
    parameters: dict[str, float]
    load: str = "none"
    steering_offset: float = 0.0
    """rad"""
    delay: int = 0
    """Periods by which every command comes late."""


HIDDEN: Final[dict[str, Hidden]] = {
    "steering_offset": Hidden("steering_offset", {"angle": 0.12}, steering_offset=0.12),
    "actuator_delay": Hidden("actuator_delay", {"seconds": 0.2}, delay=4),
    "chair": Hidden("towed_load", {"mass_ratio": 0.8, "deceleration": 1.5}, load="chair"),
}
"""By name: a bent linkage, a slow link, a chair of which the model knows nothing."""


class _HiddenWorld(CarWorld):
    """The car's world, with delayed commands and misaligned wheels."""

    def __init__(
        self,
        hidden: Hidden,
        start: tuple[float, float, float],
        field: tuple[float, float, float, float],
        obstacles: tuple[tuple[float, float, float], ...] = (),
        load: Load | None = None,
    ) -> None:
        super().__init__(start, field, obstacles, load)
        self._offset = hidden.steering_offset
        self._sent = deque([(0.0, 0.0)] * hidden.delay)

    def advance(self, target_speed: float, steer: float, seconds: float) -> None:
        """Holds for ``seconds`` the command that was sent ``delay`` calls ago, the wheels ``offset`` next to it."""
        self._sent.append((target_speed, steer))
        speed, angle = self._sent.popleft()
        super().advance(speed, angle + self._offset, seconds)


def hidden_robot(hidden: Hidden, scene: Scene) -> CarRobot:
    """The robot in a scene, with what is hidden in it."""
    robot = CarRobot(scene, PERIOD)
    robot.world = _HiddenWorld(hidden, scene.start, scene.field, scene.obstacles, scene.load)
    return robot


def incomplete_model() -> PhysicsModel:
    """The car's designer's model, without anything that is hidden."""
    values = {"wheelbase": 0.32, "speed_gain": 5.0, "acceleration_limit": 4.5}
    return PhysicsModel(KinematicBicycle(), (), {f"base.{name}": Setting(v) for name, v in values.items()}, PERIOD)


def oracle_model(hidden: Hidden) -> PhysicsModel:
    """The incomplete model with the hidden effect and its true numbers."""
    own = {name: Setting(value) for name, value in hidden.parameters.items()}
    return incomplete_model().with_effect(effect("car", hidden.effect), own)


def training_runs(hidden: Hidden, seed: int, count: int, seconds: float) -> list[Run]:
    """Drives about an open field, as an engineer makes them to see what a car does."""
    rows = round(seconds / PERIOD)
    runs = []
    for number in range(count):
        random = np.random.default_rng([seed, number, 5])
        start = (0.0, 0.0, float(random.uniform(-3.0, 3.0)))
        world = _HiddenWorld(hidden, start, _OPEN, (), load_named(hidden.load))
        states, actions = drive_in(world, random, rows, PERIOD)
        t = np.arange(rows, dtype=np.float64) * PERIOD
        runs.append(Run(f"drive {number + 1}", incomplete_model().system, t, states, actions, (Stretch(0, rows),)))
    return runs
