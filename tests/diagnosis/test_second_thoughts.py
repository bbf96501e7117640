"""Which of two sure effects comes first while much is missing, and two effects that are together a third."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.fit.heldout import error_with, heldout_of
from safedpa.diagnosis.fit.shooting import shooting_of
from safedpa.diagnosis.fit.trial import tried
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.judgement import Stage, farthest
from safedpa.diagnosis.search.progress import Judged
from safedpa.diagnosis.search.revision import united
from safedpa.diagnosis.search.search import accept
from safedpa.effects import effect
from safedpa.records.run import Run


def ordered(before, **after):
    """Names in the order in which they are asked, the first the best in the windows."""
    trials = [SimpleNamespace(effects=(name,)) for name in after]
    errors = {(name,): SimpleNamespace(value=value) for name, value in after.items()}
    stage = Stage(0, trials, {}, errors)
    return [trial.effects[0] for trial in farthest(trials, stage, SimpleNamespace(value=before))]


def test_while_much_is_missing_what_takes_off_far_more_comes_first():
    assert ordered(0.6, understeer=0.52, steering_gain=0.5, viscous_drag=0.36) == [
        "viscous_drag", "understeer", "steering_gain",
    ]  # fmt: skip


def test_a_little_more_off_the_error_changes_nothing():
    assert ordered(0.6, understeer=0.52, viscous_drag=0.45) == ["understeer", "viscous_drag"]


def test_where_little_is_missing_the_windows_decide():
    assert ordered(0.2, understeer=0.18, viscous_drag=0.1) == ["understeer", "viscous_drag"]
    assert ordered(0.6) == []


@pytest.fixture
def searching(plain, with_effect, drive):
    """searching(hidden effect, its numbers, accepted names) -> (search, held-out windows) on a car's noisy runs."""

    def made(name, numbers, names):
        truth = with_effect(plain, name, **numbers)
        runs = [noisy(drive(truth, 20.0, seed, name=str(seed)), seed) for seed in range(4)]
        shooting, heldout = shooting_of(runs, 1.0), heldout_of(runs, 1.0)
        search = begun(plain, shooting, heldout)
        pair = tried(search.current, [effect("car", item) for item in names], search.shooting)
        alone = tried(search.current, [effect("car", "towed_load")], search.shooting)
        gained = error_with(pair.fit, shooting, heldout)
        search.candidates = [
            Judged(0, pair, 9.0, gained, "accepted", "gain", ()),
            Judged(0, alone, 9.0, None, "rejected", "gain", ()),
        ]
        search.rivals = {names[0]: ["towed_load"]}
        accept(search, pair, heldout)
        return search, heldout

    return made


def noisy(run, seed):
    random = np.random.default_rng(seed)
    states = run.states + random.normal(0.0, [0.002, 0.002, 0.003, 0.015], run.states.shape)
    return Run(run.name, run.system, run.t, states, run.actions, run.stretches)


def test_a_payload_and_a_rolling_resistance_are_a_towed_load(searching):
    search, heldout = searching(
        "towed_load", {"mass_ratio": 0.5, "deceleration": 0.6}, ["rolling_resistance", "payload"]
    )
    before = search.error.value
    assert united(search, [effect("car", n) for n in ("rolling_resistance", "payload", "towed_load")], heldout)
    assert search.added == ["towed_load"]
    assert search.error.value <= 1.002 * before
    ratio = search.current.fit.model.settings["towed_load.mass_ratio"].value
    assert ratio == pytest.approx(0.5, rel=0.1)
    accepted = [item.trial.name for item in search.candidates if item.decision == "accepted"]
    assert accepted == ["towed_load"]


def test_two_effects_that_no_third_equals_stay(searching):
    search, heldout = searching("turning_drag", {"coefficient": 2.0}, ["turning_drag", "steering_lag"])
    assert not united(search, [effect("car", n) for n in ("turning_drag", "steering_lag", "towed_load")], heldout)
    assert search.added == ["turning_drag", "steering_lag"]
