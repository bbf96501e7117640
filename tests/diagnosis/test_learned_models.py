"""Learned models: a neural base, an effect that it lacks, and what drives with the result."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.dynamics import LearnedBase, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.policy import PolicyNode
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import settings_named
from safedpa_lab.hidden.excitation import car_commands
from safedpa_services.command_line.group import safedpa
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots import CarRobot
from safedpa_sim.robots.scene import Scene

pytestmark = [pytest.mark.long, pytest.mark.slow]

DRAG = 0.15
NOISE = np.array([0.002, 0.002, 0.003, 0.015])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two drives of the learned car with drag added to its networks, as files."""
    true = load_model("car_learned").with_effect(effect("car", "quadratic_drag"), {"coefficient": Setting(DRAG)})
    paths = []
    for run in range(2):
        random, rows = np.random.default_rng([1, run]), 400
        commands = car_commands(random, rows, true.period, 0.34)
        actions = np.stack([commands.drive, commands.steer], axis=1)
        states = np.zeros((rows, 4))
        states[0] = (0.0, 0.0, random.uniform(-3.0, 3.0), 0.5)
        for row in range(rows - 1):
            states[row + 1], _ = true.advance(states[row], actions[row], ())
        measured = states + NOISE * random.standard_normal(states.shape)
        table = np.column_stack([true.period * np.arange(rows), measured, actions])
        paths.append(str(tmp_path_factory.mktemp("learned") / f"run_{run}.csv"))
        names = ("t", *true.system.state_names, *true.system.action_names)
        np.savetxt(paths[-1], table, delimiter=",", header=",".join(names), comments="")
    return paths


@pytest.fixture(scope="module")
def diagnosed(runs, tmp_path_factory):
    """(report, folder) of ``safedpa diagnose`` with a library of two."""
    folder = tmp_path_factory.mktemp("found")
    names = ("quadratic_drag", "steering_offset")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])
        assert safedpa.run(["diagnose", "car_learned", *runs, "--out", str(folder), "--json"]) == 0
    return json.loads((folder / "report.json").read_text(encoding="utf-8")), folder


def test_the_effect_on_top_of_the_networks_is_found(diagnosed):
    report, _ = diagnosed
    assert report["added"] == ["quadratic_drag"]
    value = report["parameters"]["quadratic_drag.coefficient"]
    assert abs(value["value"] - DRAG) < max(4.0 * value["std"], 0.005)
    assert report["stages"][1]["heldout_error"] < 0.6 * report["stages"][0]["heldout_error"]


def test_model_weights_and_margin_belong_together(diagnosed):
    _, folder = diagnosed
    model = load_model(folder / "model.toml")
    assert isinstance(model.base, LearnedBase)
    assert [item.name for item in model.effects] == ["quadratic_drag"]
    margin = MarginCalibration.load(folder / "margin.toml")
    assert margin.fingerprint == fingerprint(model) != fingerprint(load_model("car_learned"))
    assert 0.0 < margin.epsilon["obstacle"] < 0.2


def test_the_loop_drives_with_what_was_diagnosed(diagnosed):
    _, folder = diagnosed
    model, margin = load_model(folder / "model.toml"), MarginCalibration.load(folder / "margin.toml")
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("car"), margin)]
    robot = CarRobot(Scene.random(1, "none"), model.period)
    ticks = list(drive(robot, nodes, 60))
    assert {tick.verdict.status for tick in ticks} <= {"passed", "corrected"}
    assert robot.collisions == []


def test_add_takes_a_learned_model(runs, tmp_path, capsys):
    out = tmp_path / "model.toml"
    assert safedpa.run(["add", "car_learned", "quadratic_drag", *runs, "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["after"] < 0.6 * document["before"]
    assert abs(load_model(out).settings["quadratic_drag.coefficient"].value - DRAG) < 0.01
    assert out.with_suffix(".safetensors").is_file()
