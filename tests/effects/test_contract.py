"""Names, parameters and units that others rely on."""

from __future__ import annotations

import pytest

from safedpa.effects import effects_of

CAR: dict[str, dict[str, str]] = {
    "quadratic_drag": {"coefficient": "1/m"},
    "viscous_drag": {"coefficient": "1/s"},
    "rolling_resistance": {"deceleration": "m/s2"},
    "constant_force": {"ax": "m/s2", "ay": "m/s2"},
    "payload": {"mass_ratio": "1"},
    "towed_load": {"mass_ratio": "1", "deceleration": "m/s2"},
    "understeer": {"gradient": "s2/m"},
    "steering_offset": {"angle": "rad"},
    "steering_gain": {"gain": "1"},
    "steering_asymmetry": {"difference": "1"},
    "steering_saturation": {"limit": "rad"},
    "steering_lag": {"time_constant": "s"},
    "steering_delay": {"seconds": "s"},
    "drive_lag": {"time_constant": "s"},
    "drive_delay": {"seconds": "s"},
    "actuator_delay": {"seconds": "s"},
    "turning_drag": {"coefficient": "1/m"},
    "speed_command_gain": {"gain": "1"},
    "drive_dead_zone": {"width": "1"},
    "back_emf": {"coefficient": "1/s"},
    "battery_sag": {"rate": "1/s"},
    "crosswind_drift": {"vx": "m/s", "vy": "m/s"},
    "tyre_slip": {"compliance": "s2/m"},
    "speed_sensor_scale": {"scale": "1"},
}
PENDULUM: dict[str, dict[str, str]] = {
    "viscous_friction": {"coefficient": "N m s/rad"},
    "coulomb_friction": {"torque": "N m"},
    "stribeck_friction": {"torque": "N m", "fading_rate": "rad/s"},
    "tip_mass": {"mass": "kg"},
    "torque_offset": {"offset": "N m"},
    "torque_gain": {"gain": "1"},
    "torque_lag": {"time_constant": "s"},
    "torque_delay": {"seconds": "s"},
    "wind": {"speed": "m/s", "drag": "N s2/m2", "upward": "m/s"},
    "angle_offset": {"offset": "rad"},
    "backlash": {"width": "N m"},
    "spring": {"stiffness": "N m/rad", "rest_angle": "rad"},
}
POINT: dict[str, dict[str, str]] = {
    "constant_force": {"ax": "m/s2", "ay": "m/s2"},
    "viscous_drag": {"coefficient": "1/s"},
    "quadratic_drag": {"coefficient": "1/m"},
    "payload": {"mass_ratio": "1"},
    "actuator_gain": {"gain": "1"},
    "actuator_delay": {"seconds": "s"},
}
ROBOTS = {"car": CAR, "pendulum": PENDULUM, "point": POINT}


@pytest.mark.parametrize(
    ("robot", "name", "units"),
    [(robot, name, units) for robot, effects in ROBOTS.items() for name, units in effects.items()],
)
def test_effect_has_these_parameters(robot: str, name: str, units: dict[str, str]) -> None:
    assert {p.name: p.unit for p in effects_of(robot)[name].parameters} == units


def test_library_holds_nothing_that_is_not_listed_here() -> None:
    for robot, effects in ROBOTS.items():
        assert set(effects_of(robot)) == set(effects)
