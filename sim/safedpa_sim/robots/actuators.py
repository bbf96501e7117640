"""The motor with its speed servo, and the steering actuator."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import exp

from safedpa_sim.robots.car_parameters import CarParameters

__all__ = ["SpeedServo", "SteeringActuator"]


def _cached_share(lag: float) -> Callable[[float], float]:
    """1 - exp(-seconds / lag), the share of its way that a first-order lag goes; a car asks for one length for ever."""
    return lru_cache(maxsize=8)(lambda seconds: 1.0 - exp(-seconds / lag))


class SpeedServo:
    """d(a)/dt = (clip(servo_gain (target - speed), +-servo_limit) - a) / servo_lag.

    a [m/s2] is drive force over the car's mass.
    """

    def __init__(self, parameters: CarParameters) -> None:
        self.gain, self.limit = parameters.servo_gain, parameters.servo_limit
        self.share = _cached_share(parameters.servo_lag)
        """Of its way to the wanted acceleration that it goes in so many seconds."""
        self.acceleration = 0.0

    def advance(self, target: float, speed: float, seconds: float) -> float:
        """The drive acceleration [m/s2] at the end of ``seconds``."""
        wanted, limit = self.gain * (target - speed), self.limit
        wanted = -limit if wanted < -limit else limit if wanted > limit else wanted
        self.acceleration += (wanted - self.acceleration) * self.share(seconds)
        return self.acceleration


class SteeringActuator:
    """d(angle)/dt = clip((command - angle) / steer_lag, +-steer_rate); angle [rad] is that of the wheels."""

    def __init__(self, parameters: CarParameters) -> None:
        self._rate = parameters.steer_rate
        self._share = _cached_share(parameters.steer_lag)
        self.angle = 0.0

    def advance(self, command: float, seconds: float) -> float:
        """The wheels' angle [rad] at the end of ``seconds``."""
        return self.angles(command, seconds, 1)[0]

    def angles(self, command: float, seconds: float, steps: int) -> list[float]:
        """The wheels' angle [rad] at the end of each of so many steps of ``seconds`` under one command."""
        share, largest, angle, found = self._share(seconds), self._rate * seconds, self.angle, []
        for _ in range(steps):
            change = (command - angle) * share
            angle += -largest if change < -largest else largest if change > largest else change
            found.append(angle)
        self.angle = angle
        return found
