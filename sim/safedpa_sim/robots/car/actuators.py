"""Actuators of the simulated car: motor with speed servo or throttle, and steering."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import exp, tanh

from safedpa_sim.robots.car.parameters import CarParameters, ThrottleParameters


def _cached_share(lag: float) -> Callable[[float], float]:
    """Returns 1 - exp(-seconds / lag), the step response of a first-order lag; cached, as a run uses few step sizes."""
    return lru_cache(maxsize=8)(lambda seconds: 1.0 - exp(-seconds / lag))


class SpeedServo:
    """d(a)/dt = (clip(servo_gain (target - speed), +-servo_limit) - a) / servo_lag.

    a [m/s2] is drive force over the car's mass.
    """

    def __init__(self, parameters: CarParameters) -> None:
        self.gain, self.limit = parameters.servo_gain, parameters.servo_limit
        self.share = _cached_share(parameters.servo_lag)
        """Share of the step to the target acceleration that is covered in the given seconds."""
        self.acceleration = 0.0

    def pull(self, command: float) -> tuple[float, float, float]:
        """Returns (push [m/s2], gain [1/s], target [m/s]); the target acceleration is push + gain (target - speed)."""
        return 0.0, self.gain, command

    def advance(self, target: float, speed: float, seconds: float) -> float:
        """Returns the drive acceleration [m/s2] at the end of ``seconds``."""
        wanted, limit = self.gain * (target - speed), self.limit
        wanted = -limit if wanted < -limit else limit if wanted > limit else wanted
        self.acceleration += (wanted - self.acceleration) * self.share(seconds)
        return self.acceleration


class ThrottleMotor:
    """d(a)/dt = (clip(gain felt - back_emf |felt| speed, +-servo_limit) - a) / servo_lag.

    felt = throttle - clip(throttle, +-dead_zone) is the throttle beyond the dead zone; a [m/s2] is drive force over the
    car's mass.
    """

    def __init__(self, parameters: CarParameters, motor: ThrottleParameters) -> None:
        self.motor, self.limit = motor, parameters.servo_limit
        self.share = _cached_share(parameters.servo_lag)
        """Share of the step to the target acceleration that is covered in the given seconds."""
        self.acceleration = 0.0

    def pull(self, command: float) -> tuple[float, float, float]:
        """Returns (push [m/s2], gain [1/s], target [m/s]); the target acceleration is push + gain (target - speed)."""
        felt = command - min(max(command, -self.motor.dead_zone), self.motor.dead_zone)
        return self.motor.gain * felt, self.motor.back_emf * abs(felt), 0.0

    def braking(self, speed: float, deceleration: float) -> float:
        """Returns the throttle that decelerates the car by ``deceleration`` [m/s2] at this speed, for the watchdog."""
        if speed == 0.0 or deceleration <= 0.0:
            return 0.0
        size = self.motor.dead_zone + deceleration / (self.motor.gain + self.motor.back_emf * abs(speed))
        return -min(size, 1.0) if speed > 0.0 else min(size, 1.0)


def drive_of(parameters: CarParameters) -> SpeedServo | ThrottleMotor:
    """Returns the motor model of a car."""
    return SpeedServo(parameters) if parameters.throttle is None else ThrottleMotor(parameters, parameters.throttle)


class SteeringActuator:
    """d(angle)/dt = clip((command - angle) / steer_lag, +-steer_rate); angle [rad] is that of the wheels.

    With a compliant linkage (steer_end > 0), the command is replaced by steer_end tanh(steer_slope command /
    steer_end).
    """

    def __init__(self, parameters: CarParameters) -> None:
        self._slope, self._end = parameters.steer_slope, parameters.steer_end
        self._rate = parameters.steer_rate
        self._share = _cached_share(parameters.steer_lag)
        self.angle = 0.0

    def advance(self, command: float, seconds: float) -> float:
        """Returns the wheels' angle [rad] at the end of ``seconds``."""
        return self.angles(command, seconds, 1)[0]

    def angles(self, command: float, seconds: float, steps: int) -> list[float]:
        """Returns the wheels' angle [rad] at the end of each of ``steps`` steps of ``seconds`` under one command."""
        if self._end > 0.0:
            command = self._end * tanh(self._slope * command / self._end)
        share, largest, angle, found = self._share(seconds), self._rate * seconds, self.angle, []
        for _ in range(steps):
            change = (command - angle) * share
            angle += -largest if change < -largest else largest if change > largest else change
            found.append(angle)
        self.angle = angle
        return found
