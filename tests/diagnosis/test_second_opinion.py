"""A driver who answers lasting pushes looks like a weak command: the filter along whole recordings refuses it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.search import second_opinion
from safedpa.diagnosis.search.second_opinion import agrees, certain, clear
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case

FEEDBACK = Case("test", 2884420874, {}, drive="throttle", hard=True)
"""Nothing is hidden; unseen blocks alone find a dead zone with 3.6 standard errors and 8 % off the held-out error."""


@pytest.mark.long
def test_an_effect_that_feedback_feigns_is_not_added(tmp_path):
    log = write_case(FEEDBACK, tmp_path / "case")
    model = load_model(str(log.model))
    report = diagnose(model, [load_run(str(path), model.system) for path in log.runs])
    assert report.verdict == "nothing_missing"
    dead_zone = next(item for item in report.candidates if item.effect == "drive_dead_zone")
    assert dead_zone.score > 3.0
    assert dead_zone.heldout_error < 0.97 * report.stages[0].heldout_error
    assert dead_zone.decision == "suspected"
    assert "pushes" in dead_zone.reason


@pytest.fixture
def opinion(monkeypatch, plain):
    """opinion(name, windows=..., filter=..., std=...) -> (agrees, certain) for one effect with those numbers."""

    def asked(name, windows, filtered, std):
        item = effect("car", name)
        paths = tuple(f"{name}.{p.name}" for p in item.parameters)
        one, other = (
            SimpleNamespace(
                settings={path: SimpleNamespace(value=v) for path, v in zip(paths, values, strict=True)},
                parameters=dict(zip(paths, item.parameters, strict=True)),
            )
            for values in (windows, filtered)
        )
        found = SimpleNamespace(model=other, paths=paths, deviations=np.array(std, dtype=float))
        monkeypatch.setattr(second_opinion, "refined", lambda *_: found)
        trial = SimpleNamespace(effects=(name,), fit=SimpleNamespace(model=one, paths=paths, free=None))
        search = SimpleNamespace(shooting=SimpleNamespace(windows=None))
        return agrees(trial, search), certain(trial, search)

    return asked


@pytest.mark.parametrize(
    ("name", "windows", "filtered", "std", "wanted"),
    [
        ("quadratic_drag", [0.12], [0.12], [0.01], (True, True)),
        ("quadratic_drag", [0.12], [0.08], [0.01], (True, False)),
        ("quadratic_drag", [0.12], [0.04], [0.001], (False, True)),  # sure, but a third of the windows' number
        ("quadratic_drag", [0.12], [0.1], [0.03], (False, False)),  # as large, but it may be nothing
        ("quadratic_drag", [0.12], [0.1], [np.nan], (True, False)),  # at a bound the filter has no opinion
        ("quadratic_drag", [0.5], [0.25], [0.01], (True, True)),  # half of it is left
        ("quadratic_drag", [0.5], [0.2499], [0.01], (False, True)),
        ("quadratic_drag", [0.5], [0.5], [0.125], (False, False)),  # four deviations and no more
        ("quadratic_drag", [0.5], [0.5], [0.1111], (True, False)),
        ("quadratic_drag", [9.0], [9.0], [1.0], (True, False)),  # nine and no more
        ("quadratic_drag", [9.01], [9.01], [1.0], (True, True)), ("quadratic_drag", [0.5], [0.5], [0.0], (True, False)),
        ("quadratic_drag", [0.001], [0.5], [0.05], (True, True)),  # more than windows found, not less
        ("constant_force", [0.4, 0.01], [0.4, -0.01], [0.01, 0.01], (True, False)),  # one of two may be nothing
        ("constant_force", [1.0, 1.0], [1.0, 0.0], [1e-2, 1.0], (True, False)),
        ("constant_force", [1.0, 1.0], [1.0, 0.0], [1.0, 1e-2], (False, False)),
        ("constant_force", [2.0, 1.0], [0.0, 1.0], [0.10, 0.06], (False, False)),  # 278 of 678 are left
        ("constant_force", [2.0, 1.0], [0.0, 1.0], [0.10, 0.04], (True, False)),  # 625 of 1025
        ("payload", [0.5], [0.5], [0.01], (True, True)),
        ("steering_gain", [1.4], [1.1], [0.01], (False, True)),  # a quarter of what it differs from 1
        ("steering_gain", [1.4], [1.3], [0.01], (True, True)),
        ("drive_dead_zone", [0.15], [0.15], [0.001], (True, False)),  # with a corner it is never certain
    ],
)  # fmt: skip
def test_each_number_counts_by_how_well_the_filter_knows_it(opinion, name, windows, filtered, std, wanted):
    """What is left: sum(w f / s^2) / sum(w^2 / s^2), from where the effect does nothing."""
    assert opinion(name, windows, filtered, std) == wanted


@pytest.mark.parametrize(
    ("gain", "after", "before", "decided"),
    [
        (5.0, 0.09, 0.1, False), (9.0, 0.09, 0.1, True), (8.0, None, 0.1, False), (8.001, None, 0.1, True),
        (5.0, 0.08, 0.1, True), (5.0, None, 0.1, False), (0.0, 0.85 * 0.125, 0.125, False), (0.0, 0.10624, 0.125, True),
        (5.0, 0.18, 0.2, False), (0.0, None, 0.25, False), (0.0, None, 0.2501, True), (5.0, 0.38, 0.4, True),
    ],
)  # fmt: skip
def test_blocks_decide_alone_if_they_are_sure_if_the_error_falls_far_or_if_much_is_missing(
    gain, after, before, decided
):
    """While a quarter is missing, the filter takes friction itself for lasting pushes."""
    error = None if after is None else SimpleNamespace(value=after)
    assert clear(gain, error, SimpleNamespace(value=before)) is decided


def test_each_of_several_effects_has_to_last_and_a_short_recording_decides_nothing(monkeypatch):
    items = [effect("car", name) for name in ("quadratic_drag", "understeer")]
    parameters = {f"{item.name}.{p.name}": p for item in items for p in item.parameters}

    def model(*values):
        settings = {path: SimpleNamespace(value=v) for path, v in zip(parameters, values, strict=True)}
        return SimpleNamespace(settings=settings, parameters=parameters)

    fit = SimpleNamespace(model=model(0.5, 0.5), paths=tuple(parameters), free=None)
    trial = SimpleNamespace(effects=("quadratic_drag", "understeer"), fit=fit)
    search = SimpleNamespace(shooting=SimpleNamespace(windows="windows"))
    asked = []

    def answers(found):
        def refined(*arguments):
            asked.append(arguments)
            return found

        monkeypatch.setattr(second_opinion, "refined", refined)
        return agrees(trial, search), certain(trial, search)

    small = np.array([0.01, 0.01])
    assert answers(SimpleNamespace(model=model(0.5, 0.5), paths=tuple(parameters), deviations=small)) == (True, True)
    assert answers(SimpleNamespace(model=model(0.5, 0.1), paths=tuple(parameters), deviations=small)) == (False, True)
    assert answers(SimpleNamespace(model=model(0.1, 0.05), paths=tuple(parameters), deviations=small)) == (False, False)
    assert answers(None) == (True, False), "too short for the filter"
    assert {one[3:] for one in asked} == {("windows", 3)}
