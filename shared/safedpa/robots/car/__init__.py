"""The car: system, bases, effects, barriers, observation, controllers, and what a person may choose of it."""

from safedpa.robots.car.robot import ROBOT, Car

__all__ = ["ROBOT", "Car"]
