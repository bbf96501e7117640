"""Effects of the differential drive: classes, and a table of delay and lag of the commands."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.channel_effects import EVERY, ChannelEffect
from safedpa.effects.effect import CommandEffect, Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, resistance
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

EFFECTS = (
    ChannelEffect(  # a slow link: all commands arrive late
        "differential_drive", "actuator_delay", EVERY, "delay", Parameter("seconds", "s", 0.0, 0.5, 0.1),
        called="action",
        signature="after each change of command speed and turn rate go on for a while as if nothing had been sent",
        source="dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
    ),
    ChannelEffect(  # both motors alike
        "differential_drive", "drive_lag", EVERY, "lag", Parameter("time_constant", "s", 0.0, 2.0, 0.15),
        called="action",
        signature="residuals of acceleration after each change of a command, against the change, dying out",
        source="Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    ),
)  # fmt: skip


@final
class Payload(RateEffect):
    """Mass on board: (1 + mass_ratio) d(speed, turn_rate)/dt = acceleration of the empty robot.

    The load is assumed to be distributed like the robot's own mass.
    """

    name = "payload"
    robot = "differential_drive"
    stage = Stage.OWN_MASS
    equation = "(1 + mass_ratio) d(speed, turn_rate)/dt = that of the empty robot"
    parameters = (Parameter("mass_ratio", "1", 0.0, 5.0, 0.3, meaning="mass of the load over mass of the robot"),)
    signature = "all accelerations too small by one factor, those of turning as well"
    source = "Newton's second law"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        del context
        share = 1.0 / (1.0 + parameters["mass_ratio"])
        return {**rates, "speed": rates["speed"] * share, "turn_rate": rates["turn_rate"] * share}


@final
class RollingResistance(RateEffect):
    """Castors and carpet: d(speed)/dt -= deceleration sign(speed), smoothed near rest, whatever the mass on board."""

    name = "rolling_resistance"
    robot = "differential_drive"
    stage = Stage.WEIGHT
    equation = "d(speed)/dt -= deceleration sign(speed)"
    parameters = (Parameter("deceleration", "m/s2", 0.0, 10.0, 0.3),)
    signature = "one deceleration at every speed, none at rest: it stays below the commanded speed"
    source = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        pull = resistance(rates["speed"], context.state["speed"], parameters["deceleration"], REST_SPEED, context)
        return {**rates, "speed": rates["speed"] - pull}


@final
class TrackError(CommandEffect):
    """A true track other than the driver assumes: felt target_turn_rate = target_turn_rate / ratio."""

    name = "track_error"
    robot = "differential_drive"
    stage = Stage.COMMAND_SCALE
    equation = "target_turn_rate_felt = target_turn_rate / ratio"
    parameters = (Parameter("ratio", "1", 0.3, 3.0, 1.1, neutral=1.0, meaning="true track over assumed track"),)
    signature = "turn rates off by one factor, speeds not"
    source = "Borenstein, Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12(6), 1996 (E_b)"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, "target_turn_rate": action["target_turn_rate"] / parameters["ratio"]}, memory


@final
class UnequalWheels(CommandEffect):
    """Unequal radii, as with a soft tyre: felt target_turn_rate = target_turn_rate + pull target_speed."""

    name = "unequal_wheels"
    robot = "differential_drive"
    stage = Stage.COMMAND_LINKAGE
    equation = "target_turn_rate_felt = target_turn_rate + pull target_speed"
    parameters = (
        Parameter("pull", "rad/m", -5.0, 5.0, 0.2, meaning="difference of the radii over their mean, over the track"),
    )
    mirrored = ("pull",)
    signature = "it drives a curve at command straight ahead, more at higher speed"
    source = "Borenstein, Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12(6), 1996 (E_d)"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        turn = action["target_turn_rate"] + parameters["pull"] * action["target_speed"]
        return {**action, "target_turn_rate": turn}, memory


@final
class WheelRadius(CommandEffect):
    """Worn, soft or replaced tyres: felt target_speed and target_turn_rate are the commands times ratio."""

    name = "wheel_radius"
    robot = "differential_drive"
    stage = Stage.COMMAND_SCALE
    equation = "action_felt = ratio action"
    parameters = (Parameter("ratio", "1", 0.3, 3.0, 0.9, neutral=1.0, meaning="true radius over assumed radius"),)
    signature = "speeds and turn rates off by the same factor"
    source = "Borenstein, Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12(6), 1996"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {name: parameters["ratio"] * command for name, command in action.items()}, memory


@final
class WheelSlip(RateEffect):
    """Wheels slip outwards with s = compliance speed turn_rate: d(x)/dt += s sin(yaw), d(y)/dt -= s cos(yaw)."""

    name = "wheel_slip"
    robot = "differential_drive"
    stage = Stage.SLIP
    equation = "sideways = compliance speed turn_rate, outwards"
    parameters = (Parameter("compliance", "s", 0.0, 2.0, 0.1, meaning="sideways speed over sideways acceleration"),)
    signature = "curves end farther outside than they should, the more the faster and the tighter they are"
    source = "Siegwart, Nourbakhsh, Scaramuzza, Autonomous Mobile Robots, 2nd ed., section 3.2 (sliding constraint)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        state, operations = context.state, context.operations
        sideways = parameters["compliance"] * state["speed"] * state["turn_rate"]
        return {
            **rates,
            "x": rates["x"] + sideways * operations.sin(state["yaw"]),
            "y": rates["y"] - sideways * operations.cos(state["yaw"]),
        }
