"""Dead times that are looked up: how many are remembered, and of which decision."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect
from safedpa.safety.on_its_way import LONGEST, Actuators, Reach
from safedpa.safety.trail import Trail

CAR = load_model("car")
LATENT = tuple(CAR.latent.tolist())
DELAYED = CAR.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.15)})


def test_dead_times_are_kept_for_64_latents_that_differ_in_the_third_digit(monkeypatch: pytest.MonkeyPatch) -> None:
    actuators, asked = Actuators(DELAYED), list[tuple[float, ...] | None]()

    def responded(latent: tuple[float, ...] | None) -> Reach:
        asked.append(latent)
        return Reach(1, 2)

    monkeypatch.setattr(actuators, "_responded", responded)
    for number in range(LONGEST):
        assert tuple(actuators.reach((0.002 * number,))) == (1, 2)
    assert (LONGEST, len(asked)) == (64, 64)
    actuators.reach((0.0,))
    actuators.reach((0.0004,))
    assert len(asked) == 64, "known, and alike to three digits"
    actuators.reach((0.201,))
    actuators.reach((0.0,))
    assert len(asked) == 66, "with one more all are forgotten"


def test_the_dead_time_is_that_of_the_decision_before_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the newest state nothing is decided yet."""
    trail, asked = Trail(DELAYED), list[object]()
    memory = DELAYED.initial_memory(np.zeros(2), np.array(LATENT))
    for tick in range(9):
        trail.add(tick, (0.05 * tick, 0.0, 0.0, 1.0), (1.0, 0.0), memory)
        trail.decided((*LATENT[:-1], float(tick)))

    def reach(latent: object) -> Reach:
        asked.append(latent)
        return Reach(1, 1)

    monkeypatch.setattr(trail._actuators, "reach", reach)
    assert trail.foretold(0.0) is not None
    assert asked == [(*LATENT[:-1], 7.0)]
