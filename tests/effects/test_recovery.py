"""Effects of any robot, hidden in an axis that is simulated without the product, are found with their true values."""

from collections import deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from safedpa.diagnosis.add_effect import add_effect
from safedpa.dynamics import PhysicsModel, load_user_file
from safedpa.dynamics.base import bases_of
from safedpa.records.run import Run
from safedpa.systems import systems

_FINE = 25
"""Steps of the integrator in a period."""

TRUTHS: dict[str, dict[str, float]] = {
    "torque_gain": {"gain": 0.8},
    "torque_offset": {"offset": -0.1},
    "torque_dead_zone": {"width": 0.15},
    "torque_curve": {"square": 0.5},
    "torque_limit": {"limit": 0.6},
    "torque_limit_up_down": {"high": 0.7, "low": -0.4},
    "torque_backlash": {"width": 0.3},
    "torque_slew_limit": {"rate": 2.5},
    "torque_slew_limit_up_down": {"rate_up": 2.0, "rate_down": 4.0},
    "torque_lag": {"time_constant": 0.2},
    "torque_lag_up_down": {"time_constant_up": 0.1, "time_constant_down": 0.3},
    "torque_second_order": {"frequency": 9.0, "damping": 0.4},
    "torque_delay": {"seconds": 0.13},
    "torque_supply": {"share": 1.0},
    "torque_torque_speed": {"slope": 0.2},
    "rate_drag": {"coefficient": 0.5},
    "rate_quadratic_drag": {"coefficient": 0.3},
    "rate_friction": {"deceleration": 0.8},
    "rate_stribeck": {"deceleration": 1.0, "fading": 0.5},
    "rate_load_friction": {"share": 0.3},
    "rate_push": {"push": 0.5},
    "rate_spring": {"stiffness": 2.0},
    "rate_gravity": {"sine": 3.0, "cosine": 1.5},
    "rate_inertia": {"ratio": 0.4},
    "rate_speed_limit": {"limit": 1.6},
    "rate_speed_limit_up_down": {"limit_up": 1.8, "limit_down": 1.2},
    "rate_acceleration_limit": {"limit": 2.0},
    "rate_acceleration_limit_up_down": {"limit_up": 1.5, "limit_down": 3.0},
    "rate_end_stop": {"low": -1.0, "high": 2.0},
    "rate_bias": {"bias": 0.15},
    "rate_scale": {"scale": 1.1},
    "angle_sensor_delay": {"seconds": 0.04},
}
"""Sizes that an engineer would notice."""


def drive(kind: str, p: Mapping[str, float], seed: int, period: float, seconds: float) -> Run:
    """A log of the axis with one hidden effect, by small Euler steps; commands change at rows."""
    random, rows, dt = np.random.default_rng(seed), round(seconds / period), period / _FINE
    commands, battery = np.empty(rows), 11.0 + 2.0 * np.sin(np.arange(rows) * period / 3.0)
    at = 0
    while at < rows:
        end = at + 1 + int(random.uniform(0.2, 1.2) * 20.0)
        commands[at:end], at = random.uniform(-1.0, 1.0), end
    x, v, states = 0.0, 0.0, np.empty((rows, 2))
    actuator = Actuator(kind, p, commands[0], dt)
    for row in range(rows):
        states[row] = x, v
        for _ in range(_FINE):
            u = actuator.next(commands[row], battery[row], v)
            before = x
            x, v = x + dt * v, v + dt * accelerated(kind, p, u, x, v)
            if kind.startswith("rate_speed_limit"):
                v = float(np.clip(v, -p.get("limit", p.get("limit_down", 0.0)), p.get("limit", p.get("limit_up", 0.0))))
            if kind == "rate_end_stop" and not p["low"] <= x <= p["high"]:
                x, v = float(np.clip(x, p["low"], p["high"])), float(np.clip(v, 0.0 if before > 0 else -9, 0.0)) * 0.0
    measured = sensed(kind, p, states) + random.standard_normal(states.shape) * np.array([0.001, 0.005])
    actions = np.stack([commands, battery], axis=1)
    return Run.from_arrays(
        np.arange(rows) * period, measured, actions, systems()["recovery_axis"], name=f"drive_{seed}"
    )


