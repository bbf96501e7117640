"""What the tests of the safety filter share: the car, scenes around it, random states."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa.safety import AbstractBarrier, FilterSettings, SafetyFilter

FOOTPRINT = (0.08, 0.40, 0.12)
FIELD = (-4.0, 4.0, -4.0, 4.0)


@pytest.fixture(scope="session")
def car() -> PhysicsModel:
    values = {"wheelbase": 0.32, "speed_gain": 4.0, "acceleration_limit": 5.0}
    return PhysicsModel(KinematicBicycle(), (), {f"base.{key}": Setting(value) for key, value in values.items()})


@pytest.fixture(scope="session")
def settings() -> FilterSettings:
    return FilterSettings.for_robot("car")


@pytest.fixture
def car_filter(car: PhysicsModel, settings: FilterSettings) -> SafetyFilter:
    return SafetyFilter.for_model(car, settings, car_barriers(settings, FOOTPRINT, [(2.0, 0.0, 0.3)], FIELD))


@pytest.fixture(scope="session")
def random_scene(settings: FilterSettings) -> Callable[[np.random.Generator, int], list[AbstractBarrier]]:
    def draw(random: np.random.Generator, count: int) -> list[AbstractBarrier]:
        obstacles = np.column_stack([random.uniform(-3.5, 3.5, (count, 2)), random.uniform(0.2, 0.35, count)])
        return car_barriers(settings, FOOTPRINT, obstacles, FIELD)

    return draw


@pytest.fixture(scope="session")
def safe_state() -> Callable[..., NDArray[np.float64]]:
    def draw(random: np.random.Generator, barriers: list[AbstractBarrier], least: float) -> NDArray[np.float64]:
        """A state at which every h >= least."""
        while True:
            x, y, yaw, speed = random.uniform((-3.5, -3.5, -np.pi, -0.6), (3.5, 3.5, np.pi, 2.0))
            state = np.array([x, y, yaw, speed])
            if min(part.h(state).min() for part in barriers) >= least:
                return state

    return draw
