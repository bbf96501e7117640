"""The course of a search and of what follows it: steps, laws, places, formulas, and which numbers a report gets."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis import diagnose, interactive
from safedpa.diagnosis.report_schema import FittedValue, Unexplained
from safedpa.diagnosis.residuals import unmodelled
from safedpa.diagnosis.residuals.weak_sindy import SelectedTerms
from safedpa.diagnosis.search import conditional, further_trials, regions
from safedpa.diagnosis.search import forward_selection as searching
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState
from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect, effects_of
from safedpa.errors import InputError
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle

NOTHING: Any = None
NUMBERS = {
    "base.gain": FittedValue(3.0, 0.1, "1"),
    "drag.coefficient": FittedValue(0.2, 0.01, "1/m"),
    "drag.power": FittedValue(2.0, 0.2, "1"),
    "lag.seconds": FittedValue(0.1, 0.02, "s"),
}


def error(value: float) -> Any:
    return SimpleNamespace(value=value)


def judged(*effects: str, decision: str = "rejected", after: float | None = 0.5, stage: int = 0) -> Any:
    own = SimpleNamespace(
        effects=effects, name=" + ".join(effects), fit=SimpleNamespace(paths=tuple(NUMBERS), model=None)
    )
    return SimpleNamespace(
        trial=own, stage=stage, error=None if after is None else error(after), gain=4.0, equals=("wind",),
        decision=decision, reason="because",
    )  # fmt: skip


@pytest.mark.parametrize("elsewhere", [True, False])
def test_rejected_candidates_keep_their_parameters_and_accepted_ones_get_the_final_ones(elsewhere, monkeypatch):
    """A candidate that was rejected, or accepted and taken out, keeps the numbers of its trial."""
    monkeypatch.setattr(diagnose, "values_of", lambda *_: NUMBERS)
    monkeypatch.setattr(diagnose, "error_with", lambda *_: error(0.9))
    final = {path: replace(value, value=10.0 * value.value) for path, value in NUMBERS.items()}
    stages = [SimpleNamespace(effects=(), heldout_error=1.0), SimpleNamespace(effects=("drag",), heldout_error=0.1)]
    candidates = [
        judged("drag", decision="accepted", stage=2), judged("drag"), judged("lag", decision="accepted"),
        judged("drag", "lag", after=None),
    ]  # fmt: skip
    search: Any = SimpleNamespace(candidates=candidates, added=["drag"], shooting=None, heldout=None)
    report: Any = SimpleNamespace(stages=stages)
    stayed, before, gone, untried = diagnose._candidates(search, object() if elsewhere else None, report, final)  # type: ignore[arg-type]
    assert (stayed.effect, stayed.stage, stayed.score, stayed.heldout_error) == ("drag", 2, 4.0, 0.1)
    assert (stayed.indistinguishable_from, stayed.decision, stayed.reason) == (("wind",), "accepted", "because")
    assert {name: value.value for name, value in stayed.parameters.items()} == {"coefficient": 2.0, "power": 20.0}
    assert before.heldout_error == gone.heldout_error == (0.9 if elsewhere else 0.5)
    assert before.parameters == {"coefficient": NUMBERS["drag.coefficient"], "power": NUMBERS["drag.power"]}
    assert gone.parameters == {"seconds": NUMBERS["lag.seconds"]}
    assert untried.parameters == {path: value for path, value in NUMBERS.items() if path != "base.gain"}
    assert untried.heldout_error is None


@pytest.mark.parametrize(("enough", "wrong"), [(True, False), (False, True), (False, False)])
def test_without_a_verdict_nearest_effects_are_reported_only_if_data_are_too_few(monkeypatch, *, enough, wrong):
    monkeypatch.setattr(diagnose, "alternative_formula", lambda *_: None)
    monkeypatch.setattr(diagnose, "find_unexplained_structure", lambda *_: "a formula")
    monkeypatch.setattr(diagnose, "likely_effects", lambda _: [judged("drag"), judged("lag")])
    monkeypatch.setattr(diagnose, "nearest_effects", lambda *_: ["nearest"])
    search: Any = SimpleNamespace(current=None, shooting=None, region=None)
    judge: Any = SimpleNamespace(enough=enough, wrong=wrong, why_not="too little data")
    monkeypatch.setattr(diagnose, "LibraryMatcher", lambda _: SimpleNamespace(found=[judged("lag")]))
    unexplained, likely = diagnose._unmodelled(search, judge, [])
    if enough:
        assert unexplained == "a formula"
        assert [item.trial.effects for item in likely] == [("lag",), ("drag",)], "each is named once"
    else:
        assert unexplained == Unexplained((), "too little data", 0.0)
        assert likely == ([] if wrong else ["nearest"])


GOOD = {"gain": 2.9, "fall": 0.05, "missing": 0.39, "reached": 0.20, "sure": 5.0}


@pytest.mark.parametrize(
    ("changes", "retained"),
    [
        ({}, True), ({"reached": 0.35}, False),  # what followed takes off too little
        ({"sure": 2.0}, False),  # or blocks are not sure of it all
        ({"gain": 1.2}, False), ({"fall": 0.01}, False), ({"missing": 0.20, "reached": 0.10}, False),
        ({"names": ("one",)}, False),  # one recording is unlike no other
        ({"region": "a circle"}, False),  # a region that explains more is reported instead
        ({"before": 0.45}, False),  # tried next to an earlier model
    ],
)  # fmt: skip
def test_a_provisional_step_is_kept_only_if_its_result_passes_as_a_whole(changes, retained, monkeypatch):
    case: dict[str, Any] = {"names": ("one", "two"), "region": None, "before": None} | GOOD | changes
    before = case["before"] or case["missing"]
    monkeypatch.setattr(further_trials, "is_spurious_delay", lambda *_: False)
    monkeypatch.setattr(further_trials, "within_bounds", lambda *_: True)
    monkeypatch.setattr(further_trials, "fewest_parameters", lambda trial, *_: trial)
    monkeypatch.setattr(further_trials, "accept_trial", lambda search, trial: search.added.extend(trial.effects))
    monkeypatch.setattr(further_trials, "known_effects", lambda *_: {})
    monkeypatch.setattr(further_trials, "refit_effects", lambda *_: None)
    monkeypatch.setattr(further_trials, "block_gain", lambda *_: case["sure"])

    def in_turn(search: Any, *_: Any) -> None:
        if search.added:
            search.error, search.current = error(case["reached"]), SimpleNamespace(name="after")

    monkeypatch.setattr(searching, "_add_one_by_one", in_turn)
    windows: Any = SimpleNamespace(names=case["names"], period=np.array([0.05]))
    current: Any = SimpleNamespace(name="before")
    windows = SimpleNamespace(windows=windows)
    search = SearchState(windows, current, error(case["missing"]), current, error(0.8), NOTHING)
    search.region = case["region"]
    trial: Any = SimpleNamespace(effects=("viscous_drag",), name="viscous_drag")
    after = error((1.0 - case["fall"]) * before)
    search.candidates = [JudgedTrial(0, trial, case["gain"], after, "rejected", "too little", (), before)]
    searching._add_effects(search, lambda *_: None, lambda: ())
    assert search.added == (["viscous_drag"] if retained else [])
    assert search.error.value == (case["reached"] if retained else case["missing"])
    assert search.candidates[0].decision == ("accepted" if retained else "rejected")


@pytest.mark.parametrize(
    ("gain", "loss", "most_runs", "retained"),
    [(9.0, -2.0, True, True), (0.5, -2.0, True, False), (9.0, -1.0, True, False), (9.0, -2.0, False, False)],
)
def test_a_region_needs_a_gain_on_unseen_blocks_a_lower_error_and_most_runs(
    gain: float, loss: float, most_runs: bool, retained: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = SimpleNamespace(gain=gain, trial=SimpleNamespace(loss=loss))
    monkeypatch.setattr(regions, "share_one_area", lambda _: True)
    monkeypatch.setattr(regions, "residual_inputs", lambda *_: np.zeros((40, 1)))
    monkeypatch.setattr(regions, "_start", lambda *_: {"x": 0.0})
    monkeypatch.setattr(regions, "_fit_region", lambda *_: found)
    monkeypatch.setattr(regions, "_in_most_runs", lambda *_: most_runs)
    system = SimpleNamespace(name="car", state_names=("x", "y", "yaw", "speed"))
    windows = type("Windows", (), {"system": system, "__len__": lambda _: 40})()
    shooting: Any = SimpleNamespace(windows=windows, measured=np.zeros((40, 5, 4)))
    assert regions.best_region(SimpleNamespace(loss=-1.0), shooting) is (found if retained else None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("first", "second", "terms"),
    [
        ([1.0, 2.0, 3.0], None, ["a", "b", "c"]), ([1.0, 0.001, 3.0], [1.5, 3.5], ["a", "c"]),
        ([0.001, 2.0, 3.0], [2.5, 3.5], ["b", "c"]), ([0.001, 0.001, 0.001], None, None),
    ],
)  # fmt: skip
def test_terms_within_their_deviations_in_the_rollouts_are_dropped_and_the_rest_is_fitted_again(
    first: list[float], second: list[float] | None, terms: list[str] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Deviations are 0.1 each."""
    fits: list[SelectedTerms] = []

    def fitted(selected: SelectedTerms, *_: Any) -> Any:
        fits.append(selected)
        values = np.array([9.0, *(first if len(fits) == 1 else second or [])])
        deviations = np.full(len(values), 0.1)
        return SimpleNamespace(fit=SimpleNamespace(values=values, deviations=lambda _: deviations), loss=-2.0)

    begun: Any = SelectedTerms(("a", "b", "c"), np.array([1.0, 2.0, 3.0]), ())  # type: ignore[arg-type]
    monkeypatch.setattr(unmodelled, "selected_terms", lambda *_: begun)
    monkeypatch.setattr(unmodelled, "rate_states", lambda _: None)
    monkeypatch.setattr(unmodelled, "_fit_formula", fitted)
    shooting: Any = SimpleNamespace(windows=SimpleNamespace(system=None))
    found = unmodelled._find_formula(SimpleNamespace(loss=-1.0), shooting)  # type: ignore[arg-type]
    assert (list(found[0].terms) if found else None) == terms
    assert len(fits) == (1 if second is None else 2)
    if second is not None:
        assert fits[1].coefficients.tolist() == [value for value in first if value >= 1.0]


