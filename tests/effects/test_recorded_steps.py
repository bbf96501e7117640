"""The steps of every effect are those that were recorded: an equation that loses a term moves the robot elsewhere.

``python tests/effects/test_recorded_steps.py`` records them again, after a change of an equation that is meant.
"""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from safedpa.effects import AbstractEffect

LAWS = runpy.run_path(str(Path(__file__).with_name("test_every_effect.py")))
RECORD = Path(__file__).with_name("steps.json")
SITUATIONS = 3


def steps(item: AbstractEffect) -> dict[str, list[list[float]]]:
    """By drive: the change of the state over a few periods that the effect makes, with its typical values."""
    found = {}
    for drive in LAWS["drives_of"](item):
        model = LAWS["with_free"](LAWS["base_model"](drive), item, {p.name: p.typical for p in item.parameters})
        chance, rows = np.random.default_rng(11), []
        for _ in range(SITUATIONS):
            scale = LAWS["STATE_SCALE"][item.robot]
            state = chance.uniform(-1.0, 1.0, len(scale)) * scale
            actions = chance.uniform(-1.0, 1.0, (LAWS["TICKS"], len(LAWS["ACTION_SCALE"][drive])))
            after = LAWS["rollout"](model, state, actions * LAWS["ACTION_SCALE"][drive])
            rows.append([float(f"{value:.12g}") for value in after - state])
        found[drive] = rows
    return found


def recorded() -> dict[str, dict[str, list[list[float]]]]:
    return {f"{item.robot}.{item.name}": steps(item) for item in LAWS["ALL"]}


@pytest.mark.parametrize("item", LAWS["ALL"], ids=lambda item: f"{item.robot}-{item.name}")
def test_the_steps_of_every_effect_are_the_recorded_ones(item: AbstractEffect) -> None:
    wanted = json.loads(RECORD.read_text(encoding="utf-8"))[f"{item.robot}.{item.name}"]
    found = steps(item)
    assert found.keys() == wanted.keys()
    for drive, rows in wanted.items():
        np.testing.assert_allclose(found[drive], rows, rtol=1e-9, atol=1e-11)


if __name__ == "__main__":
    lines = [f"{json.dumps(name)}: {json.dumps(rows)}" for name, rows in recorded().items()]
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
