"""Effects on several axes at once, hidden in a body that is pushed over a plane."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from safedpa.diagnosis.add_effect import add_effect
from safedpa.dynamics import PhysicsModel, load_user_file
from safedpa.dynamics.base import bases_of
from safedpa.records.run import Run
from safedpa.systems import systems

_ROBOT = """
from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, general_effects
from safedpa.systems import System, Variable

SYSTEM = System(
    "puck",
    (Variable("yaw", "rad", -99.0, 99.0), Variable("vx", "m/s", -9.0, 9.0), Variable("vy", "m/s", -9.0, 9.0)),
    (Variable("ax", "m/s2", -2.0, 2.0), Variable("ay", "m/s2", -2.0, 2.0), Variable("spin", "rad/s", -2.0, 2.0)),
)


class Puck(AbstractBase):
    kind, equation, source, system = "puck", "yaw' = spin, v' = a - loss v", "Newton", SYSTEM
    parameters = (Parameter("loss", "1/s", 0.0, 9.0, 0.3, 0.3),)

    def rates(self, state, action, parameters, operations):
        x, y = (action[name] - parameters["loss"] * state[f"v{name[1]}"] for name in ("ax", "ay"))
        return {"yaw": action["spin"], "vx": x, "vy": y}


EFFECTS = general_effects(SYSTEM, moving={"vx": 1.0, "vy": 1.0}, heading="yaw")
"""
TRUTHS: dict[str, dict[str, float]] = {
    "velocity_drag": {"coefficient": 0.5},
    "velocity_quadratic_drag": {"coefficient": 0.4},
    "velocity_body_drag": {"along": 0.2, "across": 0.9},
    "vx_by_vy": {"coefficient": -0.6},
    "ax_by_ay": {"share": 0.3},
}


def drive(name: str, p: Mapping[str, float], seed: int) -> Run:
    """A log of 40 s, by small Euler steps; commands change at rows."""
    random, rows, fine = np.random.default_rng(seed), 800, 20
    commands = np.repeat(random.uniform(-2.0, 2.0, (80, 3)), 10, axis=0)
    yaw, v, states, dt = 0.0, np.zeros(2), [], 0.05 / fine
    for row in range(rows):
        states.append([yaw, *v])
        for _ in range(fine):
            push = commands[row, :2] - 0.3 * v
            turned = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            if name == "velocity_drag":
                push -= p["coefficient"] * v
            elif name == "velocity_quadratic_drag":
                push -= p["coefficient"] * float(np.hypot(*v)) * v
            elif name == "velocity_body_drag":
                push -= turned @ (np.array([p["along"], p["across"]]) * (turned.T @ v))
            elif name == "vx_by_vy":
                push[0] += p["coefficient"] * v[1]
            else:
                push[0] += p["share"] * commands[row, 1]
            yaw, v = yaw + dt * commands[row, 2], v + dt * push
    measured = np.array(states) + random.standard_normal((rows, 3)) * np.array([0.002, 0.01, 0.01])
    return Run.from_arrays(0.05 * np.arange(rows), measured, commands, systems()["puck"], name=f"drive_{seed}")


@pytest.mark.long
@pytest.mark.parametrize("name", TRUTHS)
def test_one_effect_on_several_axes_is_found_with_its_true_values(name: str, tmp_path: Path) -> None:
    robot = tmp_path / "puck.py"
    robot.write_text(_ROBOT, encoding="utf-8")
    load_user_file(robot)
    model = PhysicsModel(bases_of("puck")["puck"](), (), {}, 0.05)
    found = add_effect(model, name, [drive(name, TRUTHS[name], seed) for seed in (21, 22, 23)])
    for key, truth in TRUTHS[name].items():
        fitted = found.values[f"{name}.{key}"]
        assert fitted.std is not None
        assert abs(fitted.value - truth) <= 2.0 * fitted.std + 0.01 * abs(truth), f"{fitted} for {truth}"
