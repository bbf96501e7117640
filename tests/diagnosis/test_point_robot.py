"""The point robot: compared, diagnosed, and each of its effects recovered from logs with noise."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose, library_for
from safedpa.diagnosis.fit.heldout import heldout_of
from safedpa.diagnosis.fit.shooting import shooting_of
from safedpa.diagnosis.fit.trial import tried
from safedpa.diagnosis.search.search import searched
from safedpa.dynamics import load_model
from safedpa.records.run import Run, Stretch
from safedpa.records.write import write_columns
from safedpa_services.command_line.group import safedpa

NOISE = np.array([0.001, 0.001, 0.002, 0.005, 0.005])
HIDDEN = {
    "constant_force": {"ax": 0.3, "ay": -0.2},
    "viscous_drag": {"coefficient": 0.6},
    "quadratic_drag": {"coefficient": 0.5},
    "payload": {"mass_ratio": 0.4},
    "actuator_gain": {"gain": 0.8},
    "actuator_delay": {"seconds": 0.1},
}


def driven(hidden, seed, seconds=20.0, period=0.02, substeps=4):
    """The robot simulated in steps of 5 ms, with steps of thrust and turn, measured with noise."""
    random = np.random.default_rng(seed)
    rows, mass = round(seconds / period), 0.005189
    hold = round(0.5 / period)
    thrust = np.repeat(random.uniform(-0.006, 0.008, -(-rows // hold)), hold)[:rows]
    turn = np.repeat(random.uniform(-2.0, 2.0, -(-rows // hold)), hold)[:rows]
    value = lambda name, key, neutral=0.0: hidden.get(name, {}).get(key, neutral)  # noqa: E731
    late = round(value("actuator_delay", "seconds") / period)
    x, y, yaw, vx, vy = random.uniform(-0.5, 0.5, 5)
    states = []
    for row in range(rows):
        states.append((x, y, yaw, vx, vy))
        sent = max(row - late, 0)
        push = value("actuator_gain", "gain", 1.0) * thrust[sent] / mass
        for _ in range(substeps):
            step = period / substeps
            drag = value("viscous_drag", "coefficient") + value("quadratic_drag", "coefficient") * np.hypot(vx, vy)
            middle = yaw + 0.5 * step * turn[sent]
            own = 1.0 + value("payload", "mass_ratio")
            ax = (push * np.cos(middle) + value("constant_force", "ax") - drag * vx) / own
            ay = (push * np.sin(middle) + value("constant_force", "ay") - drag * vy) / own
            x, y = x + step * (vx + 0.5 * step * ax), y + step * (vy + 0.5 * step * ay)
            vx, vy, yaw = vx + step * ax, vy + step * ay, yaw + step * turn[sent]
    model = load_model("point")
    measured = np.array(states) + random.normal(0.0, 1.0, (rows, 5)) * NOISE
    actions = np.column_stack([thrust, turn])
    return Run(f"run{seed}", model.system, period * np.arange(rows), measured, actions, (Stretch(0, rows),))


@pytest.mark.parametrize("name", HIDDEN)
def test_each_hidden_effect_fits_best_and_with_its_size(name):
    given = load_model("point")
    runs = [driven({name: HIDDEN[name]}, seed, 12.0) for seed in (11, 12)]
    search = searched(given, [], shooting_of(runs, 0.5), heldout_of(runs, 0.5))
    trials = [tried(search.current, [item], search.shooting) for item in library_for(given)]
    best = min(trials, key=lambda trial: trial.loss)
    # thrust / mass: a heavier robot and a weaker thruster are one and the same
    same = {"payload", "actuator_gain"}
    assert best.effects[0] in (same if name in same else {name})
    (own,) = (trial for trial in trials if trial.effects == (name,))
    assert own.loss < search.current.loss - 0.02
    for key, true in HIDDEN[name].items():
        assert abs(own.fit.model.settings[f"{name}.{key}"].value - true) < 0.25 * abs(true)


@pytest.mark.long
def test_a_damped_robot_is_diagnosed_whole():
    report = diagnose(load_model("point"), [driven({"viscous_drag": {"coefficient": 0.6}}, s, 12.0) for s in (11, 12)])
    assert report.added == ("viscous_drag",)
    assert abs(report.parameters["viscous_drag.coefficient"].value - 0.6) < 0.02


@pytest.mark.long
def test_the_commands_take_it(tmp_path, capsys):
    run = driven({"viscous_drag": {"coefficient": 0.6}}, 31)
    names = ("t", *run.system.state_names, *run.system.action_names)
    table = dict(zip(names, np.column_stack([run.t, run.states, run.actions]).T, strict=True))
    path = tmp_path / "run.csv"
    write_columns(table, path, "csv")
    assert safedpa.run(["compare", "point", str(path), "--out", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["robot"] == "point"
    out = tmp_path / "damped.toml"
    assert safedpa.run(["add", "point", "viscous_drag", str(path), "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["after"] < 0.2 * document["before"]
    f, g = load_model(out).affine(np.zeros(5))
    assert np.allclose(f, 0.0)
    assert g.shape == (5, 2)
