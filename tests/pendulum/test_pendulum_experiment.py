"""Both questions in small, with the models that ship: what SafeDPA keeps and what fixed winds do not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from safedpa.dynamics import fingerprint, load_model
from safedpa.safety import MarginCalibration
from safedpa_lab.pendulum.balancing import balanced, balanced_account
from safedpa_lab.pendulum.methods import BALANCING_METHODS
from safedpa_lab.pendulum.rollouts import Closed, swung
from safedpa_services.command_line import safedpa
from safedpa_sim.pendulum.task import BALANCING, WIND, filter_settings

NOWHERE = Path("no models here")
"""So that those that ship are taken."""
METHODS = {method.name: method for method in BALANCING_METHODS}


def test_adaptation_keeps_what_a_fixed_wind_does_not() -> None:
    found = {
        name: balanced_account(balanced(METHODS[name], NOWHERE, 0.018, 4, 1, seed=5, ticks=200), 4)
        for name in ("safedpa", "fix_45", "oracle")
    }
    assert found["safedpa"]["safe"] == found["oracle"]["safe"] == 4
    assert found["fix_45"]["safe"] < 4
    assert found["safedpa"]["relaxed"] == 0.0


def test_without_a_filter_the_wish_goes_through() -> None:
    start, wind = np.zeros((1, 2)), np.array([[WIND, 0.0]])
    swings = swung(Closed(), lambda state, _: np.full((len(state), 1), 99.0), start, wind, BALANCING, 40)
    assert swings.states[-1, 0, 0] > BALANCING[1]
    assert swings.torques.max() <= 50.0, "the system's own bound"


def test_the_same_draws_for_every_method() -> None:
    loose = filter_settings(0.0)
    assert loose.action_low == (-10.0,)
    one, two = (balanced(METHODS["mix"], NOWHERE, 0.018, 4, 1, seed=6, ticks=20) for _ in range(2))
    np.testing.assert_array_equal(one.states, two.states)


@pytest.mark.slow
def test_the_whole_experiment_in_small(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--directions", "4", "--episodes", "1", "--processes", "1", "--models", str(NOWHERE)]
    assert safedpa.run(["experiment", "pendulum", *options, "--out", str(tmp_path)]) == 0
    assert "| SafeDPA | 4/4 |" in capsys.readouterr().out
    result = json.loads((tmp_path / "pendulum.json").read_text())
    assert result["hazard"]["safedpa"]["both"] == 4
    assert 4.0 < result["invariance"]["largest_wind"]["balancing"] < 5.2
    margin = MarginCalibration.load(tmp_path / "margin.toml")
    assert margin.fingerprint == fingerprint(load_model("pendulum_learned"))
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert len(pictures) == 4


@pytest.mark.parametrize("mistake", ["--directions=1", "--episodes=0", "--seed=-1"])
def test_a_mistake_is_one_line(mistake: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["experiment", "pendulum", mistake]) == 2
    assert capsys.readouterr().err.count("\n") == 1
