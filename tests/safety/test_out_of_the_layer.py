"""The wish in place of standing in the margin's layer: only where the next tick tells what the wish does."""

from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.safety import Status
from safedpa.safety.filtered_robot import FilteredRobot
from safedpa.safety.held_model import HeldModel, uncalibrated
from safedpa.safety.on_its_way import Pending
from safedpa.safety.shipped import settings_named
from safedpa.safety.verdict import resting_verdict
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene


def delayed() -> PhysicsModel:
    return load_model("car").with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})


@pytest.mark.parametrize("late", [True, False])
def test_with_a_delay_the_next_tick_says_nothing_of_the_wish(late: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is on its way raises h; the wish, which begins to act later, would be handed on for that."""
    model, settings = delayed() if late else load_model("car"), settings_named("car")
    own = fingerprint(model)
    memory = FilteredRobot.begun(HeldModel(model, own, uncalibrated(settings, own)), settings)
    state = CarRobot(Scene.random(3, "none"), 0.05).state_message()
    memory.barriers = memory.scene.of(state)
    if late:
        memory.pending = Pending(model.initial_memory(np.array([0.0, 0.0])), (0.0, 0.0))
    resting: Any = resting_verdict(np.zeros(2), "none")
    relaxed = type(resting)(**{**vars(resting), "status": Status.relaxed, "wish": np.array([0.5, 0.0])})
    found = memory.out_of_the_layer(state, relaxed, model.latent)
    assert (found is relaxed) is late