class Actuator:
    """What the axis feels of a command."""

    def __init__(self, kind: str, p: Mapping[str, float], u: float, dt: float) -> None:
        self.kind, self.p, self.felt, self.speed, self.dt = kind.removeprefix("torque_"), p, u, 0.0, dt
        self.line = deque([u] * round(p.get("seconds", 0.0) / dt))

    def next(self, u: float, battery: float, v: float) -> float:
        p, kind, dt, gap = self.p, self.kind, self.dt, u - self.felt
        self.line.append(u)
        late = self.line.popleft() if kind == "delay" else 0.0
        if kind == "second_order":
            self.speed += dt * (p["frequency"] ** 2 * gap - 2.0 * p["damping"] * p["frequency"] * self.speed)
            self.felt += dt * self.speed
        elif kind.startswith("lag"):
            constant = p.get("time_constant", p.get("time_constant_up" if gap > 0 else "time_constant_down", 1.0))
            self.felt += gap * (1.0 - float(np.exp(-dt / constant)))
        elif kind.startswith("slew_limit"):
            up, down = p.get("rate", p.get("rate_up", 0.0)), p.get("rate", p.get("rate_down", 0.0))
            self.felt += float(np.clip(gap, -down * dt, up * dt))
        elif kind == "backlash":
            self.felt = float(np.clip(self.felt, u - 0.5 * p["width"], u + 0.5 * p["width"]))
        simple = {
            "gain": lambda: p["gain"] * u,
            "offset": lambda: u + p["offset"],
            "dead_zone": lambda: np.sign(u) * max(abs(u) - p["width"], 0.0),
            "curve": lambda: u + p["square"] * abs(u) * u,
            "limit": lambda: np.clip(u, -p["limit"], p["limit"]),
            "limit_up_down": lambda: np.clip(u, p["low"], p["high"]),
            "delay": lambda: late,
            "supply": lambda: u * battery / 11.0,
            "torque_speed": lambda: u - p["slope"] * abs(u) * v,
        }
        memory = ("second_order", "lag", "lag_up_down", "slew_limit", "slew_limit_up_down", "backlash")
        return self.felt if kind in memory else float(simple.get(kind, lambda: u)())


def accelerated(kind: str, p: Mapping[str, float], u: float, x: float, v: float) -> float:
    """The acceleration of the axis."""
    plain, sign = 4.0 * u - 1.0 * v, float(np.tanh(v / 0.01))
    return float(
        {
            "rate_drag": lambda: plain - p["coefficient"] * v,
            "rate_quadratic_drag": lambda: plain - p["coefficient"] * abs(v) * v,
            "rate_friction": lambda: plain - p["deceleration"] * sign,
            "rate_stribeck": lambda: plain - p["deceleration"] * np.exp(-((v / p["fading"]) ** 2)) * sign,
            "rate_load_friction": lambda: plain - p["share"] * abs(plain) * sign,
            "rate_push": lambda: plain + p["push"],
            "rate_spring": lambda: plain - p["stiffness"] * x,
            "rate_gravity": lambda: plain - p["sine"] * np.sin(x) - p["cosine"] * np.cos(x),
            "rate_inertia": lambda: plain / (1.0 + p["ratio"]),
            "rate_acceleration_limit": lambda: np.clip(plain, -p["limit"], p["limit"]),
            "rate_acceleration_limit_up_down": lambda: np.clip(plain, -p["limit_down"], p["limit_up"]),
        }.get(kind, lambda: plain)()
    )


def sensed(kind: str, p: Mapping[str, float], states: np.ndarray) -> np.ndarray:
    x, v = states.T
    if kind == "angle_sensor_delay":
        x = np.interp(np.arange(len(x)) - p["seconds"] / 0.05, np.arange(len(x)), x)
    return np.stack([x, v * p.get("scale", 1.0) + p.get("bias", 0.0)], axis=1)


@pytest.fixture(autouse=True)
def the_axis_is_known() -> None:
    load_user_file(Path(__file__).with_name("axis_robot.py"))


def model(period: float = 0.05) -> PhysicsModel:
    return PhysicsModel(bases_of("recovery_axis")["recovery_axis"](), (), {}, period)


@pytest.mark.long
@pytest.mark.parametrize("name", TRUTHS)
def test_a_hidden_effect_is_found_with_its_true_values(name: str) -> None:
    truth = TRUTHS[name]
    runs = [drive(name, truth, seed, 0.05, 40.0) for seed in (11, 12, 13)]
    found = add_effect(model(), name, runs)
    for key, value in truth.items():
        fitted = found.values[f"{name}.{key}"]
        assert fitted.std is not None
        assert abs(fitted.value - value) <= 2.0 * fitted.std + 0.01 * abs(value), f"{fitted} for {value}"
    assert found.after.value < 0.9 * found.before.value
