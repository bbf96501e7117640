"""The kinematic bicycle model with a speed servo or a throttle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal, final

from safedpa.dynamics.base import AbstractBase
from safedpa.effects.effect import Named
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations, Scalar
from safedpa.robots.car.system import CAR, CAR_THROTTLE

Drive = Literal["speed_servo", "throttle"]

_WHEELBASE = Parameter("wheelbase", "m", 0.01, 10.0, 0.32, neutral=None, meaning="front axle to rear axle")
_SPEED_GAIN = Parameter("speed_gain", "1/s", 0.05, 50.0, 3.0, neutral=None, meaning="gain of the speed servo")
_LIMIT = Parameter("acceleration_limit", "m/s2", 0.1, 50.0, 6.0, neutral=None, meaning="limit of the servo")
_DRIVE_GAIN = Parameter("drive_gain", "m/s2", 0.01, 100.0, 5.0, neutral=None, meaning="at full throttle")
_TRACKED_POINT = Parameter(
    "tracked_point", "m", -10.0, 10.0, 0.15, meaning="position of the state, ahead of the rear axle"
)


@final
class KinematicBicycle(AbstractBase):
    """A car whose wheels roll without slip; position and speed are those of a point on its centre line.

    With beta = atan(tracked_point / wheelbase tan(steer)), the angle between that point's velocity and the heading,

    d(x)/dt = speed cos(yaw + beta), d(y)/dt = speed sin(yaw + beta), d(yaw)/dt = speed cos(beta) tan(steer) / wheelbase

    - speed_servo: d(speed)/dt = clip(speed_gain (target_speed - speed), +-acceleration_limit);
    - throttle: d(speed)/dt = drive_gain throttle.

    The point is ``tracked_point`` metres ahead of the rear axle; the default 0 is the rear axle itself (beta = 0).

    Source: Rajamani, Vehicle Dynamics and Control, 2nd ed., section 2.2. Valid while tyres do not slip.
    """

    kind = "kinematic_bicycle"
    equation = (
        "x' = v cos(yaw + beta), y' = v sin(yaw + beta), yaw' = v cos(beta) tan(steer)/wheelbase, v' = drive, "
        "beta = atan(tracked_point/wheelbase tan(steer))"
    )
    source = "Rajamani, Vehicle Dynamics and Control, section 2.2"
    choices: ClassVar[Mapping[str, tuple[str, ...]]] = {"drive": ("speed_servo", "throttle")}

    def __init__(self, drive: Drive = "speed_servo") -> None:
        self.drive = drive
        self.system = CAR if drive == "speed_servo" else CAR_THROTTLE
        servo = (_SPEED_GAIN, _LIMIT)
        self.parameters = (_WHEELBASE, *(servo if drive == "speed_servo" else (_DRIVE_GAIN,)), _TRACKED_POINT)

    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:  # noqa: D102
        speed, course = state["speed"], state["yaw"]
        turning = speed * operations.tan(action["steer"]) / parameters["wheelbase"]
        point = parameters["tracked_point"]
        if not (isinstance(point, float) and point == 0.0):  # for the rear axle beta = 0; skips the computation
            slope = point / parameters["wheelbase"] * operations.tan(action["steer"])
            course = course + operations.atan(slope)
            turning = turning / operations.sqrt(1.0 + slope * slope)  # cos(atan(slope))
        return {
            "x": speed * operations.cos(course),
            "y": speed * operations.sin(course),
            "yaw": turning,
            "speed": self._acceleration(speed, action, parameters, operations),
        }

    def _acceleration(self, speed: Scalar, action: Named, parameters: Named, operations: Operations) -> Scalar:
        if self.drive == "throttle":
            return parameters["drive_gain"] * action["throttle"]
        wanted = parameters["speed_gain"] * (action["target_speed"] - speed)
        limit = parameters["acceleration_limit"]
        return operations.clip(wanted, -limit, limit)
