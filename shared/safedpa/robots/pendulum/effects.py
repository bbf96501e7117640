"""Effects of the pendulum: classes, and a table of those that act on the command in a general way."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.channel_effects import ChannelEffect
from safedpa.effects.effect import CommandEffect, Context, Named, RateEffect, SensorEffect, Stage
from safedpa.effects.friction import REST_RATE, resistance
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

EFFECTS = (
    ChannelEffect(
        "pendulum", "torque_delay", "torque", "delay", Parameter("seconds", "s", 0.0, 0.2, 0.02),
        signature="rate residual after each change of torque, as if the command had not been sent yet, then none",
        source="dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
    ),
    ChannelEffect(
        "pendulum", "torque_gain", "torque", "gain", Parameter("gain", "1", 0.1, 3.0, 0.85, neutral=1.0),
        signature="rate residual in proportion to the torque",
        source="torque constant of the motor; Wiebe et al., Torque-limited simple pendulum, JOSS 7(74), 2022",
    ),
    ChannelEffect(
        "pendulum", "torque_lag", "torque", "lag", Parameter("time_constant", "s", 0.0, 1.0, 0.02),
        signature="rate residual after each change of torque, of opposite sign to the change, dying out",
        source="Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    ),
    ChannelEffect(
        "pendulum", "torque_offset", "torque", "offset", Parameter("offset", "N m", -5.0, 5.0, 0.1),
        mirrored=("offset",),
        signature="rate residual of one size and sign, whatever angle, rate and torque",
        source="Wiebe et al., Torque-limited simple pendulum, JOSS 7(74), 2022",
    ),
)  # fmt: skip


@final
class AngleOffset(SensorEffect):
    """An angle sensor that is not centred: measured angle = true angle + angle."""

    name = "angle_offset"
    robot = "pendulum"
    stage = Stage.SENSOR
    equation = "measured angle = angle + offset"
    parameters = (Parameter("offset", "rad", -1.0, 1.0, 0.03),)
    signature = "rate residual in proportion to the cosine of the angle, also at rest: the balance is not at 0"
    source = (
        "Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 2.11 (joint offsets in calibration)"
    )
    mirrored = ("offset",)

    def measure(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        return {**state, "angle": state["angle"] + parameters["offset"]}

    def restore(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        return {**state, "angle": state["angle"] - parameters["offset"]}


@final
class Backlash(CommandEffect):
    """Play in the gear: felt torque = clip(felt torque before, torque - width / 2, torque + width / 2).

    A change of direction is felt once it has crossed the width. The memory is the felt torque [N m].
    """

    name = "backlash"
    robot = "pendulum"
    stage = Stage.COMMAND_LINKAGE
    equation = "torque_felt = clip(torque_felt, torque - width/2, torque + width/2)"
    parameters = (Parameter("width", "N m", 0.0, 10.0, 0.1),)
    signature = "rate residual that depends on the direction of the last change of torque: a loop of hysteresis"
    source = "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996, ch. 2"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return action["torque"]

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        half = 0.5 * parameters["width"]
        felt = operations.clip(memory, action["torque"] - half, action["torque"] + half)
        return {**action, "torque": felt}, felt


@final
class CoulombFriction(RateEffect):
    """Friction of constant size: mass length^2 d(rate)/dt -= torque sign(rate), the sign rounded off near rest."""

    name = "coulomb_friction"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = "mass length^2 d(rate)/dt -= torque sign(rate)"
    parameters = (Parameter("torque", "N m", 0.0, 10.0, 0.1),)
    signature = "rate residual of one size at every rate, against the motion; changes sign with it"
    source = (
        "Armstrong-Helouvry et al., A survey of models with friction, Automatica 30, 1994, section 2; Wiebe "
        "et al., Torque-limited simple pendulum, JOSS 7(74), 2022"
    )

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        inertia = context.base["mass"] * context.base["length"] * context.base["length"]
        deceleration = parameters["torque"] / inertia
        held = resistance(rates["rate"], context.state["rate"], deceleration, REST_RATE, context)
        return {**rates, "rate": rates["rate"] - held}


@final
class Spring(RateEffect):
    """A torsion spring, or a cable: mass length^2 d(rate)/dt is lowered by stiffness (angle - rest_angle).

    The angle counts from upright and is not wrapped.
    """

    name = "spring"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = "mass length^2 d(rate)/dt -= stiffness (angle - rest_angle)"
    parameters = (
        Parameter("stiffness", "N m/rad", 0.0, 100.0, 0.5),
        Parameter("rest_angle", "rad", -6.3, 6.3, 0.0, neutral=None, meaning="where it does not pull"),
    )
    signature = "rate residual in proportion to the angle from one position, whatever the rate"
    source = "Meriam and Kraige, Engineering Mechanics: Dynamics, 6th ed., ch. 8"
    mirrored = ("rest_angle",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        inertia = context.base["mass"] * context.base["length"] * context.base["length"]
        torque = parameters["stiffness"] * (context.state["angle"] - parameters["rest_angle"])
        return {**rates, "rate": rates["rate"] - torque / inertia}


@final
class StribeckFriction(RateEffect):
    """Extra friction near rest: mass length^2 d(rate)/dt -= torque exp(-(rate / fading_rate)^2) sign(rate).

    The sign is rounded off near rest. Together with coulomb_friction, it is the difference between breakaway and
    sliding friction.
    """

    name = "stribeck_friction"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = "mass length^2 d(rate)/dt -= torque exp(-(rate/fading_rate)^2) sign(rate)"
    parameters = (
        Parameter("torque", "N m", 0.0, 10.0, 0.05),
        Parameter("fading_rate", "rad/s", 0.05, 20.0, 0.5, neutral=None, meaning="at which 37 % of it is left"),
    )
    signature = "rate residual against the motion at low rates only"
    source = "Armstrong-Helouvry et al., A survey of models with friction, Automatica 30, 1994, section 2 (Stribeck)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        inertia = context.base["mass"] * context.base["length"] * context.base["length"]
        rate, deceleration = context.state["rate"], parameters["torque"] / inertia
        fading = context.operations.exp(-((rate / parameters["fading_rate"]) * (rate / parameters["fading_rate"])))
        held = resistance(rates["rate"], rate, deceleration, REST_RATE, context)  # at rest nothing has faded
        return {**rates, "rate": rates["rate"] - fading * held}


@final
class TipMass(RateEffect):
    """Mass at the tip: (base + mass) length^2 d(rate)/dt = torque + (base + mass) gravity length sin(angle)."""

    name = "tip_mass"
    robot = "pendulum"
    stage = Stage.MASS
    equation = "(base mass + mass) length^2 d(rate)/dt = torque + (base mass + mass) gravity length sin(angle)"
    parameters = (Parameter("mass", "kg", 0.0, 100.0, 0.1),)
    signature = "rate residual against the torque, in proportion to it; gravity alone fits"
    source = "Newton's second law for a point mass; Goldstein, Classical Mechanics, 3rd ed., ch. 1"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        base = context.base
        share = parameters["mass"] / (base["mass"] + parameters["mass"])
        free_fall = base["gravity"] / base["length"] * context.operations.sin(context.state["angle"])
        return {**rates, "rate": rates["rate"] + share * (free_fall - rates["rate"])}


@final
class ViscousFriction(RateEffect):
    """Friction that grows with the rate: mass length^2 d(rate)/dt -= coefficient rate; coefficient in N m s/rad."""

    name = "viscous_friction"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = "mass length^2 d(rate)/dt -= coefficient rate"
    parameters = (Parameter("coefficient", "N m s/rad", 0.0, 5.0, 0.1),)
    signature = "rate residual proportional to the rate and against it, whatever the angle"
    source = "Wiebe et al., Torque-limited simple pendulum, JOSS 7(74), 2022"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        inertia = context.base["mass"] * context.base["length"] * context.base["length"]
        torque = parameters["coefficient"] * context.state["rate"]
        return {**rates, "rate": rates["rate"] - torque / inertia}


_CALM = 1e-12
"""m2/s2; keeps the derivative of the square root finite when the tip moves exactly with the wind."""


@final
class Wind(RateEffect):
    """Wind: torque = length (cos(angle) F_x + sin(angle) F_y), F = drag |R| R, R = wind - velocity of the tip.

    x points towards positive angles, y down, so the tip moves with length rate (cos(angle), sin(angle)), and the wind
    is (speed, -upward). The viscous friction of the original model is the effect viscous_friction here.
    """

    name = "wind"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = (
        "mass length^2 d(rate)/dt += length (cos(angle) F_x + sin(angle) F_y), F = drag |R| R, R = wind - tip velocity"
    )
    parameters = (
        Parameter("speed", "m/s", -15.0, 15.0, 3.0, neutral=None, meaning="towards positive angles"),
        Parameter("drag", "N s2/m2", 0.0, 2.0, 0.5),
        Parameter("upward", "m/s", -15.0, 15.0, 0.0, neutral=None, meaning="against gravity"),
    )
    signature = "rate residual of one direction in space, largest at top and bottom, none when level"
    source = "Shi et al., Meta-Adaptive Nonlinear Control, NeurIPS 2021, inverted pendulum in wind"
    mirrored = ("speed",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        operations, base = context.operations, context.base
        cosine, sine = operations.cos(context.state["angle"]), operations.sin(context.state["angle"])
        tip = base["length"] * context.state["rate"]
        across, down = parameters["speed"] - tip * cosine, -parameters["upward"] - tip * sine
        size = operations.sqrt(across * across + down * down + _CALM)
        torque = base["length"] * parameters["drag"] * size * (cosine * across + sine * down)
        return {**rates, "rate": rates["rate"] + torque / (base["mass"] * base["length"] * base["length"])}
