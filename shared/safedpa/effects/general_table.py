"""What reports and searches read of the general effects, by kind: one table for all robots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class Kind:
    """What reports and searches read of one kind of effect."""

    signature: str
    source: str
    partners: tuple[str, ...] = ()
    """Kinds of the same command or state; with a leading ``@`` of every command."""
    rare: bool = False


TABLE: Mapping[str, Kind] = {
    "gain": Kind(
        "the answer to the action differs by the same share at every size",
        "static gain of an actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
        ("lag", "limit", "slew_limit"),
    ),
    "offset": Kind(
        "a residual of one size and sign, whatever the action",
        "trim of an actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
        ("gain",),
    ),
    "dead_zone": Kind(
        "a residual against the action that grows with it up to a width, then of one size",
        "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996, ch. 2",
        ("gain",),
    ),
    "curve": Kind(
        "the answer grows faster or slower than the action: a residual with its square",
        "Bangura et al., Aerodynamics of rotor blades for quadrotors, arXiv:1601.00733, 2016 (thrust over command)",
        ("gain",),
        rare=True,
    ),
    "limit": Kind(
        "a residual beyond one size of the action only, growing with the excess",
        "saturation; Tao and Kokotovic, Adaptive Control of Systems, 1996, ch. 1",
    ),
    "limit_up_down": Kind(
        "a residual beyond one size of the action, another one on each side",
        "saturation; Tao and Kokotovic, Adaptive Control of Systems, 1996, ch. 1",
        rare=True,
    ),
    "backlash": Kind(
        "a residual that depends on the direction of the last change of the action: a loop of hysteresis",
        "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996, ch. 2",
        ("lag",),
        rare=True,
    ),
    "slew_limit": Kind(
        "a residual after large changes of the action, which dies out linearly, later for larger changes",
        "rate limit; Astrom and Murray, Feedback Systems, 2nd ed., ch. 10",
        ("delay",),
    ),
    "slew_limit_up_down": Kind(
        "a residual after large changes of the action, longer to one side than to the other",
        "rate limit; Astrom and Murray, Feedback Systems, 2nd ed., ch. 10",
        rare=True,
    ),
    "second_order": Kind(
        "a residual after each change of the action that overshoots and rings",
        "Ogata, Modern Control Engineering, 5th ed., section 5-3",
        ("gain",),
        rare=True,
    ),
    "lag": Kind(
        "a residual after each change of the action, of opposite sign to the change, dying out",
        "first-order actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    ),
    "reservoir": Kind(
        "a residual after each change of the action that dies out, the more slowly the larger the action is",
        "Torricelli, 1643; Schoukens and Noel, IFAC-PapersOnLine 50, 2017 (a hidden upper tank)",
        ("gain",),
        rare=True,
    ),
    "lag_up_down": Kind(
        "a residual after each change of the action that dies out sooner to one side than to the other",
        "spin-up and spin-down of a rotor; Faessler et al., IEEE Robotics and Automation Letters 3, 2018",
        rare=True,
    ),
    "delay": Kind(
        "a residual after each change of the action, as if it had not been sent yet, then none",
        "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
        ("lag", "gain"),
    ),
    "supply": Kind(
        "the answer to the action is larger while the measured voltage is high",
        "Hughes and Drury, Electric Motors and Drives, 5th ed., ch. 3",
    ),
    "torque_speed": Kind(
        "the answer to the action falls with the speed in its direction",
        "Hughes and Drury, Electric Motors and Drives, 5th ed., ch. 3",
        ("gain",),
        rare=True,
    ),
    "drag": Kind(
        "a residual against the motion, in proportion to it",
        "linear damping; Khalil, Nonlinear Systems, 3rd ed., section 1.2",
        ("friction",),
    ),
    "quadratic_drag": Kind(
        "a residual against the motion that grows with its square",
        "Hoerner, Fluid-Dynamic Drag, 1965, ch. 1",
        ("friction",),
    ),
    "friction": Kind(
        "a residual of one size against the motion, which changes sign with it",
        "Armstrong-Helouvry et al., A survey of models with friction, Automatica 30, 1994, section 2",
        ("gravity",),
    ),
    "stribeck": Kind(
        "a residual against the motion at low speeds only",
        "Armstrong-Helouvry et al., A survey of models with friction, Automatica 30, 1994, section 2 (Stribeck)",
        ("friction",),
        rare=True,
    ),
    "load_friction": Kind(
        "a residual against the motion in proportion to the force that is transmitted",
        "Linderoth et al., Modeling and control of gear friction with load, IEEE/RSJ IROS, 2013",
        ("friction",),
        rare=True,
    ),
    "push": Kind(
        "a residual of one size and sign, whatever the state and the action",
        "a constant disturbance; Astrom and Murray, Feedback Systems, 2nd ed., ch. 7",
        ("spring",),
    ),
    "spring": Kind(
        "a residual in proportion to the position, towards one place",
        "Meriam and Kraige, Engineering Mechanics: Dynamics, 6th ed., ch. 8",
        ("drag",),
    ),
    "gravity": Kind(
        "a residual with the sine and cosine of the position, whatever the rate",
        "Siciliano et al., Robotics: Modelling, Planning and Control, 2009, ch. 7",
        ("drag",),
    ),
    "end_stop": Kind(
        "the position stays at one value while the model goes on",
        "Meriam and Kraige, Engineering Mechanics: Dynamics, 6th ed., ch. 3 (plastic impact)",
        rare=True,
    ),
    "inertia": Kind(
        "all accelerations too small by one factor",
        "added mass; Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2nd ed., ch. 6",
        ("drag",),
        rare=True,
    ),
    "speed_limit": Kind(
        "the state stays at one value, of either sign, while the model goes beyond it",
        "speed at which the supply saturates; Hughes and Drury, Electric Motors and Drives, 5th ed., ch. 3",
        ("@delay", "@gain"),
    ),
    "speed_limit_up_down": Kind(
        "the state stays at one value while the model goes beyond it, another one for each sign",
        "speed at which the supply saturates; Hughes and Drury, Electric Motors and Drives, 5th ed., ch. 3",
        rare=True,
    ),
    "acceleration_limit": Kind(
        "a residual of large accelerations only, growing with the excess",
        "current limit of a drive; Hughes and Drury, Electric Motors and Drives, 5th ed., ch. 4",
        ("@delay", "@gain"),
    ),
    "acceleration_limit_up_down": Kind(
        "a residual of large accelerations only, from another size on for each sign",
        "current limit of a drive; Hughes and Drury, Electric Motors and Drives, 5th ed., ch. 4",
        rare=True,
    ),
    "coupling": Kind(
        "a residual of one axis in proportion to another one",
        "Astrom and Murray, Feedback Systems, 2nd ed., ch. 3 (cross coupling)",
        rare=True,
    ),
    "vector_drag": Kind(
        "a residual against the direction of travel, in proportion to the speed, the same for all axes",
        "rotor drag; Faessler et al., IEEE Robotics and Automation Letters 3, 2018",
        rare=True,
    ),
    "vector_quadratic_drag": Kind(
        "a residual against the direction of travel that grows with the square of the speed",
        "Hoerner, Fluid-Dynamic Drag, 1965, ch. 1",
        rare=True,
    ),
    "body_drag": Kind(
        "a residual against the motion that is larger across the body than along it",
        "Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2nd ed., ch. 6",
        rare=True,
    ),
    "bias": Kind(
        "a measured rate and the slope of its position differ by a constant",
        "Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 2.11",
        rare=True,
    ),
    "scale": Kind(
        "a measured rate and the slope of its position differ by one share",
        "Borenstein and Feng, IEEE Transactions on Robotics and Automation 12, 1996 (odometry)",
        rare=True,
    ),
    "sensor_delay": Kind(
        "a measured position is behind the integral of its measured rate, more at higher rates",
        "Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
        rare=True,
    ),
}
