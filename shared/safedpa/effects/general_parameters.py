"""Parameters of the general effects: units, bounds and typical values, by usual sizes and the period of the logs."""

from __future__ import annotations

from math import isfinite
from typing import Final

from safedpa.effects.parameter import Parameter
from safedpa.systems import Variable

_FASTEST: Final = 1e4
"""Sizes per second, and rad/s: no actuator of a robot is faster."""


def channel_parameters(kind: str, unit: str, size: float, period: float) -> tuple[Parameter, ...]:
    """Returns the parameters of an effect on a command of this ``size`` [unit], for logs of this ``period`` [s].

    A lag shows from a tenth of a period on, and as long as a log has rows; a delay is limited to 100 periods, since
    its memory is that long.
    """
    time = max(0.15, 3.0 * period), max(2.0, 1e4 * period)
    per_second = _per(unit if "/" not in unit else f"({unit})", "s")
    rate = Parameter("rate", per_second, 1e-4 * size / period, _FASTEST * size, 0.1 * size / period, _FASTEST * size)
    if kind in ("slew_limit_up_down", "lag_up_down"):
        single = channel_parameters(kind.removesuffix("_up_down"), unit, size, period)[0]
        return _twice(single)
    found = {
        "gain": Parameter("gain", "1", 0.05, 5.0, 0.85, neutral=1.0),
        "offset": Parameter("offset", unit, -size, size, 0.05 * size),
        "dead_zone": Parameter("width", unit, 0.0, 0.9 * size, 0.1 * size),
        "curve": Parameter("square", f"1/({unit})" if unit != "1" else "1", -0.45 / size, 20.0 / size, 0.5 / size),
        "limit": Parameter("limit", unit, 0.02 * size, size, 0.6 * size, neutral=size),
        "backlash": Parameter("width", unit, 0.0, 2.0 * size, 0.1 * size),
        "lag": Parameter("time_constant", "s", 0.0, time[1], time[0]),
        "delay": Parameter("seconds", "s", 0.0, max(1.0, 100.0 * period), max(0.1, 2.0 * period)),
        "slew_limit": rate,
        "reservoir": Parameter("seconds", _per("s", unit), 0.0, time[1] / size, 3.0 * time[0] / size),
    }
    if kind == "limit_up_down":
        high = Parameter("high", unit, 0.0, size, 0.6 * size, neutral=size)
        return high, Parameter("low", unit, -size, 0.0, -0.6 * size, neutral=-size)
    if kind == "second_order":
        typical = min(10.0, 0.5 / period)
        frequency = Parameter("frequency", "rad/s", 1e-3 * typical, _FASTEST, typical, _FASTEST)
        return frequency, Parameter("damping", "1", 0.02, 0.99, 0.5, neutral=None)
    return (found[kind],)


def _per(unit: str, other: str) -> str:
    return unit if other == "1" else f"{unit}/({other})" if "/" in other else f"{unit}/{other}"


def _twice(parameter: Parameter) -> tuple[Parameter, Parameter]:
    """Returns the parameter for rising and for falling values."""
    values = vars(parameter)
    return Parameter(**{**values, "name": f"{parameter.name}_up"}), Parameter(
        **{**values, "name": f"{parameter.name}_down"}
    )


def state_parameters(state: Variable, size: float, position: Variable | None) -> dict[str, tuple[Parameter, ...]]:
    """Returns the parameters of the effects on d(``state``)/dt by kind, for a state of this usual ``size``."""
    per_length = "1/m" if state.unit == "m/s" else f"1/s/({state.unit})"
    rate = f"{state.unit}2" if state.unit in ("m/s", "rad/s") else f"({state.unit})/s"
    reach = max(abs(state.low), abs(state.high))
    top = reach if isfinite(reach) and reach > 2.0 * size else 20.0 * size
    speed = Parameter("limit", state.unit, 0.02 * size, top, 0.8 * size, neutral=top)
    acceleration = Parameter("limit", rate, 0.02 * size, _FASTEST * size, size, neutral=_FASTEST * size)
    found = {
        "drag": (Parameter("coefficient", "1/s", 0.0, 50.0, 0.3),),
        # over the usual size, so that it decelerates as the linear drag with coefficient 0.3 1/s does there
        "quadratic_drag": (Parameter("coefficient", per_length, 0.0, 50.0 / size, 0.3 / size),),
        "friction": (Parameter("deceleration", rate, 0.0, 20.0 * size, 0.3 * size),),
        "push": (Parameter("push", rate, -20.0 * size, 20.0 * size, 0.2 * size),),
        "speed_limit": (speed,),
        "acceleration_limit": (acceleration,),
        "speed_limit_up_down": _twice(speed),
        "acceleration_limit_up_down": _twice(acceleration),
        "stribeck": (
            Parameter("deceleration", rate, 0.0, 20.0 * size, 0.3 * size),
            Parameter("fading", state.unit, 0.01 * size, 5.0 * size, 0.2 * size, neutral=None),
        ),
        "load_friction": (Parameter("share", "1", 0.0, 0.95, 0.2),),
        "inertia": (Parameter("ratio", "1", -0.8, 20.0, 0.3),),
    }
    if position is not None:
        found["spring"] = (Parameter("stiffness", "1/s2", -1e3, 1e4, 1.0),)
        low, high = position.low, position.high
        if isfinite(low) and isfinite(high) and not position.angle:
            reach = min(size, 0.2 * (high - low))  # how far it moves in a second
            found["end_stop"] = (
                Parameter("low", position.unit, low, high, max(low, -reach), neutral=low),
                Parameter("high", position.unit, low, high, min(high, reach), neutral=high),
            )
        if position.unit == "rad":
            found["gravity"] = tuple(
                Parameter(name, rate, -200.0 * size, 200.0 * size, 1.0 * size) for name in ("sine", "cosine")
            )
    return found


def sensor_delay_parameters(period: float) -> tuple[Parameter, ...]:
    """Returns the delay of a sensor for logs of this ``period`` [s]; either of two sensors may be the late one."""
    return (Parameter("seconds", "s", -20.0 * period, 20.0 * period, 0.5 * period),)
