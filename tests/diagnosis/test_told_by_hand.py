"""What a report tells of candidates, places and formulas: searches are made up, and each number is told apart."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis import diagnose, stepwise
from safedpa.diagnosis.document import Unexplained, Value
from safedpa.diagnosis.remains import remaining
from safedpa.diagnosis.remains.weak_form import Selected
from safedpa.diagnosis.search import closest, patch, second_opinion
from safedpa.diagnosis.search import search as searching
from safedpa.errors import InputError

NUMBERS = {
    "base.gain": Value(3.0, 0.1, "1"),
    "drag.coefficient": Value(0.2, 0.01, "1/m"),
    "drag.power": Value(2.0, 0.2, "1"),
    "lag.seconds": Value(0.1, 0.02, "s"),
}


def judged(*effects: str, decision: str = "rejected", error: float | None = 0.5, stage: int = 0) -> Any:
    fit = SimpleNamespace(paths=tuple(NUMBERS), model=None)
    own = SimpleNamespace(effects=effects, name=" + ".join(effects), fit=fit)
    told = None if error is None else SimpleNamespace(value=error)
    return SimpleNamespace(
        trial=own, stage=stage, error=told, gain=4.0, equals=("wind",), decision=decision, reason="because"
    )


@pytest.fixture
def numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnose, "values_of", lambda *_: NUMBERS)


@pytest.mark.usefixtures("numbers")
def test_a_candidate_has_its_own_numbers_and_no_others() -> None:
    search: Any = SimpleNamespace(shooting=None)
    alone = diagnose.candidate_of(judged("drag", stage=2), search)
    assert alone.parameters == {"coefficient": NUMBERS["drag.coefficient"], "power": NUMBERS["drag.power"]}
    assert (alone.effect, alone.stage, alone.heldout_error, alone.score) == ("drag", 2, 0.5, 4.0)
    assert (alone.indistinguishable_from, alone.decision, alone.reason) == (("wind",), "rejected", "because")
    pair = diagnose.candidate_of(judged("drag", "lag", error=None), search)
    assert pair.parameters == {path: value for path, value in NUMBERS.items() if path != "base.gain"}
    assert pair.heldout_error is None


@pytest.mark.usefixtures("numbers")
@pytest.mark.parametrize("elsewhere", [True, False])
def test_final_numbers_are_those_of_what_was_accepted_and_stayed(
    elsewhere: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was rejected once and is in the model, or was accepted and taken out, keeps what was said of it then."""
    monkeypatch.setattr(diagnose, "error_with", lambda *_: SimpleNamespace(value=0.9))
    final = {path: replace(value, value=10.0 * value.value) for path, value in NUMBERS.items()}
    stages = [SimpleNamespace(effects=(), heldout_error=1.0), SimpleNamespace(effects=("drag",), heldout_error=0.1)]
    told: Any = SimpleNamespace(stages=stages)
    candidates = [judged("drag", decision="accepted"), judged("drag"), judged("lag", decision="accepted"),
                  judged("lag", error=None)]  # fmt: skip
    search: Any = SimpleNamespace(candidates=candidates, added=["drag"], shooting=None)
    heldout: Any = object()
    shown: Any = object() if elsewhere else heldout
    stayed, before, gone, untried = diagnose._candidates(search, heldout, shown, told, final)
    assert stayed.heldout_error == 0.1
    assert stayed.parameters["coefficient"].value == pytest.approx(2.0)
    assert before.heldout_error == gone.heldout_error == (0.9 if elsewhere else 0.5)
    assert before.parameters["coefficient"].value == 0.2
    assert gone.parameters["seconds"].value == 0.1
    assert untried.heldout_error is None


def test_of_an_effect_that_may_be_missing_its_own_numbers_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        closest, "telling_manoeuvres", lambda _, models, __: [f"drive {at}" for at, _ in enumerate(models)]
    )
    items: list[Any] = []
    for effects in (("drag",), ("drag", "lag")):
        one = judged(*effects)
        one.fall = 0.2
        items.append(one)
    search: Any = SimpleNamespace(current=SimpleNamespace(fit=SimpleNamespace(model=None)))
    sizes: list[Any] = [
        SimpleNamespace(effect="drag", parameter="coefficient", smallest=0.05, unit="1/m"),
        SimpleNamespace(effect="drag", parameter="power", smallest=None, unit="1"),
        SimpleNamespace(effect="wind", parameter="ax", smallest=0.3, unit="m/s2"),
    ]
    noise: Any = None
    first, second = closest.closest_effects(items, search, [NUMBERS, NUMBERS], sizes, noise)
    assert set(first.parameters) == {"drag.coefficient", "drag.power"}
    assert set(second.parameters) == {"drag.coefficient", "drag.power", "lag.seconds"}
    for one in (first, second):
        assert one.smallest_detectable == {"drag.coefficient": Value(0.05, None, "1/m")}
    assert [one.drive for one in (first, second)] == ["drive 0", "drive 1"]


