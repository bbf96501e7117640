"""The steps of every general effect on robots that do not ship are those that were recorded.

``python tests/effects/test_recorded_general.py`` records them again, after a change of an equation that is meant.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import AbstractEffect
from safedpa_lab.own_robots.models import BASES, EFFECTS
from safedpa_lab.own_robots.plants import PLANTS

RECORD = Path(__file__).with_name("general_steps.json")
ROBOTS = ("own_servo", "own_joint", "own_omni", "own_motor")
TICKS, SITUATIONS = 6, 2
KNOWN = {kind.system.name: kind() for kind in BASES}
ITEMS = [item for item in EFFECTS if item.robot in ROBOTS]


def steps(item: AbstractEffect) -> list[list[float]]:
    """The change of the state over a few periods with the effect's typical values."""
    plant = PLANTS[item.robot]
    given = {f"base.{part.name}": Setting(part.typical) for part in KNOWN[item.robot].parameters}
    model = PhysicsModel(KNOWN[item.robot], (), given, plant.period)
    model = model.with_effect(item, {part.name: Setting(part.typical) for part in item.parameters})
    chance, found = np.random.default_rng(5), []
    for _ in range(SITUATIONS):
        start = chance.uniform(-1.0, 1.0, len(plant.states)) * [plant.sizes.get(name, 0.5) for name in plant.states]
        actions = chance.uniform(plant.low, plant.high, (TICKS, len(plant.low)))
        state, memory = start, model.initial_memory(actions[0])
        for tick, action in enumerate(actions):
            state, memory = model.advance(state, action, memory, time=tick * model.period)
        found.append([float(f"{value:.10g}") for value in state - start])
    return found


@pytest.mark.parametrize("item", ITEMS, ids=lambda item: f"{item.robot}-{item.name}")
def test_the_steps_of_a_general_effect_are_the_recorded_ones(item: AbstractEffect) -> None:
    wanted = json.loads(RECORD.read_text(encoding="utf-8"))[f"{item.robot}.{item.name}"]
    np.testing.assert_allclose(steps(item), wanted, rtol=1e-7, atol=1e-9)


if __name__ == "__main__":
    lines = [f"{json.dumps(f'{item.robot}.{item.name}')}: {json.dumps(steps(item))}" for item in ITEMS]
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
