"""What is hidden in which log, and the files of a case: CSV logs, a model file, and the truth."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa_lab.own_robots.plants import OUTSIDE, PLANTS, Hidden, Values, drive

__all__ = ["SUITES", "OwnCase", "cases_of", "truth_of", "write_case"]

_FREE: Final[dict[str, tuple[str, Mapping[str, float], tuple[str, ...]]]] = {
    "own_servo": ("own_position_loop", {"stiffness": 200.0, "damping": 20.0}, ("stiffness", "damping")),
    "own_joint": ("own_joint", {"gain": 2.0, "gravity": 6.0}, ("gain", "gravity")),
    "own_tank": ("own_tank", {"inflow": 0.004, "outflow": 0.02}, ("inflow", "outflow")),
    "own_boat": (
        "own_boat",
        {"thrust_gain": 1.2, "surge_damping": 0.4, "rudder_gain": 0.9, "turn_damping": 1.2},
        (),
    ),
    "own_omni": ("own_omni", {"time_constant": 0.25}, ()),
    "own_crane": ("own_crane", {"cart": 1.0, "pole": 0.3, "length": 0.5}, ()),
    "own_motor": ("own_motor", {"gain": 50.0, "damping": 5.0}, ("gain",)),
    "own_quadrotor": ("own_quadrotor", {"gravity": 9.81}, ()),
    "own_bicycle": ("own_bicycle", {"follow": 1.5, "stiffness": 30.0}, ()),
    "own_conveyor": ("own_conveyor", {"gain": 2.0}, ("gain",)),
}
"""By robot: kind of the base, given values, and which of them are free."""

STRENGTHS: Final[dict[str, dict[str, dict[str, float]]]] = {
    "own_servo": {
        "target_offset": {"offset": 0.06}, "target_gain": {"gain": 0.85}, "target_dead_zone": {"width": 0.12},
        "target_lag": {"time_constant": 0.12}, "target_delay": {"seconds": 0.08}, "target_limit": {"limit": 0.55},
        "rate_friction": {"deceleration": 12.0}, "rate_speed_limit": {"limit": 1.6},
    },
    "own_joint": {
        "rate_friction": {"deceleration": 1.6}, "rate_drag": {"coefficient": 0.6}, "current_dead_zone": {"width": 0.6},
        "current_lag": {"time_constant": 0.08}, "current_delay": {"seconds": 0.06}, "current_limit": {"limit": 1.4},
        "rate_quadratic_drag": {"coefficient": 0.25}, "rate_spring": {"stiffness": 1.5},
    },
    "own_tank": {
        "pump_lag": {"time_constant": 25.0}, "pump_delay": {"seconds": 20.0}, "level_push": {"push": -0.004},
        "pump_limit": {"limit": 6.0},
    },
    "own_boat": {
        "surge_quadratic_drag": {"coefficient": 0.15}, "surge_push": {"push": 0.25},
        "thrust_dead_zone": {"width": 0.15},
        "thrust_gain": {"gain": 0.8}, "thrust_lag": {"time_constant": 0.8}, "rudder_offset": {"offset": 0.06},
        "rudder_gain": {"gain": 0.8}, "rudder_lag": {"time_constant": 0.6}, "rudder_delay": {"seconds": 0.5},
        "rudder_limit": {"limit": 0.3}, "turn_friction": {"deceleration": 0.12},
    },
    "own_omni": {
        "ux_gain": {"gain": 0.85}, "uy_lag": {"time_constant": 0.2}, "uw_delay": {"seconds": 0.2},
        "uy_offset": {"offset": 0.08}, "uw_limit": {"limit": 1.1}, "vx_friction": {"deceleration": 0.5},
        "w_friction": {"deceleration": 1.2}, "ux_dead_zone": {"width": 0.12}, "vx_acceleration_limit": {"limit": 1.5},
    },
    "own_crane": {
        "v_friction": {"deceleration": 0.5}, "v_drag": {"coefficient": 0.4}, "rate_drag": {"coefficient": 0.5},
        "force_gain": {"gain": 0.8}, "force_offset": {"offset": 0.4}, "force_dead_zone": {"width": 0.5},
        "force_lag": {"time_constant": 0.1}, "force_delay": {"seconds": 0.08}, "force_limit": {"limit": 2.4},
    },
    "own_motor": {
        "speed_friction": {"deceleration": 120.0}, "speed_quadratic_drag": {"coefficient": 0.03},
        "voltage_offset": {"offset": 0.9}, "voltage_dead_zone": {"width": 1.5}, "voltage_lag": {"time_constant": 0.06},
        "voltage_delay": {"seconds": 0.05}, "voltage_limit": {"limit": 7.0}, "speed_speed_limit": {"limit": 70.0},
    },
    "own_quadrotor": {
        "vx_drag": {"coefficient": 0.3}, "vy_quadratic_drag": {"coefficient": 0.15}, "vz_push": {"push": -0.4},
        "thrust_gain": {"gain": 0.93}, "thrust_lag": {"time_constant": 0.12}, "pitch_lag": {"time_constant": 0.12},
        "roll_delay": {"seconds": 0.1}, "pitch_gain": {"gain": 0.85}, "roll_offset": {"offset": 0.03},
    },
    "own_bicycle": {
        "steer_offset": {"offset": 0.04}, "steer_gain": {"gain": 0.85}, "steer_lag": {"time_constant": 0.15},
        "steer_delay": {"seconds": 0.15}, "steer_limit": {"limit": 0.18}, "speed_gain": {"gain": 0.9},
        "speed_delay": {"seconds": 0.3}, "vx_friction": {"deceleration": 0.5}, "speed_lag": {"time_constant": 0.3},
    },
    "own_conveyor": {
        "target_delay": {"seconds": 0.25}, "target_lag": {"time_constant": 0.3}, "target_offset": {"offset": 0.12},
        "target_dead_zone": {"width": 0.2}, "target_limit": {"limit": 1.1}, "speed_friction": {"deceleration": 0.35},
        "target_gain": {"gain": 0.88}, "speed_quadratic_drag": {"coefficient": 0.35},
    },
}  # fmt: skip
"""Effects at a size that an engineer would notice; each varies by 10 % from case to case."""

_EQUAL: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    # a push of a rate is an offset of the command that moves it
    "own_servo": {"target_offset": ("rate_push",)},
    "own_boat": {"surge_push": ("thrust_offset",)},
    "own_omni": {"uy_offset": ("vy_push",)},
    "own_tank": {"level_push": ("pump_offset",)},
    "own_motor": {"voltage_offset": ("speed_push",)},
    # a car that never reverses has the same friction always
    "own_bicycle": {"vx_friction": ("vx_push", "speed_offset")},
    # gain (target - v) - c v = (gain + c) (gain / (gain + c) target - v)
    "own_conveyor": {"target_offset": ("speed_push",), "target_gain": ("speed_drag",)},
}
"""By robot and hidden effect: what no data could tell from it."""
_TOGETHER: Final = ("lag", "delay", "gain", "limit", "offset", "push", "dead_zone", "friction")
"""Kinds of one channel that are not hidden together: their sum is that of others, to first order."""


@dataclass(frozen=True)
class OwnCase:
    """One set of logs and what is hidden in it."""

    suite: str
    robot: str
    seed: int
    effects: Hidden
    runs: int = 3
    outside: str = ""

    @property
    def name(self) -> str:
        """Suite, robot, hidden effects and seed, fit for a folder."""
        what = [*self.effects, *([self.outside] if self.outside else [])] or ["nothing"]
        return "-".join([self.suite, self.robot, *what, str(self.seed)])


def cases_of(suite: str, count: int, seed: int = 0) -> list[OwnCase]:
    """``count`` cases of a suite, each robot in turn; the same ones for the same seed."""
    robots, found = list(PLANTS), []
    for index in range(count):
        own = int(np.random.SeedSequence([seed, SUITES.index(suite), index]).generate_state(1)[0])
        random, robot, runs = (
            np.random.default_rng(own),
            robots[index % len(robots)],
            1 if index // len(robots) % 2 else 3,
        )
        if suite == "own_none":
            found.append(OwnCase(suite, robot, own, {}, runs))
        elif suite == "own_outside":
            found.append(OwnCase(suite, robot, own, {}, runs, OUTSIDE[(index + index // len(robots)) % len(OUTSIDE)]))
        else:
            found.append(OwnCase(suite, robot, own, _drawn(robot, 2 if suite == "own_two" else 1, random), runs))
    return found


SUITES: Final = ("own_one", "own_two", "own_none", "own_outside")
"""One effect, two effects, nothing, an effect outside every library."""


def _drawn(robot: str, count: int, random: np.random.Generator) -> dict[str, dict[str, float]]:
    while True:
        names = [str(name) for name in random.choice(list(STRENGTHS[robot]), count, replace=False)]
        channels = [name.split("_")[0] for name in names]
        # Two effects of one channel can be separated only in special drives.
        if len(set(channels)) == count or robot in ("own_tank",):
            break
    return {name: _jittered(STRENGTHS[robot][name], random) for name in names}


def _jittered(values: Mapping[str, float], random: np.random.Generator) -> dict[str, float]:
    # Of a value whose neutral is 1, the distance from it varies.
    return {
        key: (1.0 + (value - 1.0) * scale if key == "gain" else value * scale)
        for key, value in values.items()
        for scale in [1.0 + float(random.uniform(-0.1, 0.1))]
    }


def truth_of(case: OwnCase) -> dict[str, Any]:
    """The sealed document, as ``safedpa_lab.hidden.judge`` reads it."""
    return {
        "suite": case.suite,
        "seed": case.seed,
        "robot": case.robot,
        "effects": {name: dict(values) for name, values in case.effects.items()},
        "equals": {name: list(_EQUAL.get(case.robot, {}).get(name, ())) for name in case.effects},
        "absorbed": [],
        "present": [],
        "present_near": {},
        "laws": {},
        "outside": case.outside,
        "largest_group": 3,
    }


def write_case(
    case: OwnCase, folder: Path, logs: Sequence[tuple[Values, Values, Values]] | None = None
) -> tuple[Path, list[Path], Path]:
    """Writes one case; returns the model file, the logs, and the file with the truth.

    ``logs`` (times, states, actions) replace those that the case would drive.
    """
    plant, given = PLANTS[case.robot], folder / "given"
    given.mkdir(parents=True, exist_ok=True)
    runs = []
    driven = (drive(plant, case.effects, case.seed + number, case.outside) for number in range(case.runs))
    for number, (times, states, actions) in enumerate(driven if logs is None else logs):
        path = given / f"run_{number + 1}.csv"
        table, header = np.column_stack([times, states, actions]), ",".join(("t", *plant.states, *plant.actions))
        np.savetxt(path, table, fmt="%.9g", delimiter=",", header=header, comments="")
        runs.append(path)
    kind, values, free = _FREE[case.robot]
    lines = ["format = 1", f'robot = "{case.robot}"', f"period = {plant.period}", "", "[base]", f'kind = "{kind}"']
    lines += [
        f"{name} = {f'{{ value = {value}, free = true }}' if name in free else value}" for name, value in values.items()
    ]
    model = given / "model.toml"
    model.write_text("\n".join(lines) + "\n", encoding="utf-8")
    truth = folder / "truth.json"
    truth.write_text(json.dumps(truth_of(case), indent=1) + "\n", encoding="utf-8")
    return model, runs, truth
