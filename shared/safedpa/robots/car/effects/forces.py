"""Forces that a car model may lack: drive, resistance, loads and outside forces."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, resistance
from safedpa.effects.parameter import Parameter


@final
class BackEmf(RateEffect):
    """A motor that pulls less the faster it turns: d(speed)/dt is lowered by coefficient |throttle| speed.

    The motor's own voltage opposes the battery's for the share of time in which the chopper connects them. Unlike drag,
    the effect vanishes when the throttle is released.
    """

    name = "back_emf"
    robot = "car"
    stage = Stage.DRIVE
    equation = "d(speed)/dt -= coefficient |throttle| speed"
    parameters = (Parameter("coefficient", "1/s", 0.0, 20.0, 1.0),)
    signature = "acceleration residual in proportion to speed times throttle; none while coasting"
    source = "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024 (motor force); Mohan, Electric Drives, ch. 7"
    needs = ("throttle",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        engaged = context.operations.absolute(context.action["throttle"])
        loss = parameters["coefficient"] * engaged * context.state["speed"]
        return {**rates, "speed": rates["speed"] - loss}


@final
class BatterySag(RateEffect):
    """The drive weakens as the battery empties: full drive times exp(-rate time), time since the start of the run.

    It applies to a throttle and to a speed servo: both deliver less than commanded.
    """

    name = "battery_sag"
    robot = "car"
    stage = Stage.SUPPLY
    equation = "drive acceleration *= exp(-rate time)"
    parameters = (Parameter("rate", "1/s", 0.0, 0.1, 0.002),)
    signature = "acceleration residual against the drive that grows with the time since the start"
    timed = True
    source = "Plett, Battery Management Systems, vol. 1, 2015, ch. 2 (voltage under load falls with charge)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        strength = context.operations.exp(-parameters["rate"] * context.time)
        return {**rates, "speed": rates["speed"] * strength}


@final
class ConstantForce(RateEffect):
    """Steady wind, or a slope: d(speed)/dt grows by ax cos(yaw) + ay sin(yaw); the tyres carry the part across."""

    name = "constant_force"
    robot = "car"
    stage = Stage.RESISTANCE
    equation = "d(speed)/dt += ax cos(yaw) + ay sin(yaw)"
    parameters = (
        Parameter("ax", "m/s2", -5.0, 5.0, 0.5, meaning="along the world's x"),
        Parameter("ay", "m/s2", -5.0, 5.0, 0.5, meaning="along the world's y"),
    )
    signature = (
        "acceleration residual that turns with the heading: opposite signs in opposite directions, whatever the speed"
    )
    source = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4 (grade and wind)"
    mirrored = ("ay",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        operations, yaw = context.operations, context.state["yaw"]
        push = parameters["ax"] * operations.cos(yaw) + parameters["ay"] * operations.sin(yaw)
        return {**rates, "speed": rates["speed"] + push}


@final
class Payload(RateEffect):
    """Mass on board: (1 + mass_ratio) d(speed)/dt = drive and resistance of the empty car.

    Rolling resistance and cornering resistance keep their deceleration: those forces grow with the weight.
    """

    name = "payload"
    robot = "car"
    stage = Stage.OWN_MASS
    equation = "(1 + mass_ratio) d(speed)/dt = acceleration of the empty car"
    parameters = (Parameter("mass_ratio", "1", 0.0, 5.0, 0.3, meaning="mass of the load over mass of the empty car"),)
    signature = "all accelerations too small by one factor, speeding up and slowing down alike"
    source = "Newton's second law; Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 2"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return {**rates, "speed": rates["speed"] / (1.0 + parameters["mass_ratio"])}


@final
class QuadraticDrag(RateEffect):
    """Air drag: d(speed)/dt is lowered by coefficient |speed| speed; coefficient = rho C_d A / (2 m) [1/m]."""

    name = "quadratic_drag"
    robot = "car"
    stage = Stage.RESISTANCE
    equation = "d(speed)/dt -= coefficient |speed| speed"
    parameters = (Parameter("coefficient", "1/m", 0.0, 2.0, 0.12),)
    signature = "deceleration residual grows with the square of speed; nothing at standstill; no side preference"
    source = "Gillespie, Fundamentals of Vehicle Dynamics, ch. 4"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        speed = context.state["speed"]
        drag = parameters["coefficient"] * context.operations.absolute(speed) * speed
        return {**rates, "speed": rates["speed"] - drag}


@final
class RollingResistance(RateEffect):
    """Resistance of constant size: d(speed)/dt is lowered by deceleration sign(speed), the sign rounded off near rest.

    deceleration = coefficient of rolling resistance times g. Mass on board does not change it: the force grows with
    the weight.
    """

    name = "rolling_resistance"
    robot = "car"
    stage = Stage.WEIGHT
    equation = "d(speed)/dt -= deceleration sign(speed)"
    parameters = (Parameter("deceleration", "m/s2", 0.0, 5.0, 0.4),)
    signature = "deceleration residual of one size at every speed, against the motion; changes sign with it"
    source = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4 (rolling resistance)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        pull = resistance(rates["speed"], context.state["speed"], parameters["deceleration"], REST_SPEED, context)
        return {**rates, "speed": rates["speed"] - pull}


@final
class TowedLoad(RateEffect):
    """A load on a hitch, of mass_ratio times the car's mass, which alone would slide to rest at ``deceleration``.

    (1 + mass_ratio) d(speed)/dt = drive and resistance of the car - mass_ratio deceleration sign(speed),
    the sign rounded off near rest. The hitch is assumed stiff and in line with the car.
    """

    name = "towed_load"
    robot = "car"
    stage = Stage.MASS
    equation = "(1 + mass_ratio) d(speed)/dt = acceleration - mass_ratio deceleration sign(speed)"
    parameters = (
        Parameter("mass_ratio", "1", 0.0, 5.0, 0.5, meaning="mass of the load over mass of the car"),
        Parameter(
            "deceleration", "m/s2", 0.0, 9.81, 2.0, neutral=None, meaning="friction coefficient of the load times g"
        ),
    )
    signature = "all accelerations too small by one factor, and a steady pull against the motion"
    source = "Newton's second law for two bodies on a rigid hitch, Coulomb friction under the towed one"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        ratio = parameters["mass_ratio"]
        most = ratio * parameters["deceleration"]
        pull = resistance(rates["speed"], context.state["speed"], most, REST_SPEED, context, 1.0 + ratio)
        return {**rates, "speed": (rates["speed"] - pull) / (1.0 + ratio)}


@final
class TurningDrag(RateEffect):
    """Resistance that steering adds: d(speed)/dt is lowered by coefficient |speed| speed steer^2.

    The tyres' side force grows with speed^2 steer and has a part steer against the motion. Mass on board does not
    change it: the side force grows with the mass.
    """

    name = "turning_drag"
    robot = "car"
    stage = Stage.WEIGHT
    equation = "d(speed)/dt -= coefficient |speed| speed steer^2"
    parameters = (Parameter("coefficient", "1/m", 0.0, 10.0, 2.0, meaning="about half of 1 / wheelbase, by theory"),)
    signature = (
        "deceleration residual in curves only, growing with the square of speed and of steer, the same to both sides"
    )
    source = (
        "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024; Gillespie, Fundamentals of Vehicle "
        "Dynamics, ch. 6"
    )

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        speed, steer = context.state["speed"], context.action["steer"]
        drag = parameters["coefficient"] * context.operations.absolute(speed) * speed * steer * steer
        return {**rates, "speed": rates["speed"] - drag}


@final
class ViscousDrag(RateEffect):
    """Resistance in proportion to the speed: d(speed)/dt is lowered by coefficient speed.

    Causes: bearings, drive train, and the part of rolling resistance that grows with the speed.
    """

    name = "viscous_drag"
    robot = "car"
    stage = Stage.RESISTANCE
    equation = "d(speed)/dt -= coefficient speed"
    parameters = (Parameter("coefficient", "1/s", 0.0, 10.0, 0.3),)
    signature = "deceleration residual in proportion to the speed, forwards and backwards alike, whatever the drive"
    source = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4 (rolling resistance that grows with speed)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return {**rates, "speed": rates["speed"] - parameters["coefficient"] * context.state["speed"]}