@pytest.mark.parametrize(
    ("library", "passed", "asked", "rest"), [((), True, 0, "rest"), (("a",), True, 1, None), (("a",), False, 1, "rest")]
)
def test_an_interactive_step_looks_for_a_formula_if_no_effect_passes(library, passed, asked, rest, monkeypatch):
    search: Any = SimpleNamespace(candidates=[], current=None, shooting=None, added=[], region=None)
    did: list[Any] = []
    monkeypatch.setattr(interactive, "_copied", lambda _: SimpleNamespace(**vars(search)))
    monkeypatch.setattr(diagnose, "library_for", lambda _: library)
    monkeypatch.setattr(interactive, "fit_trials", lambda *_: [])
    monkeypatch.setattr(interactive, "add_best_trial", lambda *given: did.append(given) or passed)
    monkeypatch.setattr(interactive, "find_unexplained_structure", lambda *_: "rest")
    monkeypatch.setattr(interactive, "experiment_for", lambda _: None)
    step: Any = SimpleNamespace(why_not="", search=search, model=None)
    assert (interactive.proposal(step).unexplained, len(did)) == (rest, asked)
    proposed: Any = SimpleNamespace(search=SimpleNamespace(candidates=[judged("drag"), judged("lag")]))
    with pytest.raises(InputError, match="effect 'lagg': not among the candidates"):
        interactive.with_candidate(step, proposed, "lagg")


