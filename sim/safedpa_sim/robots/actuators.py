"""The motor with its speed servo, and the steering actuator."""

from __future__ import annotations

from math import exp

from safedpa_sim.robots.car_parameters import CarParameters

__all__ = ["SpeedServo", "SteeringActuator"]


class SpeedServo:
    """d(a)/dt = (clip(servo_gain (target - speed), +-servo_limit) - a) / servo_lag.

    a [m/s2] is drive force over the car's mass.
    """

    def __init__(self, parameters: CarParameters) -> None:
        self._parameters = parameters
        self.acceleration = 0.0

    def advance(self, target: float, speed: float, seconds: float) -> float:
        """The drive acceleration [m/s2] at the end of ``seconds``."""
        car = self._parameters
        wanted = min(max(car.servo_gain * (target - speed), -car.servo_limit), car.servo_limit)
        self.acceleration += (wanted - self.acceleration) * (1.0 - exp(-seconds / car.servo_lag))
        return self.acceleration


class SteeringActuator:
    """d(angle)/dt = clip((command - angle) / steer_lag, +-steer_rate); angle [rad] is that of the wheels."""

    def __init__(self, parameters: CarParameters) -> None:
        self._parameters = parameters
        self.angle = 0.0

    def advance(self, command: float, seconds: float) -> float:
        """The wheels' angle [rad] at the end of ``seconds``."""
        car = self._parameters
        change = (command - self.angle) * (1.0 - exp(-seconds / car.steer_lag))
        largest = car.steer_rate * seconds
        self.angle += min(max(change, -largest), largest)
        return self.angle
