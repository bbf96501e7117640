"""What changes a car's path, or the measurement of its speed: drift, slip, steering, odometry."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Context, Named, RateEffect, SensorEffect, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations


@final
class CrosswindDrift(RateEffect):
    """Ground or medium that carries the car along: d(x)/dt grows by vx, d(y)/dt by vy, whatever the car's motion."""

    name = "crosswind_drift"
    robot = "car"
    stage = Stage.DRIFT
    equation = "d(x)/dt += vx, d(y)/dt += vy"
    parameters = (
        Parameter("vx", "m/s", -2.0, 2.0, 0.1, meaning="along the world's x"),
        Parameter("vy", "m/s", -2.0, 2.0, 0.1, meaning="along the world's y"),
    )
    signature = "position residual of one velocity in the world, the same for every heading and speed, also at rest"
    source = "Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011, ch. 8 (currents)"
    mirrored = ("vy",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return {**rates, "x": rates["x"] + parameters["vx"], "y": rates["y"] + parameters["vy"]}


@final
class SpeedSensorScale(SensorEffect):
    """A wrong wheel radius: measured speed = scale true speed; the position follows the true one."""

    name = "speed_sensor_scale"
    robot = "car"
    stage = Stage.SENSOR
    equation = "measured speed = scale speed"
    parameters = (Parameter("scale", "1", 0.3, 3.0, 1.05, neutral=1.0, meaning="measured speed over true speed"),)
    signature = "distance covered differs from the integral of the measured speed by one share; yaw rate likewise"
    source = "Borenstein and Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12, 1996"

    def measure(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        return {**state, "speed": state["speed"] * parameters["scale"]}

    def restore(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        return {**state, "speed": state["speed"] / parameters["scale"]}


@final
class SteeringAsymmetry(CommandEffect):
    """Steering that turns further to one side: by 1 + difference / 2 to the left, 1 - difference / 2 to the right."""

    name = "steering_asymmetry"
    robot = "car"
    stage = Stage.COMMAND_LINKAGE
    equation = "steer_felt = steer + difference |steer| / 2"
    parameters = (Parameter("difference", "1", -1.0, 1.0, 0.1, meaning="gain to the left minus gain to the right"),)
    signature = "yaw-rate residual of one sign in left and right curves, none when straight"
    source = (
        "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024, steering model (left and right curves differ)"
    )
    mirrored = ("difference",)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        steer = action["steer"]
        felt = steer + 0.5 * parameters["difference"] * operations.absolute(steer)
        return {**action, "steer": felt}, memory


@final
class TyreSlip(RateEffect):
    """Rear tyres slip in curves: direction of travel = yaw - atan(compliance lateral acceleration).

    Lateral acceleration = speed d(yaw)/dt. The rear tyres need a slip angle for their side force. The heading is not
    changed (see understeer).
    """

    name = "tyre_slip"
    robot = "car"
    stage = Stage.SLIP
    equation = "direction of travel = yaw - atan(compliance speed d(yaw)/dt)"
    parameters = (
        Parameter("compliance", "s2/m", 0.0, 0.5, 0.02, meaning="slip angle of the rear axle per lateral acceleration"),
    )
    signature = "position residual across the car, outwards, growing with the cube of speed; none in the yaw rate"
    source = "Rajamani, Vehicle Dynamics and Control, 2nd ed., section 2.3 (slip angle of the rear tyres)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        operations = context.operations
        slip = operations.atan(parameters["compliance"] * context.state["speed"] * rates["yaw"])
        cosine, sine = operations.cos(slip), operations.sin(slip)
        return {**rates, "x": rates["x"] * cosine + rates["y"] * sine, "y": rates["y"] * cosine - rates["x"] * sine}


@final
class Understeer(RateEffect):
    """Understeer, the curve widens with the speed: yaw rate = speed tan(steer) / (wheelbase + gradient speed^2).

    A negative gradient is oversteer. The denominator is at least a quarter of the wheelbase: below that the
    steady-state formula is not valid (the car would spin).
    """

    name = "understeer"
    robot = "car"
    stage = Stage.MOTION
    equation = "d(yaw)/dt = speed tan(steer) / (wheelbase + gradient speed^2)"
    parameters = (
        Parameter(
            "gradient", "s2/m", -0.05, 1.0, 0.02, meaning="angle of steer per lateral acceleration; below 0: oversteer"
        ),
    )
    signature = "yaw-rate residual against the curve that grows with the cube of speed; none at low speed"
    source = "Rajamani, Vehicle Dynamics and Control, 2nd ed., section 3.3 (understeer gradient)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        speed, wheelbase = context.state["speed"], context.base["wheelbase"]
        effective = context.operations.maximum(wheelbase + parameters["gradient"] * speed * speed, 0.25 * wheelbase)
        return {**rates, "yaw": rates["yaw"] * (wheelbase / effective)}