@pytest.mark.parametrize(
    ("gain", "loss", "most_runs", "kept"),
    [(9.0, -2.0, True, True), (0.5, -2.0, True, False), (9.0, -1.0, True, False), (9.0, -2.0, False, False)],
)
def test_a_place_is_told_where_unseen_blocks_the_error_and_most_runs_confirm_it(
    gain: float, loss: float, kept: bool, monkeypatch: pytest.MonkeyPatch, *, most_runs: bool
) -> None:
    found = SimpleNamespace(gain=gain, trial=SimpleNamespace(loss=loss))
    monkeypatch.setattr(patch, "in_one_room", lambda _: True)
    monkeypatch.setattr(patch, "pushes_of", lambda *_: np.zeros((40, 1)))
    monkeypatch.setattr(patch, "_start", lambda *_: {"x": 0.0})
    monkeypatch.setattr(patch, "_fitted", lambda *_: found)
    monkeypatch.setattr(patch, "_in_most_runs", lambda *_: most_runs)
    system = SimpleNamespace(name="car", state_names=("x", "y", "yaw", "speed"))
    windows = type("Windows", (), {"system": system, "__len__": lambda _: 40})()
    shooting: Any = SimpleNamespace(windows=windows, measured=np.zeros((40, 5, 4)))
    null: Any = SimpleNamespace(loss=-1.0)
    assert patch.best_patch(null, shooting) is (found if kept else None)