def law(name: str, lacking: str = "") -> Any:
    notice = {key: key != lacking for key in ("passes", "runs", "rows", "law")}
    return SimpleNamespace(name=name, fit=SimpleNamespace(free=np.array([True, lacking != "free"])), notice=notice)


@pytest.mark.parametrize("lacking", ["passes", "runs", "rows", "law", "free"])
def test_a_law_must_satisfy_every_criterion_of_acceptance(lacking: str, monkeypatch: pytest.MonkeyPatch) -> None:
    checks = {"_passes": "passes", "_in_most_runs": "runs", "_covers_some_rows": "rows", "_present_outside_law": "law"}
    for function, key in checks.items():
        monkeypatch.setattr(conditional, function, lambda one, *_, key=key: one.notice[key])
    monkeypatch.setattr(conditional, "_is_dry_friction", lambda *_: False)
    monkeypatch.setattr(conditional, "_simplest", lambda passing, _: [one.name for one in passing])
    doubtful = law("doubtful", lacking)
    assert conditional._best_passing(NOTHING, [doubtful, law("sound")]) == ["sound"]
    assert conditional._best_passing(NOTHING, [doubtful]) is None


@pytest.mark.parametrize(
    ("laws", "places", "accepted"),
    [("", "", ""), ("a", "", "a"), ("", "p", "p"), ("a", "p", "ap"), ("abcd", "", "abc")],
)
def test_laws_are_added_in_at_most_three_rounds_and_regions_if_no_law_is_left(laws, places, accepted, monkeypatch):
    did: list[str] = []
    left, floors = list(laws), list(places)
    monkeypatch.setattr(conditional, "_best_law", lambda *_: left.pop(0) if left else None)
    monkeypatch.setattr(conditional, "_floor_region", lambda *_: floors.pop(0) if floors else None)
    monkeypatch.setattr(conditional, "_one_sided", lambda best, _: best)
    monkeypatch.setattr(conditional, "accept_law", lambda _search, best: did.append(best))
    monkeypatch.setattr(conditional, "backward_elimination", lambda *_: did.append("-"))
    assert conditional.add_conditions(NOTHING) is bool(accepted)
    assert "".join(did) == "".join(f"{name}-" for name in accepted), "each is followed by removals"


