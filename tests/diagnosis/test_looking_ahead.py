"""Where no single step passes and much is missing still: one step further, judged as a whole; and what stays simple."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.fit.evidence import evidence_at
from safedpa.diagnosis.fit.trial import Trial, tried
from safedpa.diagnosis.search import revision, where_none_passes
from safedpa.diagnosis.search import search as additions
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.judgement import plainest
from safedpa.diagnosis.search.progress import Judged, Search
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case

NAMES = ("towed_load", "rolling_resistance", "viscous_drag")


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """(search, trials by effect) of a car with a free gain whose dry friction is hidden."""
    case = Case(
        "test", 4, {"rolling_resistance": {"deceleration": 0.6}}, drive="throttle", hard=True, runs=3, seconds=15
    )
    log = write_case(case, tmp_path_factory.mktemp("free_gain"))
    model = load_model(str(log.model))
    evidence = evidence_at([load_run(str(path), model.system) for path in log.runs], 1.0)
    search = begun(model, evidence.shooting, evidence.heldout)
    return search, {name: tried(search.current, [effect("car", name)], search.shooting) for name in NAMES}


def test_of_two_that_explain_the_very_same_the_one_with_fewer_numbers_is_added(stage):
    """(gain u - m d) / (1 + m) with a free gain is gain u - d."""
    search, trials = stage
    assert plainest(trials["towed_load"], list(trials.values()), search) is trials["rolling_resistance"]


def test_what_explains_something_else_stays_whatever_its_numbers(stage):
    search, trials = stage
    assert (
        plainest(trials["towed_load"], [trials["towed_load"], trials["viscous_drag"]], search) is trials["towed_load"]
    )
    assert plainest(trials["viscous_drag"], list(trials.values()), search) is trials["viscous_drag"]


def error(value):
    return SimpleNamespace(value=value)


@pytest.fixture
def stuck(monkeypatch):
    """stuck(gain, fall, error) -> a search whose last stage left one trial open, with so much missing still."""
    windows = SimpleNamespace(
        names=("one", "two"), period=np.array([0.05]), system=SimpleNamespace(action_names=("throttle", "steer"))
    )
    monkeypatch.setattr(where_none_passes, "feigned_lateness", lambda *_: False)
    monkeypatch.setattr(where_none_passes, "inside", lambda *_: True)
    monkeypatch.setattr(where_none_passes, "plainest", lambda trial, *_: trial)

    def made(gain, fall, missing):
        current = SimpleNamespace(name="before")
        trial = SimpleNamespace(effects=("viscous_drag",), name="viscous_drag")
        search = Search(SimpleNamespace(windows=windows), current, error(missing), current, error(0.8))
        search.candidates = [
            Judged(0, trial, gain, error((1.0 - fall) * missing), "rejected", "too little", (), missing)
        ]
        return search

    return made


@pytest.fixture
def afterwards(monkeypatch):
    """afterwards(error, gain): where the search arrives that goes on from the open trial, and how sure that is."""

    def set_up(reached, gain):
        def accept(search, trial, _heldout):
            search.added += list(trial.effects)

        def in_turn(search, *_):
            if search.added:
                search.error, search.current = error(reached), SimpleNamespace(name="after")

        monkeypatch.setattr(where_none_passes, "accept", accept)
        monkeypatch.setattr(additions, "_added_in_turn", in_turn)
        monkeypatch.setattr(where_none_passes, "known_effects", lambda *_: {})
        monkeypatch.setattr(where_none_passes, "refit", lambda *_: None)
        monkeypatch.setattr(where_none_passes, "block_gain", lambda *_: gain)

    return set_up


@pytest.mark.parametrize(
    ("gain", "fall", "missing", "reached", "sure", "kept"),
    [
        (2.9, 0.05, 0.39, 0.20, 5.0, True),
        (2.9, 0.05, 0.39, 0.35, 5.0, False),  # what followed takes off too little
        (2.9, 0.05, 0.39, 0.20, 2.0, False),  # or blocks are not sure of it all
        (1.2, 0.05, 0.39, 0.20, 5.0, False),  # blocks do not favour the step
        (2.9, 0.01, 0.39, 0.20, 5.0, False),  # it takes nothing off
        (2.9, 0.05, 0.20, 0.10, 5.0, False),  # little is missing: what passes by itself, or nothing
    ],
)
def test_a_step_further_is_kept_if_what_follows_makes_it_good(
    gain, fall, missing, reached, sure, kept, stuck, afterwards
):
    afterwards(reached, sure)
    search = stuck(gain, fall, missing)
    additions._additions(search, [], None, lambda *_: None, lambda: ())
    assert search.added == (["viscous_drag"] if kept else [])
    assert search.error.value == (reached if kept else missing)
    decision = search.candidates[0].decision
    assert decision == ("accepted" if kept else "rejected")


def test_of_one_recording_no_step_further_is_taken(stuck, afterwards):
    """It is unlike no other: what does not pass there is too little to tell."""
    afterwards(0.20, 5.0)
    search = stuck(2.9, 0.05, 0.39)
    search.shooting.windows.names = ("one",)
    additions._additions(search, [], None, lambda *_: None, lambda: ())
    assert (search.added, search.error.value) == ([], 0.39)


def test_a_place_that_explains_more_is_no_reason_to_add_the_effect_that_it_stands_for(stuck, afterwards):
    afterwards(0.20, 5.0)
    search = stuck(2.9, 0.05, 0.39)
    search.patch = "a circle on the floor"
    additions._additions(search, [], None, lambda *_: None, lambda: ())
    assert (search.added, search.error.value) == ([], 0.39)


def test_trials_beside_a_model_that_went_on_since_are_no_step_from_it(stuck, afterwards):
    """They lack what was added: with one of them the present model would lose it."""
    afterwards(0.20, 5.0)
    search = stuck(2.9, 0.05, 0.45)
    search.error = error(0.39)
    additions._additions(search, [], None, lambda *_: None, lambda: ())
    assert (search.added, search.error.value) == ([], 0.39)


def test_an_effect_whose_part_another_takes_over_at_its_bound_is_not_taken_out(monkeypatch):
    """Without the drag the error grows by little, and the turning drag stands at its largest value."""

    def left(_search, items, *_enough):
        free = np.array(["viscous_drag" in {item.name for item in items}])
        return SimpleNamespace(fit=SimpleNamespace(free=free), effects=())

    search = SimpleNamespace(added=["turning_drag", "viscous_drag"], candidates=[], shooting=None, without={})
    search.current = left(None, [SimpleNamespace(name="viscous_drag")])
    search.error = SimpleNamespace(value=0.2, standard_error=0.05, by_run=np.full(3, 0.2))
    library = {name: SimpleNamespace(name=name) for name in search.added}
    monkeypatch.setattr(revision, "refit", left)
    monkeypatch.setattr(revision, "known_effects", lambda *_: library)
    monkeypatch.setattr(revision, "_feigned", lambda *_: False)
    worse = SimpleNamespace(value=0.21, standard_error=0.05, by_run=np.full(3, 0.21))
    much_worse = SimpleNamespace(value=0.4, standard_error=0.05, by_run=np.full(3, 0.4))
    monkeypatch.setattr(revision, "error_with", lambda fit, *_: much_worse if fit.free.all() else worse)
    revision.smallest(search, list(library.values()), None)
    assert search.added == ["turning_drag", "viscous_drag"]


@pytest.mark.parametrize(("fall", "gives_way"), [(0.0, False), (0.0004, False), (0.01, True)])
def test_an_effect_gives_way_to_one_with_more_numbers_only_if_it_fits_better(fall, gives_way, monkeypatch):
    """1000 independent numbers: 0.4 units of log likelihood for one number more are none, 10 are."""
    now = SimpleNamespace(loss=1.0, fit=SimpleNamespace(value=-2.0, paths=("a", "b")))
    model = SimpleNamespace(effects=[SimpleNamespace(name="understeer"), SimpleNamespace(name="towed_load")])
    fit = SimpleNamespace(value=-2.0 - fall, paths=("a", "b", "c"), model=model)
    rival = where_none_passes.replace(Trial((), None, None, None, 0.9), fit=fit)
    search = SimpleNamespace(added=["understeer", "rolling_resistance"], current=now, candidates=[], error=error(0.2))
    search.rivals = {"rolling_resistance": ["towed_load"]}
    search.first = SimpleNamespace(fit=SimpleNamespace(model=SimpleNamespace(effects=[])))
    search.shooting = SimpleNamespace(size=np.array([500.0, 500.0]))
    library = {name: SimpleNamespace(name=name) for name in [*search.added, "towed_load"]}
    monkeypatch.setattr(revision, "known_effects", lambda *_: library)
    monkeypatch.setattr(revision, "refit", lambda *_: rival)
    monkeypatch.setattr(revision, "feigned_lateness", lambda *_: False)
    monkeypatch.setattr(revision, "block_gain", lambda *_: 3.4)
    monkeypatch.setattr(revision, "error_with", lambda *_: error(0.19))
    revision.exchange(search, [], None)
    assert search.added == ["understeer", "towed_load" if gives_way else "rolling_resistance"]
