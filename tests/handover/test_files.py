"""What a diagnosis finds has one sign and value in its answer, report, page and saved model; a lost run is named."""

import json
from pathlib import Path

import numpy as np
import pytest

from safedpa.comparison.comparison import compare_model
from safedpa.comparison.summary import run_sentence
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.records import Run, Stretch, write_csv
from safedpa_services.command_line.group import safedpa

CAR = load_model("car")


def bent(angle: float) -> PhysicsModel:
    return CAR.with_effect(effect("car", "steering_offset"), {"angle": Setting(angle)})


def driven(model: PhysicsModel, seed: int, seconds: float = 20.0) -> Run:
    """A drive of a car with the model, measured with noise."""
    draw = np.random.default_rng(seed)
    rows = round(seconds / CAR.period)
    actions = np.repeat(draw.uniform((0.3, -0.3), (1.8, 0.3), (rows // 10 + 1, 2)), 10, axis=0)[:rows]
    states, memory = np.zeros((rows, 4)), model.initial_memory(actions[0])
    for row in range(rows - 1):
        time = row * CAR.period
        states[row + 1], memory = model.advance(states[row], actions[row], memory, period=CAR.period, time=time)
    measured = states + draw.normal(0.0, 1.0, states.shape) * (0.002, 0.002, 0.003, 0.015)
    return Run(f"run{seed}", CAR.system, CAR.period * np.arange(rows), measured, actions, (Stretch(0, rows),))


@pytest.mark.long
@pytest.mark.parametrize("angle", [-0.06, 0.06])
def test_an_effect_has_one_sign_and_value_wherever_it_is_reported(
    angle: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    library = [effect("car", name) for name in ("steering_offset", "rolling_resistance")]
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: library)
    logs = [tmp_path / f"{seed}.csv" for seed in (1, 2)]
    for seed, log in enumerate(logs):
        write_csv(driven(bent(angle), seed), log)
    out = tmp_path / "out"
    assert safedpa.run(["diagnose", "car", *map(str, logs), "--out", str(out), "--json"]) == 0
    answered = json.loads(capsys.readouterr().out)["parameters"]["steering_offset.angle"]
    reported = json.loads((out / "report.json").read_text(encoding="utf-8"))["parameters"]["steering_offset.angle"]
    assert reported == answered
    assert answered["value"] == pytest.approx(angle, abs=0.01)
    saved = load_model(out / "model.toml").settings["steering_offset.angle"]
    assert saved.value == pytest.approx(answered["value"], abs=0.1 * answered["std"])
    page = (out / "report.html").read_text(encoding="utf-8").replace("\u2212", "-")
    assert f"{answered['value']:.3f}"[: 5 + (angle < 0)] in page
    assert compare_model(load_model(out / "model.toml"), [driven(bent(angle), 7)]).error.value < 0.05


def test_of_several_runs_the_one_that_is_worse_than_no_change_is_named() -> None:
    """From the rows of the logs to the sentence."""
    standing = driven(CAR, 3)
    resting = np.tile(standing.states[:1], (len(standing.t), 1))  # it was lifted: commands, and nothing moved
    lost = Run("lifted", CAR.system, standing.t, resting + 0.02 * standing.states, standing.actions, standing.stretches)
    sentence = run_sentence(compare_model(CAR, [driven(CAR, 1), driven(CAR, 2), lost]))
    assert "lifted" in sentence
    assert "worse than predicting no change" in sentence