@pytest.mark.parametrize("without", [(), ("viscous_drag",)])
def test_an_effect_with_a_law_replaces_the_plain_one_and_other_parameters_stay(without, monkeypatch):
    base = {"base.wheelbase": Setting(0.3), "base.drive_gain": Setting(3.0)}
    model = PhysicsModel(KinematicBicycle("throttle"), [], base)
    model = model.with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.7)})
    model = model.with_effect(effect("car", "understeer"), {"gradient": Setting(0.03)})
    item, drag = effects_of("car")["understeer"], "viscous_drag.coefficient"
    monkeypatch.setattr(conditional, "conditioned", lambda own, *_: own)
    made = conditional._with_law(model, item, NOTHING, {"gradient": 0.05}, without)
    left = [name for name in ("viscous_drag", "understeer") if name not in without]
    assert [own.name for own in made.effects] == left
    assert {path.split(".")[0] for path in made.settings} - {"base"} == set(left)
    assert made.settings["understeer.gradient"].value == 0.05
    assert without or made.settings[drag].value == 0.7
    bounded = conditional._with_law(model, item, NOTHING, {"gradient": 1e9}, without)
    assert bounded.settings["understeer.gradient"].value == next(p.high for p in item.parameters)
    given: list[Any] = []

    def fit(_model: Any, paths: Any, _shooting: Any, _scale: Any, **more: Any) -> Any:
        given.append((paths, more["known"]))
        return SimpleNamespace(value=-2.0)

    monkeypatch.setattr(conditional, "fit", fit)
    monkeypatch.setattr(conditional, "known_slopes", lambda _fit, rest: tuple(rest))
    monkeypatch.setattr(conditional, "trial_of", lambda found, _shooting, names, _null: (found.value, names))
    paths = ("base.drive_gain", drag, "understeer.gradient")
    null = SimpleNamespace(fit=SimpleNamespace(model=model, paths=paths, value=-1.0, scale=None))
    search: Any = SimpleNamespace(current=null, shooting=None)
    proposed: Any = SimpleNamespace(item=item, law=None, start={"gradient": 0.05})
    assert conditional._fit_law(search, proposed, without) == (-2.0, ("understeer",))
    rest = ["base.drive_gain", *([] if without else [drag])]
    assert given == [([*rest, "understeer.gradient"], tuple(rest))], "slopes of the law's own numbers are not reused"
