"""One hidden-effect case: what is hidden, how strongly, in which logs; and the truth about it.

The ordinary strength is what an engineer would call so; suites hide any fraction of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

STEP: Final = 0.002
"""s; step of the simulators."""

LARGEST_STEER: Final = 0.34
"""rad; largest steer that is commanded."""

_JITTER = 0.1
"""Relative half width within which a strength varies from case to case, so that no case repeats another."""

Drive = Literal["speed_servo", "throttle"]
Robot = Literal["car", "pendulum", "differential_drive"]


@dataclass(frozen=True)
class Strength:
    """Parameters of one effect at ordinary strength.

    ``neutral`` holds the values at which a parameter does nothing (0 unless named); parameters in ``shape`` only shape
    the effect and keep their value at every strength; the sign of those in ``signed`` is drawn.
    """

    parameters: Mapping[str, float]
    neutral: Mapping[str, float] = field(default_factory=dict)
    shape: tuple[str, ...] = ()
    signed: tuple[str, ...] = ()
    drive: Drive = "speed_servo"

    def drawn(self, random: np.random.Generator, share: float = 1.0) -> dict[str, float]:
        """value = neutral + share (ordinary - neutral) (1 + up to 10 %), for ``share`` of the ordinary strength."""
        values = {}
        for name, ordinary in self.parameters.items():
            scale = 1.0 + float(random.uniform(-_JITTER, _JITTER))
            sign = float(random.choice([-1.0, 1.0])) if name in self.signed else 1.0
            neutral = self.neutral.get(name, 0.0)
            values[name] = ordinary if name in self.shape else neutral + share * scale * sign * (ordinary - neutral)
            if name == "seconds":  # delays are whole steps of the simulator, so that the truth is what happened
                values[name] = STEP * round(values[name] / STEP)
        return values


CAR_EFFECTS: Final[dict[str, Strength]] = {
    "quadratic_drag": Strength({"coefficient": 0.12}),
    "viscous_drag": Strength({"coefficient": 0.3}),
    "rolling_resistance": Strength({"deceleration": 0.45}),
    "constant_force": Strength({"ax": 0.4, "ay": 0.3}, signed=("ax", "ay")),
    "payload": Strength({"mass_ratio": 0.3}),
    "towed_load": Strength({"mass_ratio": 0.4, "deceleration": 2.0}, shape=("deceleration",)),
    "understeer": Strength({"gradient": 0.02}),
    "steering_offset": Strength({"angle": 0.04}, signed=("angle",)),
    "steering_gain": Strength({"gain": 0.85}, {"gain": 1.0}, signed=("gain",)),
    "steering_asymmetry": Strength({"difference": 0.15}, signed=("difference",)),
    "steering_saturation": Strength({"limit": 0.22}, {"limit": LARGEST_STEER}),
    "steering_lag": Strength({"time_constant": 0.15}),
    "steering_delay": Strength({"seconds": 0.12}),
    "drive_lag": Strength({"time_constant": 0.15}),
    "drive_delay": Strength({"seconds": 0.12}),
    "actuator_delay": Strength({"seconds": 0.12}),
    "turning_drag": Strength({"coefficient": 2.0}),
    "speed_command_gain": Strength({"gain": 0.85}, {"gain": 1.0}),
    "drive_dead_zone": Strength({"width": 0.15}, drive="throttle"),
    "back_emf": Strength({"coefficient": 1.0}, drive="throttle"),
    "battery_sag": Strength({"rate": 0.01}),
    "crosswind_drift": Strength({"vx": 0.12, "vy": 0.09}, signed=("vx", "vy")),
    "tyre_slip": Strength({"compliance": 0.02}),
    "speed_sensor_scale": Strength({"scale": 1.05}, {"scale": 1.0}, signed=("scale",)),
}
"""The car's effects; strengths assumed, as a 1:10 car at up to 2.4 m/s shows them."""

PENDULUM_EFFECTS: Final[dict[str, Strength]] = {
    "viscous_friction": Strength({"coefficient": 0.1}),
    "coulomb_friction": Strength({"torque": 0.15}),
    "stribeck_friction": Strength({"torque": 0.25, "fading_rate": 1.0}, shape=("fading_rate",)),
    "tip_mass": Strength({"mass": 0.15}),
    "torque_offset": Strength({"offset": 0.2}, signed=("offset",)),
    "torque_gain": Strength({"gain": 0.85}, {"gain": 1.0}, signed=("gain",)),
    "torque_lag": Strength({"time_constant": 0.06}),
    "torque_delay": Strength({"seconds": 0.06}),
    "wind": Strength({"speed": 3.0, "drag": 0.1}, shape=("speed",)),
    "angle_offset": Strength({"offset": 0.06}, signed=("offset",)),
    "backlash": Strength({"width": 0.5}),
    "spring": Strength({"stiffness": 0.6, "rest_angle": 2.6}, shape=("rest_angle",)),
}
"""The pendulum's effects, for 1 kg at 0.5 m."""

