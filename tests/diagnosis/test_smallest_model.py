"""Lateness that a log cannot show, and a towed chair that is found with nothing that is not there."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.compare.actuators import late_commands
from safedpa.diagnosis.fit.heldout import error_with, heldout_of
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.shooting import shooting_of
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.final_numbers import between_kinds, with_form_in_doubt
from safedpa.diagnosis.search.judgement import feigned_lateness
from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect


def test_which_commands_an_effect_makes_late():
    def late(robot, name, *names):
        return set(late_commands(effect(robot, name), names))

    assert late("car", "steering_lag", "target_speed", "steer") == {"steer"}
    assert late("car", "actuator_delay", "target_speed", "steer") == {"target_speed", "steer"}
    assert late("car", "drive_delay", "throttle", "steer") == {"throttle"}
    assert late("car", "steering_gain", "target_speed", "steer") == set()
    assert late("car", "quadratic_drag", "target_speed", "steer") == set()
    assert late("pendulum", "torque_lag", "torque") == {"torque"}


@pytest.mark.parametrize(
    ("have", "name", "seconds", "after", "feigned"),
    [
        ({}, "drive_delay", 0.03, 0.095, True),  # less than a row of 0.05 s
        ({}, "drive_delay", 0.03, 0.080, False),  # clearly there
        ({}, "drive_delay", 0.12, 0.095, False),
        ({"steering_lag": 0.1}, "steering_delay", 0.06, 0.095, True),  # late already
        ({"steering_lag": 0.1}, "actuator_delay", 0.06, 0.095, True),
        ({"steering_lag": 0.1}, "actuator_delay", 0.06, 0.080, False),
        ({"steering_lag": 0.1}, "drive_delay", 0.06, 0.095, False),
        ({}, "understeer", 0.02, 0.095, False),
    ],
)
def test_lateness_that_the_servo_or_another_lateness_may_feign(plain, with_effect, have, name, seconds, after, feigned):
    model = plain
    for other, value in have.items():
        model = with_effect(model, other, time_constant=value)
    item = effect("car", name)
    model = model.with_effect(item, {item.parameters[0].name: Setting(seconds)})
    trial = SimpleNamespace(effects=(name,), fit=SimpleNamespace(model=model))
    assert feigned_lateness(trial, SimpleNamespace(value=after), SimpleNamespace(value=0.1), 0.05) is feigned


@pytest.fixture(scope="module")
def towing(tmp_path_factory):
    """The pymunk car with a chair, driven for 6 runs of 40 s."""
    from safedpa.records import load_run
    from safedpa_lab.hidden import cases_of, write_case

    log = write_case(cases_of("towing", 1, seed=52)[0], tmp_path_factory.mktemp("towing"))
    model = load_model(str(log.model))
    return log, model, [load_run(str(path), model.system) for path in log.runs]


@pytest.mark.long
def test_doubt_whether_an_effect_acts_is_part_of_the_others_deviation(towing):
    """A load's mass moves by several of its deviations with a lag of the drive that takes hardly anything off."""
    _, model, runs = towing
    shooting, heldout = shooting_of(runs, 1.0), heldout_of(runs, 1.0)

    def fitted(*names):
        made = model
        for name in names:
            made = made.with_effect(
                effect("car", name), {p.name: Setting(p.typical) for p in effect("car", name).parameters}
            )
        own = shooting.around(made)
        paths = [path for path in made.settings if path.split(".")[0] in names]
        return fit(made, paths, own, np.full(4, 0.02))

    search = begun(model, shooting, heldout)
    less, full = fitted("towed_load"), fitted("towed_load", "drive_lag")
    search.current = SimpleNamespace(fit=full)
    search.error = error_with(full, search.shooting, heldout)
    near, clear = search.error, SimpleNamespace(value=2.0 * search.error.value)
    number = full.paths.index("towed_load.mass_ratio")
    apart = abs(full.values[number] - less.values[less.paths.index("towed_load.mass_ratio")])
    own = max(full.deviations(search.shooting)[number], between_kinds(full, search.shooting)[number])
    for error, expected in ((near, np.hypot(own, 0.5 * apart)), (clear, own)):
        search.without = {"drive_lag": (SimpleNamespace(fit=less), error)}
        assert with_form_in_doubt(full, search).deviations(search.shooting)[number] == pytest.approx(expected)
    assert apart > full.deviations(search.shooting)[number]


@pytest.mark.long
def test_a_towed_chair_is_found_with_its_mass_and_nothing_that_is_not_there(towing):
    """No number appears twice in the report with different values."""
    import json

    from safedpa.diagnosis.diagnose import diagnose
    from safedpa.diagnosis.document import as_document
    from safedpa_lab.hidden.judge import judged

    log, model, runs = towing
    report = diagnose(model, runs)
    document = as_document(report)
    outcome = judged("towing", document, json.loads(log.truth.read_text(encoding="utf-8")), None, 0.0)
    assert outcome.first_named
    assert outcome.wrong == ()
    assert max(abs(value) for value in outcome.deviations) < 2.0
    for item in report.candidates:
        if item.decision == "accepted" and set(item.effect.split(" + ")) <= set(report.added):
            for key, value in item.parameters.items():
                assert value == report.parameters[key if "." in key else f"{item.effect}.{key}"]
            assert item.heldout_error in [stage.heldout_error for stage in report.stages]
