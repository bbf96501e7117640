"""Lags, delays and hidden vessels are found at any period of the logs, from a millisecond to an hour."""

from pathlib import Path

import numpy as np
import pytest

from safedpa.diagnosis.add_effect import add_effect
from safedpa.dynamics import load_model, load_user_file
from safedpa.records.run import Run
from safedpa.systems import systems

_ROBOT = """
from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, general_effects
from safedpa.systems import System, Variable

SYSTEM = System("vessel", (Variable("level", "m", -5.0, 5.0),), (Variable("pump", "1", 0.0, 1.0),))


class Vessel(AbstractBase):
    kind, equation, source, system = "vessel", "level' = pace (pump - level)", "Torricelli", SYSTEM
    parameters = (Parameter("pace", "1/s", 0.0, 1e5, 1.0),)

    def rates(self, state, action, parameters, operations):
        return {"level": parameters["pace"] * (action["pump"] - state["level"])}


EFFECTS = general_effects(SYSTEM, moving={"level": 0.5})
"""


def drive(kind: str, seed: int, period: float) -> Run:
    """A log of 800 rows whose pump follows with a lag of 6 periods, a delay of 9.5, or through a hidden vessel."""
    random, fine = np.random.default_rng(seed), 20
    commands = np.repeat(random.uniform(0.0, 1.0, 80), random.integers(5, 25, 80))[:800]
    felt, level, states = float(commands[0]), 0.0, []
    content = 0.5 * 8.0 * felt * felt
    for row in range(len(commands)):
        states.append(level)
        for part in range(fine):
            late = commands[max(row + (part - 190) // fine, 0)]
            if kind == "reservoir":
                content += (commands[row] - felt) / fine
                felt = float(np.sqrt(2.0 * max(content, 0.0) / 8.0))
            else:
                lagging = felt + (commands[row] - felt) * (1.0 - np.exp(-1.0 / (6.0 * fine)))
                felt = late if kind == "delay" else lagging
            level += (felt - level) * (1.0 - np.exp(-0.2 / fine))
    measured = np.array(states)[:, None] + 0.002 * random.standard_normal((len(states), 1))
    t = period * np.arange(len(states))
    return Run.from_arrays(t, measured, commands[:, None], systems()["vessel"], name=f"drive_{seed}")


@pytest.mark.long
@pytest.mark.parametrize("period", [0.001, 1.0, 3600.0])
@pytest.mark.parametrize(
    ("kind", "name", "periods"),
    [("lag", "time_constant", 6.0), ("delay", "seconds", 9.5), ("reservoir", "seconds", 8.0)],
)
def test_lag_delay_and_hidden_vessel_of_several_periods_are_found(
    kind: str, name: str, periods: float, period: float, tmp_path: Path
) -> None:
    robot, model = tmp_path / "vessel.py", tmp_path / "vessel.toml"
    robot.write_text(_ROBOT, encoding="utf-8")
    text = f'format = 1\nrobot = "vessel"\nperiod = {period}\n[base]\nkind = "vessel"\npace = {0.2 / period!r}\n'
    model.write_text(text, encoding="utf-8")
    load_user_file(robot)
    runs = [drive(kind, seed, period) for seed in (1, 2, 3)]
    found = add_effect(load_model(model), f"pump_{kind}", runs, 10.0 * period)
    fitted = found.values[f"pump_{kind}.{name}"]
    assert fitted.std is not None
    assert abs(fitted.value / period - periods) <= 2.0 * fitted.std / period + 0.02 * periods
    assert found.after.value < 0.5 * found.before.value
