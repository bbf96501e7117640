"""What no effect of the library explains is a place or a formula near the truth, not another effect."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.document import as_document
from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.records.run import Run, Stretch
from safedpa.report.diagnosis_page import report_page
from safedpa.robots.car.kinematic_bicycle import KinematicBicycle
from safedpa_lab.hidden.excitation import car_commands

WHEELBASE, GAIN, LIMIT = 0.32, 3.0, 6.0
NOISE = (0.002, 0.002, 0.003, 0.015)


def given():
    return PhysicsModel(
        KinematicBicycle("speed_servo"),
        [],
        {
            "base.wheelbase": Setting(WHEELBASE),
            "base.speed_gain": Setting(GAIN),
            "base.acceleration_limit": Setting(LIMIT),
        },
    )


def driven(extra, seed, seconds=40.0, period=0.05):
    """A car simulated in steps of 5 ms with extra(state, action) added to its rates, measured with noise."""
    random = np.random.default_rng(seed)
    rows = round(seconds / period)
    commands = car_commands(random, rows, period, 0.35)
    state = np.array([*random.uniform(-2, 2, 2), random.uniform(-3, 3), 0.5])
    states, actions = [], []
    for row in range(rows):
        action = np.array([commands.drive[row], homeward(state, commands.steer[row])])
        states.append(state)
        actions.append(action)
        for _ in range(10):
            first = rates(state, action) + extra(state, action)
            ahead = state + 0.1 * period * first
            state = state + 0.05 * period * (first + rates(ahead, action) + extra(ahead, action))
    measured = np.array(states) + random.normal(0.0, 1.0, (rows, 4)) * NOISE
    return Run(f"run{seed}", given().system, period * np.arange(rows), measured, np.array(actions), (Stretch(0, rows),))


def homeward(state, steer):
    home = np.arctan2(-state[1], -state[0]) - state[2]
    home = np.arctan2(np.sin(home), np.cos(home))
    away = np.hypot(state[0], state[1]) > 4.0 and abs(home) > 0.6 and state[3] > 0
    return np.clip(1.5 * home, -0.35, 0.35) if away else steer


def rates(state, action):
    servo = np.clip(GAIN * (action[0] - state[3]), -LIMIT, LIMIT)
    turn = state[3] * np.tan(action[1]) / WHEELBASE
    return np.array([state[3] * np.cos(state[2]), state[3] * np.sin(state[2]), turn, servo])


def on_speed(value):
    return np.array([0.0, 0.0, 0.0, value])


FEW = ("quadratic_drag", "viscous_drag", "rolling_resistance", "steering_offset", "steering_gain", "understeer")


def report_of(extra, seed):
    """A diagnosis by the effects that come nearest: the others take time and change nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in FEW])
        return diagnose(given(), [driven(extra, seed + run, 25.0) for run in range(4)])


@pytest.fixture(scope="module")
def cube():
    return report_of(lambda state, _: on_speed(-0.1 * state[3] ** 3), 300)


@pytest.fixture(scope="module")
def strip():
    def rough(state, _):
        across = state[0] * np.cos(0.5) + state[1] * np.sin(0.5)
        return on_speed(-1.0 * np.tanh(state[3] / 0.05) * (abs(across - 0.5) < 0.5))

    return report_of(rough, 400)


@pytest.mark.long
def test_drag_by_the_cube_of_the_speed_is_a_formula_and_no_quadratic_drag(cube):
    assert cube.verdict == "unexplained"
    assert cube.added == ()
    assert cube.unexplained.kind == "formula"
    assert cube.unexplained.depends_on == ("speed",)
    (term,) = cube.unexplained.terms
    assert (term.state, term.term) == ("speed", "speed^3")
    assert abs(term.coefficient + 0.1) < 4.0 * term.std
    assert term.std < 0.01
    assert term.unit == "m/s2 / (m/s)^3"
    assert any(item.decision == "suspected" and "formula" in item.reason for item in cube.candidates)


@pytest.mark.long
def test_yaw_that_drifts_with_the_square_of_the_speed_is_no_steering_offset():
    report = report_of(lambda state, _: np.array([0.0, 0.0, 0.08 * state[3] ** 2, 0.0]), 500)
    assert report.verdict == "unexplained"
    (term,) = report.unexplained.terms
    assert (term.state, term.term) == ("yaw", "speed^2")
    assert abs(term.coefficient - 0.08) < 0.004


@pytest.mark.long
def test_a_strip_of_rough_floor_is_rolling_resistance_there(strip):
    assert strip.verdict == "effect_missing"
    assert strip.added == ("rolling_resistance",)
    assert [item.words for item in strip.conditions] == ["strip"]
    numbers = {path.split(".")[1]: value.value for path, value in strip.parameters.items()}
    assert abs(numbers["deceleration"] - 1.0) < 0.15
    # the strip's normal and offset, whichever of its two directions was found
    sign = np.sign(np.cos(numbers["angle"]))
    along = [sign * np.cos(numbers["angle"]), sign * np.sin(numbers["angle"])]
    assert np.allclose(along, [np.cos(0.5), np.sin(0.5)], atol=0.06)
    assert abs(abs(numbers["offset"]) - 0.5) < 0.1
    assert abs(numbers["half_width"] - 0.5) < 0.1


@pytest.mark.long
def test_the_report_and_the_page_show_the_formula_its_map_and_that_it_is_no_effect(cube):
    document = json.loads(json.dumps(as_document(cube), allow_nan=False))
    assert document["unexplained"]["terms"][0]["term"] == "speed^3"
    assert document["unexplained"]["dependence"][0]["variable"] == "speed"
    assert len(document["unexplained"]["map"]["means"]) == len(document["unexplained"]["map"]["up_edges"]) - 1
    run = driven(lambda *_: np.zeros(4), 1, 20.0)
    page = report_page(document, [run], cube.models, "cube")
    assert "It is a formula that fits, not a physical effect with a name" in page
    assert '"id":"unexplained"' in page
    assert "fitted, straight between" in page


@pytest.mark.long
def test_a_resonance_is_a_dependence_with_its_profile():
    report = report_of(lambda state, _: on_speed(-0.8 * np.exp(-(((state[3] - 1.2) / 0.2) ** 2))), 900)
    rest = report.unexplained
    assert report.verdict == "unexplained"
    assert (rest.kind, rest.depends_on[0]) == ("dependence", "speed")
    lowest = int(np.argmin(rest.profile.values))
    assert abs(rest.profile.knots[lowest] - 1.2) < 0.2
    assert -1.0 < rest.profile.values[lowest] < -0.4
    assert "no short formula" in rest.expression


def test_nothing_hidden_leaves_nothing_unexplained():
    report = report_of(lambda *_: np.zeros(4), 600)
    assert report.verdict == "nothing_missing"
    assert report.unexplained is None
