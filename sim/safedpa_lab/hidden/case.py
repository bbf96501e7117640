"""One hidden-effect case: what is hidden, in which logs; and the truth about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["ABSORBED", "Case", "equals_of", "truth_of"]

Effects = Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Case:
    """What stands behind one set of logs; everything follows from these numbers."""

    suite: str
    seed: int
    effects: Effects
    """Hidden effects with their parameters; empty: nothing is hidden."""
    robot: Literal["car", "pendulum", "differential_drive"] = "car"
    drive: Literal["speed_servo", "throttle"] = "speed_servo"
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
