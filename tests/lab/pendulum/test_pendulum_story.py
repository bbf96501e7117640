"""The story on a second robot in small: a payload is named from swings, and the mended filter uses more of its room."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting, load_model, write_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.records import Run
from safedpa_lab.experiments import pendulum_payload
from safedpa_lab.experiments.pendulum_payload import PayloadCases, diagnosed_payload
from safedpa_lab.experiments.pendulum_story import PendulumStory, pendulum_story
from safedpa_lab.experiments.pendulum_story_report import story_markdown
from safedpa_lab.pendulum.hidden import PERIOD
from safedpa_services.command_line import safedpa


@pytest.mark.long
def test_a_payload_is_found_and_the_corrected_model_needs_less_margin() -> None:
    story = PendulumStory(
        hidden=("payload",), directions=2, episodes=1, seconds=1.2, swings=2, swing_seconds=8.0, processes=1
    )
    result = pendulum_story(story)
    case = result["cases"]["payload"]
    assert case["added"] == ["tip_mass"]
    assert case["values"]["tip_mass.mass"]["value"] == pytest.approx(0.5, abs=0.01)
    assert case["error"][-1] < 0.1 * case["error"][0]
    rows = case["rows"]
    assert rows["diagnosed"]["margin"] < 0.5 * rows["shipped"]["margin"]
    assert rows["diagnosed"]["reach"] > rows["shipped"]["reach"]
    assert all(row["safe"] == 2 for row in rows.values())
    assert "added tip_mass 0.5" in story_markdown({**result, "date": "today"})


def identified() -> str:
    """Not the identification, which needs the real logs: a pendulum of about its numbers.

    Without friction nothing could tell a payload from a weaker motor: both scale the torque alone.
    """
    friction = effect("pendulum", "coulomb_friction")
    model = load_model("dfki_pendulum").with_effect(friction, {"torque": Setting(0.19)})
    return write_model(model.with_settings({path: Setting(item.value) for path, item in model.settings.items()}))


@pytest.mark.parametrize(
    ("value", "std", "within"),
    [
        (0.25, 0.03, True),
        (0.15, 0.03, True),
        (0.2, 0.001, True),
        (0.25, 0.02, False),
        (0.15, 0.02, False),
        (0.2, None, False),
        (None, None, False),
    ],
)
def test_a_payload_is_found_where_its_mass_lies_within_two_of_the_stated_deviations(
    value: float | None, std: float | None, within: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hidden are 0.2 kg."""
    named = {} if value is None else {"tip_mass.mass": SimpleNamespace(value=value, std=std)}
    found = SimpleNamespace(parameters=named, added=list(named), stages=[SimpleNamespace(heldout_error=0.5)])
    logs = []

    def diagnose(_: PhysicsModel, runs: list[Run], __: float) -> Any:
        logs.extend(runs)
        return found

    monkeypatch.setattr(pendulum_payload, "diagnose", diagnose)
    row = diagnosed_payload((identified(), 0.2, 3, 2, 1.0))
    assert row["within"] is within
    assert (row["value"], row["std"], row["mass"], row["seed"]) == (value, std, 0.2, 3)
    assert [run.t[-1] for run in logs] == pytest.approx([1.0 - PERIOD] * 2)
    assert not np.array_equal(logs[0].actions, logs[1].actions)


@pytest.mark.long
def test_a_users_payload_is_named_and_weighed() -> None:
    row = diagnosed_payload((identified(), 0.2, 0, 2, 12.0))
    assert row["added"] == ["tip_mass"]
    assert row["within"], row


def test_mistakes_are_named(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="--directions: got 0"):
        PendulumStory(directions=0)
    with pytest.raises(InputError, match="wanted logs of DFKI's pendulum"):
        PayloadCases(tmp_path)
    assert safedpa.run(["experiment", "pendulum-story", "--hidden", "ghost"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
