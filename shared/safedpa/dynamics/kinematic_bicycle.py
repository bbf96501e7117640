"""The kinematic bicycle, driven by a speed servo or by throttle."""

from __future__ import annotations

from typing import Literal, final

from safedpa.dynamics.base import AbstractBase
from safedpa.effects.effect import Named
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations, Scalar
from safedpa.systems import CAR, CAR_THROTTLE

__all__ = ["Drive", "KinematicBicycle"]

Drive = Literal["speed_servo", "throttle"]

_WHEELBASE = Parameter("wheelbase", "m", 0.01, 10.0, 0.32, neutral=None, meaning="front axle to rear axle")
_SPEED_GAIN = Parameter("speed_gain", "1/s", 0.05, 50.0, 3.0, neutral=None, meaning="gain of the speed servo")
_LIMIT = Parameter("acceleration_limit", "m/s2", 0.1, 50.0, 6.0, neutral=None, meaning="limit of the servo")
_DRIVE_GAIN = Parameter("drive_gain", "m/s2", 0.01, 100.0, 5.0, neutral=None, meaning="at full throttle")


@final
class KinematicBicycle(AbstractBase):
    """A car whose wheels roll without slip; the position is that of the middle of the rear axle.

    d(x)/dt = speed cos(yaw), d(y)/dt = speed sin(yaw), d(yaw)/dt = speed tan(steer) / wheelbase, and

    - speed_servo: d(speed)/dt = clip(speed_gain (target_speed - speed), +-acceleration_limit);
    - throttle: d(speed)/dt = drive_gain throttle.

    Source: Rajamani, Vehicle Dynamics and Control, 2nd ed., section 2.2. Valid while tyres do not slip.
    """

    kind = "kinematic_bicycle"
    equation = "x' = v cos(yaw), y' = v sin(yaw), yaw' = v tan(steer)/wheelbase, v' = drive"
    source = "Rajamani, Vehicle Dynamics and Control, section 2.2"

    def __init__(self, drive: Drive = "speed_servo") -> None:
        self.drive = drive
        self.system = CAR if drive == "speed_servo" else CAR_THROTTLE
        servo = (_SPEED_GAIN, _LIMIT)
        self.parameters = (_WHEELBASE, *(servo if drive == "speed_servo" else (_DRIVE_GAIN,)))

    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:  # noqa: D102
        speed, yaw = state["speed"], state["yaw"]
        return {
            "x": speed * operations.cos(yaw),
            "y": speed * operations.sin(yaw),
            "yaw": speed * operations.tan(action["steer"]) / parameters["wheelbase"],
            "speed": self._acceleration(speed, action, parameters, operations),
        }

    def _acceleration(self, speed: Scalar, action: Named, parameters: Named, operations: Operations) -> Scalar:
        if self.drive == "throttle":
            return parameters["drive_gain"] * action["throttle"]
        wanted = parameters["speed_gain"] * (action["target_speed"] - speed)
        limit = parameters["acceleration_limit"]
        return operations.clip(wanted, -limit, limit)