@pytest.mark.parametrize(
    ("first", "second", "terms"),
    [
        ([1.0, 2.0, 3.0], None, ["a", "b", "c"]),
        ([1.0, 0.001, 3.0], [1.5, 3.5], ["a", "c"]),
        ([0.001, 2.0, 3.0], [2.5, 3.5], ["b", "c"]),
        ([0.001, 0.001, 0.001], None, None),
    ],
)
def test_terms_that_do_not_hold_in_the_rollouts_go_and_the_rest_is_fitted_anew(
    first: list[float], second: list[float] | None, terms: list[str] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Deviations are 0.1 each: a number of 0.001 is none, those of 1 and more are sure by any measure."""
    asked: list[Selected] = []

    def fitted(selected: Selected, *_: Any) -> Any:
        asked.append(selected)
        values = np.array([9.0, *(first if len(asked) == 1 else second or [])])
        return SimpleNamespace(
            fit=SimpleNamespace(values=values, deviations=lambda _: np.full(len(values), 0.1)), loss=-2.0
        )

    begun: Any = Selected(("a", "b", "c"), np.array([1.0, 2.0, 3.0]), ())  # type: ignore[arg-type]
    monkeypatch.setattr(remaining, "selected_terms", lambda *_: begun)
    monkeypatch.setattr(remaining, "rate_states", lambda _: None)
    monkeypatch.setattr(remaining, "_fitted", fitted)
    trial: Any = SimpleNamespace(loss=-1.0)
    shooting: Any = SimpleNamespace(windows=SimpleNamespace(system=None))
    found = remaining._formula(trial, shooting)
    if terms is None:
        assert found is None
        return
    assert found is not None
    assert list(found[0].terms) == terms
    assert len(asked) == (1 if second is None else 2)
    if second is not None:
        assert asked[1].coefficients.tolist() == [value for value in first if value >= 1.0]


def test_only_free_numbers_with_a_value_at_which_they_do_nothing_are_judged_by_the_filter() -> None:
    paths = ("drag.coefficient", "drag.power", "drag.stuck", "lag.seconds")
    neutral = {"drag.coefficient": 0.0, "drag.power": None, "drag.stuck": 0.0, "lag.seconds": 0.1}
    settings = {path: SimpleNamespace(value=value) for path, value in zip(paths, (0.4, 2.0, 1.0, 0.3), strict=True)}
    filtered = {path: SimpleNamespace(value=value) for path, value in zip(paths, (0.2, 2.0, 1.0, 0.5), strict=True)}
    model = SimpleNamespace(settings=filtered, parameters={p: SimpleNamespace(neutral=n) for p, n in neutral.items()})
    trial: Any = SimpleNamespace(fit=SimpleNamespace(model=SimpleNamespace(settings=settings)))
    found: Any = SimpleNamespace(paths=paths, deviations=np.array([0.05, 0.1, 0.0, 0.02]), model=model)
    drag = second_opinion._numbers("drag", trial, found)
    assert drag is not None
    assert drag.away == pytest.approx([4.0]), "0.2 of 0.05"
    lag = second_opinion._numbers("lag", trial, found)
    assert lag is not None
    assert lag.away == pytest.approx([20.0]), "0.5 less 0.1, of 0.02"
    assert second_opinion._numbers("wind", trial, found) is None


@pytest.mark.parametrize(
    ("library", "passes", "asked", "rest"),
    [((), True, False, "rest"), (("drag",), True, True, None), (("drag",), False, True, "rest")],
)
def test_the_rest_is_a_formula_where_no_effect_of_the_library_passes(
    library: tuple[str, ...], rest: Any, monkeypatch: pytest.MonkeyPatch, *, passes: bool, asked: bool
) -> None:
    """Where the model has every effect already, nothing is left to be tried."""
    search: Any = SimpleNamespace(candidates=[], current=None, shooting=None, added=[], patch=None)
    did: list[Any] = []
    monkeypatch.setattr(stepwise, "_copied", lambda _: SimpleNamespace(**vars(search)))
    monkeypatch.setattr(stepwise, "library_for", lambda _: library)
    monkeypatch.setattr(stepwise, "tried_in_turn", lambda *_: [])
    monkeypatch.setattr(stepwise, "addition", lambda *given: did.append(given) or passes)
    monkeypatch.setattr(stepwise, "remaining", lambda *_: "rest")
    monkeypatch.setattr(stepwise, "experiment_for", lambda _: None)
    step: Any = SimpleNamespace(why_not="", search=search, model=None, heldout=None)
    found = stepwise.proposal(step)
    assert bool(did) is asked
    assert found.unexplained == rest


def test_a_person_adds_the_candidate_that_he_names(monkeypatch: pytest.MonkeyPatch) -> None:
    items = [judged("drag"), judged("lag")]
    proposed: Any = SimpleNamespace(search=SimpleNamespace(candidates=items))
    taken: list[Any] = []
    monkeypatch.setattr(stepwise, "accept", lambda _search, trial, _heldout: taken.append(trial))
    nobody: Any = SimpleNamespace(search=None)
    with pytest.raises(InputError, match="effect 'lagg': not among the candidates"):
        stepwise.with_candidate(nobody, proposed, "lagg")
    monkeypatch.setattr(stepwise, "_copied", lambda _: None)
    monkeypatch.setattr(stepwise, "replace", lambda one, **_: one)
    monkeypatch.setattr(stepwise, "_settle", lambda *_: None)
    monkeypatch.setattr(stepwise, "_improved", lambda *_: "")
    step: Any = SimpleNamespace(search=None, heldout=None, error=None)
    stepwise.with_candidate(step, proposed, "lag")
    assert taken == [items[1].trial]


@pytest.mark.parametrize(("enough", "wrong"), [(True, False), (False, True), (False, False)])
def test_of_data_that_allow_no_verdict_nothing_is_explained(
    monkeypatch: pytest.MonkeyPatch, *, enough: bool, wrong: bool
) -> None:
    """Where they are only too few, what would be nearest is told; where they are wrong, that as well would be."""
    monkeypatch.setattr(diagnose, "formula_instead", lambda *_: None)
    monkeypatch.setattr(diagnose, "remaining", lambda *_: "a formula")
    monkeypatch.setattr(diagnose, "likely_effects", lambda _: [judged("drag"), judged("lag")])
    monkeypatch.setattr(diagnose, "nearest_effects", lambda *_: ["nearest"])
    search: Any = SimpleNamespace(current=None, shooting=None, patch=None)
    judge: Any = SimpleNamespace(enough=enough, wrong=wrong, why_not="too little data")
    names: Any = SimpleNamespace(library=[], heldout=None, found=[judged("lag")])
    rest: Any = diagnose._rest_of(search, judge, names)
    if enough:
        assert rest.unexplained == "a formula"
        assert [item.trial.effects for item in rest.likely] == [("lag",), ("drag",)], "each is named once"
        return
    assert rest.unexplained == Unexplained((), "too little data", 0.0)
    assert rest.likely == ([] if wrong else ["nearest"])


@pytest.mark.parametrize(("library", "laws", "rounds"), [((), True, 1), (("drag",), False, 1), (("drag",), True, 2)])
def test_after_a_law_the_search_goes_round_once_more(
    library: tuple[str, ...], rounds: int, monkeypatch: pytest.MonkeyPatch, *, laws: bool
) -> None:
    """A law may lay bare what it hid; without a library there is nothing to give a law to."""
    did: list[str] = []
    search = SimpleNamespace(
        added=[], error=SimpleNamespace(value=0.1), current=SimpleNamespace(fit=None), shooting=None
    )
    monkeypatch.setattr(searching, "begun", lambda *_: search)
    monkeypatch.setattr(searching, "_so_far", lambda _: "")
    monkeypatch.setattr(searching, "_additions", lambda *_: did.append("additions"))
    monkeypatch.setattr(searching, "_second_thoughts", lambda *_: did.append("second thoughts"))
    monkeypatch.setattr(searching, "conditional", lambda *_: did.append("laws") or laws)
    monkeypatch.setattr(searching, "with_final_numbers", lambda *_: ("final", "its error"))
    monkeypatch.setattr(searching, "with_form_in_doubt", lambda final, _: final)
    monkeypatch.setattr(searching, "replace", lambda _, fit: fit)
    nobody: Any = None
    found: Any = searching.searched(nobody, library, nobody, nobody)  # type: ignore[arg-type]
    assert found.current == "final" or not library
    once = ["additions", "second thoughts"]
    assert did == [*once, *(["laws"] if library else []), *(once if rounds == 2 else [])]
