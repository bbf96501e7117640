"""Of a robot that nobody declared, or that does not say which barriers may be drawn, no margin is made up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.safety.live_margin import live_margin
from safedpa.safety.run_calibration import calibration_from_runs
from safedpa.safety.shipped import settings_named
from safedpa.safety.theory_recorded import RecordedBound, recorded_bound


def stranger() -> PhysicsModel:
    """A car but for the names of its states, so that nobody declares it."""
    model = load_model("car")
    states = tuple(replace(one, name=f"other_{one.name}") for one in model.system.state)
    model.system = replace(model.system, name="stranger", state=states)
    return model


def point() -> PhysicsModel:
    """A robot that is declared, and draws no barriers around the states of a log."""
    return load_model("point_wind")


ROBOTS: dict[str, tuple[Callable[[], PhysicsModel], str]] = {
    "a stranger": (stranger, "car"),
    "a point": (point, "point"),
}


def run_of(model: PhysicsModel) -> Run:
    states, actions = np.zeros((4, len(model.system.state))), np.zeros((4, len(model.system.action)))
    return Run("run", model.system, model.period * np.arange(4), states, actions, (Stretch(0, 4),))


@pytest.mark.parametrize("case", ROBOTS)
def test_whose_barriers_nobody_can_draw_gets_no_margin_with_an_effect(case: str) -> None:
    made, settings = ROBOTS[case]
    model = made()
    assert live_margin(model, settings_named(settings), run_of(model), ()) == ""


@pytest.mark.parametrize("case", ROBOTS)
def test_whose_barriers_nobody_can_draw_is_not_calibrated_from_runs(case: str) -> None:
    made, settings = ROBOTS[case]
    model = made()
    said = rf"^margin: got a model with .* the states {', '.join(model.system.state_names)}, wanted one of a robot"
    with pytest.raises(InputError, match=said):
        calibration_from_runs(model, settings_named(settings), [run_of(model)], 0.5, "2024-01-01")


@pytest.mark.parametrize("case", ROBOTS)
def test_whose_gradients_nobody_knows_has_no_margin_by_the_theorem(case: str) -> None:
    made, settings = ROBOTS[case]
    nothing: Any = SimpleNamespace()  # not one transition of it is looked at
    bound = recorded_bound(made(), settings_named(settings), nothing, np.zeros(0, dtype=bool), 0.5)
    assert bound == RecordedBound({}, {})
