"""Effects of the point robot: classes, and a table of those that act on the commands in a general way."""

from __future__ import annotations

from typing import final

from safedpa.effects.channel_effects import EVERY, ChannelEffect
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

EFFECTS = (
    ChannelEffect(  # a slow link: all commands arrive late
        "point", "actuator_delay", EVERY, "delay", Parameter("seconds", "s", 0.0, 0.5, 0.1), called="action",
        signature="residuals of acceleration and turn rate after each change of command, both as if it had not been "
        "sent yet",
        source="dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
    ),
    ChannelEffect(
        "point", "actuator_gain", "thrust", "gain", Parameter("gain", "1", 0.1, 3.0, 0.8, neutral=1.0),
        signature="acceleration residual along the heading in proportion to the thrust",
        source="wear of a thruster; Chen and Patton, Robust Model-Based Fault Diagnosis, 1999, ch. 2",
    ),
)  # fmt: skip


@final
class ConstantForce(RateEffect):
    """A steady push, wind, or a sloping table: d(vx, vy)/dt += (ax, ay), in the world's frame."""

    name = "constant_force"
    robot = "point"
    stage = Stage.RESISTANCE
    equation = "d(vx)/dt += ax, d(vy)/dt += ay"
    parameters = (
        Parameter("ax", "m/s2", -20.0, 20.0, 0.8, meaning="force over the robot's own mass"),
        Parameter("ay", "m/s2", -20.0, 20.0, 0.8, meaning="force over the robot's own mass"),
    )
    mirrored = ("ay",)
    signature = "one constant acceleration in the world's frame, whatever the heading and the speed"
    source = "Newton's second law"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        del context
        return {**rates, "vx": rates["vx"] + parameters["ax"], "vy": rates["vy"] + parameters["ay"]}


@final
class Payload(RateEffect):
    """Mass on board: (1 + mass_ratio) d(v)/dt = acceleration of the empty robot, v the velocity (vx, vy)."""

    name = "payload"
    robot = "point"
    stage = Stage.OWN_MASS
    equation = "(1 + mass_ratio) d(v)/dt = acceleration of the empty robot"
    parameters = (Parameter("mass_ratio", "1", 0.0, 5.0, 0.3, meaning="mass of the load over mass of the robot"),)
    signature = "all accelerations too small by one factor, thrust and resistance alike"
    source = "Newton's second law"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        del context
        share = 1.0 / (1.0 + parameters["mass_ratio"])
        return {**rates, "vx": rates["vx"] * share, "vy": rates["vy"] * share}


_REST = 1e-12
"""m2/s2 added under the root, so that its derivative is defined at rest."""


@final
class QuadraticDrag(RateEffect):
    """Drag with the square of the speed, air or water: d(v)/dt -= coefficient |v| v, v the velocity (vx, vy)."""

    name = "quadratic_drag"
    robot = "point"
    stage = Stage.RESISTANCE
    equation = "d(v)/dt -= coefficient |v| v, v = (vx, vy)"
    parameters = (Parameter("coefficient", "1/m", 0.0, 20.0, 0.4),)
    signature = "deceleration that grows with the square of the speed, in every direction"
    source = "Hoerner, Fluid-Dynamic Drag, 1965, ch. 1"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        state = context.state
        speed = context.operations.sqrt(state["vx"] * state["vx"] + state["vy"] * state["vy"] + _REST)
        own = parameters["coefficient"] * speed
        return {**rates, "vx": rates["vx"] - own * state["vx"], "vy": rates["vy"] - own * state["vy"]}


@final
class ViscousDrag(RateEffect):
    """Drag in proportion to the speed, the slides' damping: d(v)/dt -= coefficient v, v the velocity (vx, vy)."""

    name = "viscous_drag"
    robot = "point"
    stage = Stage.RESISTANCE
    equation = "d(v)/dt -= coefficient v, v = (vx, vy)"
    parameters = (Parameter("coefficient", "1/s", 0.0, 20.0, 0.5),)
    signature = "deceleration in proportion to the speed, in every direction"
    source = "Stokes' law; damping of a joint in MuJoCo, XML reference, joint/damping"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        state, own = context.state, parameters["coefficient"]
        return {**rates, "vx": rates["vx"] - own * state["vx"], "vy": rates["vy"] - own * state["vy"]}