WHEELS_EFFECTS: Final[dict[str, Strength]] = {
    "actuator_delay": Strength({"seconds": 0.12}),
    "drive_lag": Strength({"time_constant": 0.15}),
    "payload": Strength({"mass_ratio": 0.4}),
    "rolling_resistance": Strength({"deceleration": 0.3}),
    "track_error": Strength({"ratio": 1.1}, {"ratio": 1.0}, signed=("ratio",)),
    "unequal_wheels": Strength({"pull": 0.3}, signed=("pull",)),
    "wheel_radius": Strength({"ratio": 0.93}, {"ratio": 1.0}, signed=("ratio",)),
    "wheel_slip": Strength({"compliance": 0.1}),
}
"""The differential drive's effects, for one of 0.5 m/s."""


Effects = Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Case:
    """What stands behind one set of logs; everything follows from these numbers."""

    suite: str
    seed: int
    effects: Effects
    """Hidden effects with their parameters; empty: nothing is hidden."""
    robot: Robot = "car"
    drive: Drive = "speed_servo"
    hard: bool = False
    """Coloured disturbance, three times the noise, lost rows, tracking glitches, gain 10 % off and free."""
    laws: Mapping[str, str] = field(default_factory=dict)
    """By hidden effect, where it acts or how its number varies, as a model file says it: ``where x above``; the law's
    numbers stand with the effect's."""
    load: str | None = None
    """Driven by the pymunk car with this load hitched, instead of the integrator."""
    runs: int = 6
    seconds: float = 40.0
    fault: str | None = None
    """One of ``BAD``: the first run is spoiled so."""

    @property
    def name(self) -> str:
        """Suite, hidden effects and seed, fit for a folder."""
        what = self.effects or (self.fault or "nothing",)
        return "-".join([self.suite, *what, str(self.seed)])


_DELAYS = {"actuator_delay": ("steering_delay", "drive_delay")}

_PENDULUM_EQUALS = {"torque_gain": ("tip_mass",), "tip_mass": ("torque_gain",)}
"""(M l^2 rate' = torque + M g l sin(angle)) is rate' = (m / M) torque / (m l^2) + g / l sin(angle)."""

_FREE_GAIN_EQUALS = {
    # k (u - v) - c v = (k + c) (k / (k + c) u - v)
    "viscous_drag": ("speed_command_gain",),
    "speed_command_gain": ("viscous_drag",),
    # (k (u - v) - m d) / (1 + m) = k / (1 + m) (u - v) - m d / (1 + m)
    "towed_load": ("rolling_resistance",),
    "rolling_resistance": ("towed_load",),
}
"""What a free gain k of the speed servo makes equal, while the servo's limit is not reached."""

ABSORBED = ("payload",)
"""What a free gain of the servo takes up whole: k / (1 + mass_ratio)."""


PYMUNK_CAR = ("drive_lag", "steering_lag", "tyre_slip", "understeer")
"""What the pymunk car has by itself and its given model has not: naming it is not wrong."""

TURNS_LESS = {"chair": 0.97, "large_chair": 0.94}
"""By load, the steering gain that it is as well: in steady curves its drawbar holds the car's nose back by the same
share at every speed, which `safedpa_lab.hidden.towing.turning_share` measures."""


def equals_of(case: Case, effect: str) -> tuple[str, ...]:
    """Effects that no data of this case could tell from ``effect``, worked out from the equations."""
    if case.robot == "differential_drive":
        return ()
    if case.robot == "pendulum":
        return _PENDULUM_EQUALS.get(effect, ())
    if case.hard and case.drive == "speed_servo":
        return _FREE_GAIN_EQUALS.get(effect, ())
    return _DELAYS.get(effect, ()) if len(case.effects) > 1 else ()


def truth_of(case: Case) -> dict[str, Any]:
    """The sealed document: hidden effects and parameters, what equals them, and the case's options."""
    absorbed = [name for name in case.effects if name in ABSORBED and case.hard and case.drive == "speed_servo"]
    return {
        "suite": case.suite,
        "seed": case.seed,
        "robot": case.robot,
        "hard": case.hard,
        "laws": dict(case.laws),
        "load": case.load,
        "effects": {name: dict(parameters) for name, parameters in case.effects.items()},
        "equals": {name: list(equals_of(case, name)) for name in case.effects},
        "absorbed": absorbed,
        "present": list(PYMUNK_CAR) if case.load is not None else [],
        "present_near": {"steering_gain.gain": TURNS_LESS[case.load]} if case.load is not None else {},
    }
