"""Gains on unseen blocks, the closest explanations, stages of a report, and pushes that are cut."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from safedpa.diagnosis import experiment_design
from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.fit.cross_validation import HeldoutError
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, explanation_correlation
from safedpa.diagnosis.report_schema import Detectable, FittedValue, PossibleEffect, Profile, as_document
from safedpa.diagnosis.residuals.unmodelled import peak_of
from safedpa.diagnosis.residuals.weak_sindy import Regression
from safedpa.diagnosis.search import nearest_candidates, stages
from safedpa.diagnosis.search.nearest_candidates import (
    closest_effects,
    doubtful_effects,
    likely_effects,
    nearest_effects,
)
from safedpa.diagnosis.search.regions import StripRegion, clip_outliers
from safedpa.diagnosis.search.search_state import JudgedTrial
from safedpa.diagnosis.search.stages import stages_of
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa.report.diagnosis_story import report_text, unsure_sentence
from safedpa_lab.hidden import Case, write_case


def gain(differences: Any) -> float:
    """The gain where the squares of each block differ by so much, over a mean square of 1."""
    count = len(differences)
    order = np.arange(count)
    shooting: Any = SimpleNamespace(block=order, by_block=order, first_of_block=order, size=np.array([float(count)]))
    one: Any = SimpleNamespace(heldout=1.0 + np.asarray(differences)[:, None])
    other: Any = SimpleNamespace(heldout=np.full((count, 1), 1.0))
    return block_gain(one, other, shooting)


@pytest.mark.parametrize("count", [8, 12, 40, 200])
@pytest.mark.parametrize("shift", [-0.5, 0.3, 1.0, 3.0])
def test_a_gain_is_the_normal_deviate_of_a_t_test(count: int, shift: float) -> None:
    values = 4.0 * (np.random.default_rng(count).normal(size=count) + shift)
    ratio = values.sum() / np.hypot(values.std(ddof=1) * np.sqrt(count), 1.0)
    wanted = np.sign(ratio) * stats.norm.isf(stats.t.sf(abs(ratio), count - 1))
    assert gain(values) == pytest.approx(wanted, rel=0.02)


def test_steady_gains_of_few_blocks_do_not_count() -> None:
    assert gain([1.0, 1.01, 0.99, 1.0, 1.0, 1.01, 0.99]) == 0.0
    assert gain(5.0 + 0.1 * np.arange(8)) < 8.0
    assert gain(np.zeros(20)) == 0.0


def regression(blocks: int, each: int) -> Regression:
    windows, block = blocks * each, np.repeat(np.arange(blocks), each)
    return Regression(np.zeros((windows, 1)), np.zeros((windows, 1, 0)), 0, block % 5, block)


EVEN = [1.0, 2.0, 3.0, 1.0, 2.0, 4.0, 2.0, 1.0, 3.0, 2.0, 5.0, 1.0, 2.0, 2.0, 3.0, 1.0, 2.0, 4.0]
IN_FEW = [0.0] * 25 + [1.0 + 0.1 * number for number in range(10)] + [2.0] * 4 + [1e6]
IN_ALL = [1.0, 1.1] * 8 + [1e6, 1.0]


@pytest.mark.parametrize(
    ("gains", "blocks", "most"),
    [
        (EVEN, 9, math.inf),
        (IN_FEW, 40, 3.0 * float(np.quantile(IN_FEW, 0.9))),  # few windows are concerned
        (IN_ALL, 18, 20.0 * float(np.median(IN_ALL))),
    ],
)
def test_block_gain_of_a_regression_is_the_clipped_block_sum_over_its_standard_error(gains, blocks, most):
    sums = np.minimum(gains, most).reshape(blocks, -1).sum(axis=1)
    wanted = sums.sum() / (sums.std(ddof=1) * math.sqrt(blocks))
    problem = regression(blocks, len(gains) // blocks)
    before, after = np.array(gains) + 7.0, np.full(len(gains), 7.0)
    for size in (1.0, 100.0):
        assert problem.block_gain(size * before, size * after) == pytest.approx(wanted, rel=1e-9)
    assert problem.block_gain(after, before) == pytest.approx(-wanted, rel=1e-9)


def test_block_gain_of_a_regression_is_zero_below_eight_blocks() -> None:
    assert regression(7, 3).block_gain(np.full(21, 2.0), np.ones(21)) == 0.0
    assert regression(8, 3).block_gain(np.full(24, 2.0), np.linspace(0.5, 1.0, 24)) > 0.0


def test_with_nothing_to_gain_two_standard_errors_are_exceeded_in_one_case_of_twenty() -> None:
    random, problem = np.random.default_rng(11), regression(60, 10)
    found = np.array([problem.block_gain(random.normal(0.0, 30.0, 600), np.zeros(600)) for _ in range(2000)])
    assert found.std() == pytest.approx(1.0, abs=0.06)
    assert (np.abs(found) > 2.0).mean() == pytest.approx(0.05, abs=0.012)


def explains(values: Any) -> Any:
    return SimpleNamespace(explained=np.asarray(values, dtype=float))


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ((3.0, 4.0), (6.0, 8.0), 1.0), ((3.0, 4.0), (-6.0, -8.0), -1.0), ((3.0, 0.0), (0.0, 5.0), 0.0),
        ((3.0, 4.0), (4.0, 3.0), 0.96), ((5.0, 12.0), (3.0, 4.0), 63 / 65), ((0.0, 0.0), (3.0, 4.0), 0.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_explanation_correlation_is_the_cosine_of_what_two_trials_explain(one, other, alike, size):
    assert explanation_correlation(explains(one), explains(size * np.array(other))) == pytest.approx(alike)
    assert explanation_correlation(explains(size * np.array(other)), explains(one)) == pytest.approx(alike)


@pytest.mark.parametrize(
    ("sizes", "largest"),
    [((1.0,) * 19 + (100.0,), 6.0), ((1.0,) * 6 + (10.0,) * 4, 10.0), ((0.5,) * 19 + (100.0,), 3.0), ((2.0,) * 5, 2.0)],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_residual_inputs_are_clipped_at_six_medians_or_the_90_percent_quantile(sizes: Any, largest: float, sign: float):
    found = clip_outliers(sign * np.array(sizes)[:, None] * np.array([1.0, 1e-3]))
    assert np.abs(found).max(axis=0) == pytest.approx([largest, 1e-3 * largest], abs=1e-8)
    assert (np.sign(found) == sign).all()
    np.testing.assert_allclose(found[0], sign * sizes[0] * np.array([1.0, 1e-3]))


def test_strips_on_the_floor_are_tried_in_directions_evenly_over_half_a_turn() -> None:
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    starts = list(StripRegion().starts(points))
    angles = sorted({found["angle"] for found, _ in starts})
    assert angles == pytest.approx([math.pi * turn / len(angles) for turn in range(len(angles))])
    assert len(angles) >= 4
    for found, inside in starts:
        across = points @ [math.cos(found["angle"]), math.sin(found["angle"])]
        assert (inside == (np.abs(across - found["offset"]) < found["half_width"])).all()


class Drifting:
    """A model whose two states move by ``times[u]`` of the noise, by the manoeuvre's one command u."""

    period = 0.5

    def __init__(self, size: float, times: tuple[float, float]) -> None:
        self.size, self.times = size, times

    def initial_memory(self, _: Any) -> None:
        return None

    def advance(self, state: Any, action: Any, _: None) -> Any:
        return state * 0.0 + self.size * self.times[int(action[0])] * np.array([0.1, -2.0]), None


@pytest.mark.parametrize(("times", "reported"), [((0.5, 0.75), ""), ((0.5, 3.0), "second"), ((3.0, 0.5), "first")])
def test_the_next_experiment_separates_models_most_in_units_of_the_noise(times, reported, monkeypatch):
    """Noise 0.1 and 2: the root mean square of the difference over it is the same in both states."""
    start, rows = np.zeros(2), np.zeros((8, 1))
    drives = {"first": (start, rows), "second": (start, rows + 1.0)}
    monkeypatch.setattr(experiment_design, "manoeuvres", lambda _: drives)
    models: Any = {name: Drifting(size, times) for name, size in (("one", 0.0), ("two", 1.0), ("three", 3.0))}
    noise, most = np.array([0.1, 2.0]), max(times)
    others: Any = [Drifting(size, times) for size in (1.0, 0.3, 4.0)]
    own: Any = Drifting(0.0, times)
    best = "first" if times[0] > times[1] else "second"
    found = experiment_design.discriminating_manoeuvres(own, others, noise)
    assert found == [best if most * size >= 1.0 else "" for size in (1.0, 0.3, 4.0)]
    experiment = experiment_design.choose_experiment(models, noise)
    assert experiment is not None
    assert (experiment.manoeuvre == reported) is bool(reported)
    assert (f"differ there by {most:.0f} times the noise" in experiment.why) is bool(reported)
    assert experiment_design.choose_experiment({"one": own}, noise) is None


NAN = float("nan")


def error(value: float) -> Any:
    return SimpleNamespace(value=value)


def trial(*effects: str, free: Any = (True,), model: Any = None) -> EffectTrial:
    fit: Any = SimpleNamespace(free=np.array(free), model=model)
    return EffectTrial(effects, fit, np.zeros(1), np.zeros(1), 0.0)


def judged(*effects, stage=2, gain=2.0, after=0.5, decision="suspected", free=(True,)):
    """A verdict next to a model of error 1."""
    own = None if after is None else error(after)
    return JudgedTrial(stage, trial(*effects, free=free), gain, own, decision, "why", (), 1.0)


def searching(*candidates: JudgedTrial, value: float = 0.4, added: Any = ()) -> Any:
    return SimpleNamespace(candidates=list(candidates), error=error(value), added=list(added))


def names(items: list[JudgedTrial]) -> list[str]:
    return [item.trial.name for item in items]


@pytest.mark.parametrize(
    ("item", "value", "reported"),
    [
        (judged("a"), 0.4, True), (judged("a", decision="rejected"), 0.4, True),
        (judged("a", decision="accepted"), 0.4, False), (judged("a", stage=1), 0.4, False),
        (judged("a", stage=3), 0.4, True), (judged("a", gain=1.0), 0.4, False), (judged("a", gain=1.001), 0.4, True),
        (judged("a", gain=-5.0), 0.4, False), (judged("a", after=0.899), 0.4, True),
        (judged("a", after=0.901), 0.4, False), (judged("a", after=1.4), 0.4, False),
        (judged("a", after=0.0), 0.4, True), (judged("a", after=None), 0.4, False), (judged("a", "b"), 0.4, True),
        (judged("a", "drag"), 0.4, False), (judged("drag"), 0.4, False), (judged("a", free=(True, True)), 0.4, True),
        (judged("a", free=(False, False)), 0.4, False), (judged("a", free=(True, False)), 0.5, False),
        (judged("a", free=(True, False)), 0.501, True),  # while half is missing, a bound does not matter
    ],
)  # fmt: skip
def test_a_likely_effect_is_from_the_last_stage_favoured_and_reduces_the_error_by_10_percent(item, value, reported):
    other = judged("other", decision="accepted", after=0.1)
    found = likely_effects(searching(other, item, value=value, added=["drag"]))
    assert names(found) == ([item.trial.name] if reported else [])


def test_likely_effects_are_sorted_by_error_reduction() -> None:
    items = [judged(name, after=after) for name, after in (("a", 0.6), ("b", 0.2), ("c", 0.8), ("d", 0.4))]
    assert names(likely_effects(searching(judged("early", stage=1, after=0.0), *items))) == ["b", "d", "a", "c"]
    assert likely_effects(searching()) == []
    assert names(likely_effects(searching(*[judged("a", stage=0), judged("b", stage=0, gain=0.5)]))) == ["a"]


def doubting(numbers: dict[str, tuple[float, float, float | None]], *candidates: JudgedTrial, added: Any) -> Any:
    """``numbers``: value, deviation and the value at which it does nothing, by path."""
    parameters = {path: SimpleNamespace(neutral=neutral) for path, (_, _, neutral) in numbers.items()}
    fit: Any = SimpleNamespace(
        paths=tuple(numbers),
        values=np.array([value for value, _, _ in numbers.values()]),
        model=SimpleNamespace(parameters=parameters),
        deviations=lambda shooting: np.array([own for _, own, _ in numbers.values()]) * (shooting == "windows"),
    )
    current = EffectTrial((), fit, np.ones(1), np.ones(1), 7.0)
    return SimpleNamespace(current=current, candidates=list(candidates), added=list(added), shooting="windows")


SURE, UNSURE = (2.0, 1.0, 0.0), (0.5, 1.0, 0.0)


@pytest.mark.parametrize(
    ("numbers", "doubted"),
    [
        *(({"drag.c": number}, doubted) for number, doubted in (
            ((0.8, 0.8, 0.0), False), ((0.8, 0.81, 0.0), True), ((-0.8, 0.81, 0.0), True), ((-0.8, 0.5, 0.0), False),
            ((1.5, 0.4, 1.0), False), ((1.5, 0.6, 1.0), True), ((0.5, 0.6, 1.0), True), ((0.5, 0.4, 1.0), False),
            ((3.0, 0.0, 0.0), True), ((3.0, NAN, 0.0), True), ((0.3, 9.0, None), False),
        )),
        ({"drag.c": SURE, "drag.d": UNSURE}, False), ({"drag.c": UNSURE, "drag.d": SURE}, False),
        ({"drag.c": UNSURE, "drag.d": UNSURE, "lag.t": SURE}, True),
        ({"drag.c": UNSURE, "drag.d": (0.5, 1.0, None)}, True), ({"lag.t": UNSURE}, False),
        ({"base.mass": UNSURE, "drag.c": SURE}, False),
    ],
)  # fmt: skip
def test_an_accepted_effect_is_doubtful_if_all_its_parameters_are_within_one_deviation_of_neutral(numbers, doubted):
    found = doubtful_effects(doubting(numbers, judged("drag", decision="accepted"), added=["drag"]))
    assert names(found) == (["drag"] if doubted else [])


def test_a_doubtful_effect_is_reported_alone_with_the_current_parameters() -> None:
    items = [
        judged("drag", stage=0, decision="accepted", gain=3.0),
        judged("lag", "drag", stage=1, decision="accepted", gain=5.0),
        judged("drag", stage=2, decision="rejected", gain=0.5),
        judged("grip", stage=2, decision="accepted", gain=9.0),
    ]
    search = doubting({"drag.c": UNSURE, "lag.t": UNSURE, "grip.g": SURE}, *items, added=["drag", "lag"])
    found = doubtful_effects(search)
    assert names(found) == ["drag", "lag"]
    assert [(item.stage, item.gain, item.decision) for item in found] == [(1, 5.0, "suspected")] * 2
    assert all(item.trial.fit is search.current.fit and item.trial.loss == 7.0 for item in found)
    assert all("within one deviation of zero effect" in item.reason for item in found)
    assert doubtful_effects(doubting({"drag.c": UNSURE}, items[2], items[3], added=["drag"])) == []


def nearest(monkeypatch: pytest.MonkeyPatch, errors: list[float], value: float = 0.5, count: int = 3):
    """Effects 0, 1, ... as their trials come, and the held-out error of each."""
    trials = [trial(str(number), model=after) for number, after in enumerate(errors)]
    windows: Any = SimpleNamespace(windows=range(count))
    search: Any = SimpleNamespace(shooting=windows, error=error(value), current="now")
    search.error_of = lambda fit: error(fit.model)
    monkeypatch.setattr(nearest_candidates, "fit_trials", lambda *_: trials)
    gains = lambda one, other, _: (100.0 if one == "now" else -1.0) + float(other.name)  # noqa: E731
    monkeypatch.setattr(nearest_candidates, "block_gain", gains)
    return nearest_effects(search, [])


@pytest.mark.parametrize(
    ("errors", "value", "count", "reported"),
    [
        ([0.44, 0.46, 0.1, 0.3, float("inf")], 0.5, 3, ["2", "3", "0"]),
        ([0.06, 0.05, 0.04, 0.03, 0.02, 0.01, 0.0], 0.5, 3, ["5", "4", "3", "2", "1", "0"]),  # the first six are tried
        ([0.9], 1.0, 3, []), ([0.899], 1.0, 3, ["0"]), ([1.05], 1.0, 3, []), ([89.9], 100.0, 3, ["0"]),
        ([0.01], 0.5, 2, []), ([0.01], 0.5, 0, []), ([-1.0], 0.0, 3, []), ([0.01], NAN, 3, []), ([0.01], 7.0, 9, ["0"]),
    ],
)  # fmt: skip
def test_with_too_little_data_effects_that_reduce_the_error_by_10_percent_are_reported_best_first(
    errors: list[float], value: float, count: int, reported: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = nearest(monkeypatch, errors, value, count)
    assert names(found) == reported
    assert [item.gain for item in found] == [100.0 + float(name) for name in reported]
    assert [item.error.value for item in found if item.error] == [errors[int(name)] for name in reported]
    for item in found:
        assert (item.stage, item.decision, item.reason, item.before) == (0, "suspected", "too little data", value)


def test_the_best_three_have_their_own_numbers_smallest_sizes_and_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """An effect whose name begins with the name of another does not get the numbers of the other."""
    made = [("drag",), ("lag", "grip"), ("drift",), ("more",)]
    items = [
        JudgedTrial(
            1, trial(*own, model=f"with {own[0]}"), 2.0 + number, error(0.25), "suspected", f"why {number}", (), 1.0
        )
        for number, own in enumerate(made)
    ]
    items[2] = JudgedTrial(1, items[2].trial, 4.0, None, "suspected", "why 2", ())
    paths = ("base.mass", "drag.c", "lag.drag", "grip.g", "grip.h", "drift.d", "dragging.c")
    numbers = {path: FittedValue(float(number), 0.1, "s") for number, path in enumerate(paths)}
    wanted = (
        ("drag", "c", 0.3), ("drag", "d", None), ("lag", "drag", 0.0), ("drift", "d", 0.5), ("dragging", "c", 0.6),
    )  # fmt: skip
    sizes = [Detectable(name, parameter, "1/s", smallest, 1.0, ()) for name, parameter, smallest in wanted]
    search: Any = SimpleNamespace(current=trial(model="now"), added=[], error=error(1.0))
    noise = np.array([0.1, 0.2])

    def manoeuvres(model: Any, others: Any, given: Any) -> list[str]:
        assert (model, others, given is noise) == ("now", ["with drag", "with lag", "with drift"], True)
        return [f"drive {number}" for number in range(len(others))]

    monkeypatch.setattr(nearest_candidates, "discriminating_manoeuvres", manoeuvres)

    def smallest(path: str, value: float) -> dict[str, FittedValue]:
        return {path: FittedValue(value, None, "1/s")}

    pair = {path: numbers[path] for path in ("lag.drag", "grip.g", "grip.h")}
    assert closest_effects(items, search, [numbers] * 4, sizes, noise) == (
        PossibleEffect("drag", {"drag.c": numbers["drag.c"]}, 0.75, 2.0, smallest("drag.c", 0.3), "drive 0", "why 0"),
        PossibleEffect("lag + grip", pair, 0.75, 3.0, smallest("lag.drag", 0.0), "drive 1", "why 1"),
        PossibleEffect(
            "drift", {"drift.d": numbers["drift.d"]}, None, 4.0, smallest("drift.d", 0.5), "drive 2", "why 2"
        ),
    )
    monkeypatch.setattr(nearest_candidates, "discriminating_manoeuvres", lambda *_: [])
    assert closest_effects([], search, [], sizes, np.ones(2)) == ()


def test_the_undecided_sentence_names_what_helps_and_the_open_size() -> None:
    value = {"value": 0.8, "std": 6.2, "unit": "1/s"}
    document = {
        "added": ["viscous_drag", "understeer"],
        "closest": [{"effect": "viscous_drag", "parameters": {"viscous_drag.coefficient": value}}],
    }
    notice = unsure_sentence(document, "viscous_drag and understeer", 0.55, 0.12)
    assert notice.startswith(
        "Undecided: with viscous_drag and understeer the error on such driving falls from 0.55 to "
    )
    assert "coefficient 0.8 +- 6.2 1/s" in notice
    assert "understeer (" not in notice


class Model:
    """A model that is known by the names of its effects, and fitted to numbers that say which model they are of."""

    def __init__(self, names: str, last: str = "") -> None:
        self.names = names
        self.effects = [SimpleNamespace(name=name, parameters=(SimpleNamespace(name="n"),)) for name in names]
        self.settings = {f"{name}.n": f"{name} of {last or names}" for name in names}

    def with_effect(self, item: Any, own: dict[str, str]) -> Model:
        assert own == {"n": f"{item.name} of the last model"}
        return Model(self.names + item.name)


def heldout_error(errors: Any) -> HeldoutError:
    """``errors``: one for all, one for each run, or of each run and state."""
    table = np.array(errors, dtype=float)
    table = np.full((2, 2), table) if table.ndim == 0 else np.stack([table] * 2, axis=1) if table.ndim == 1 else table
    by_run = table.mean(axis=1)
    return HeldoutError(float(np.nanmean(table)), np.nanmean(table, axis=0), by_run, table, by_run, table)


@pytest.fixture
def reported(monkeypatch: pytest.MonkeyPatch) -> Any:
    """reported(table, added, shown=None) -> (the stages, effects in their order).

    A model has the errors of the table by the letters of its effects; on the windows that are shown, those of
    ``shown``.
    """

    def report(table: dict[str, Any], added: str, shown: dict[str, Any] | None = None) -> Any:
        runs = tuple(f"r{number}" for number in range(3))
        windows = SimpleNamespace(system=SimpleNamespace(state_names=("x", "y")), names=runs)
        heldout: Any = SimpleNamespace(windows=windows)
        other: Any = SimpleNamespace(windows=windows)
        tables = {id(heldout): table, id(other): shown or {}}

        def fit(model: Model, paths: list[str], shooting: str, scale: str) -> Any:
            assert paths == ["base.gain", *(f"{name}.n" for name in model.names)]
            assert (shooting, scale) == ("windows", "scale")
            return SimpleNamespace(model=model)

        monkeypatch.setattr(stages, "fit", fit)
        monkeypatch.setattr(stages, "error_with", lambda own, _, at: heldout_error(tables[id(at)][own.model.names]))
        first = SimpleNamespace(fit=SimpleNamespace(model=Model(""), paths=("base.gain",)))
        current = SimpleNamespace(fit=SimpleNamespace(model=Model(added, "the last model"), scale="scale"))
        search: Any = SimpleNamespace(first=first, current=current, shooting="windows", added=list(added))
        search.heldout = heldout
        return stages_of(search, heldout if shown is None else other), "".join(search.added)

    return report


def listed(found: Any) -> list[str]:
    return ["".join(stage.effects) for stage in found.stages]


def test_each_stage_adds_one_effect_with_its_error_and_the_runs_that_it_improves(reported: Any) -> None:
    found, added = reported({"": 1.0, "a": 0.8, "ab": 0.5}, "ab")
    assert [(stage.effects, stage.heldout_error) for stage in found.stages] == [
        ((), 1.0), (("a",), 0.8), (("a", "b"), 0.5),
    ]  # fmt: skip
    assert [stage.per_state for stage in found.stages] == [{"x": e, "y": e} for e in (1.0, 0.8, 0.5)]
    assert [stage.runs_improved for stage in found.stages] == ["", "2/2", "2/2"]
    assert [model.names for model in found.models] == ["", "a", "ab"]
    assert ((found.worse, added), listed(reported({"": 1.0}, "")[0])) == (((), "ab"), [""])


@pytest.mark.parametrize(
    ("errors", "stages_listed"),
    [
        (([0.5, 0.5], [0.4, 0.5], [0.3, 0.4]), ["", "a", "ab"]),
        (([0.5, 0.5], [0.6, 0.5], [0.3, 0.4]), ["", "ab"]),  # what helps only with the next one is one stage with it
        (([0.5, 0.5], [0.5, 0.6]), ["", "a"]),  # the last one is the model that is proposed
        (([0.5, 0.5], [0.4, 0.4], [0.4, 0.6]), ["", "a", "ab"]), (([0.5, 0.5], [0.6, 0.6], [0.7, 0.7]), ["", "ab"]),
    ],
)  # fmt: skip
def test_a_stage_improves_some_run_or_is_the_last(reported: Any, errors: Any, stages_listed: list[str]) -> None:
    names = ["", "a", "ab"][: len(errors)]
    assert listed(reported(dict(zip(names, errors, strict=True)), names[-1])[0]) == stages_listed


@pytest.mark.parametrize(
    ("before", "after", "improved"),
    [([0.5, 0.5, 0.5], [0.4, 0.5, 0.3], "2/3"), ([0.5, NAN, 0.5], [0.4, 0.5, 0.6], "1/2"),
     ([0.5, 0.5, 0.5], [0.6, 0.4, NAN], "1/2")],
)  # fmt: skip
def test_runs_with_windows_in_both_stages_are_counted(reported: Any, before: Any, after: Any, improved: str) -> None:
    assert reported({"": before, "a": after}, "a")[0].stages[1].runs_improved == improved


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        ([[0.10, 1.00], [1.00, 0.50], [NAN, 0.10]], [[0.109, 1.04], [1.20, 0.80], [0.70, 0.05]],
         [("r1", "y", 0.50, 0.80), ("r1", "x", 1.00, 1.20)]),
        ([[1.00, 1.0], [0.00, 1.0], [0.5, 2.0]], [[1.05, 1.0], [0.01, 1.0], [0.6, 2.3]],
         [("r2", "y", 2.0, 2.3), ("r2", "x", 0.5, 0.6)]),  # a twentieth and a hundredth are reached and not passed
    ],
)  # fmt: skip
def test_states_that_got_worse_by_a_twentieth_and_a_hundredth_are_reported_most_first(reported, before, after, worse):
    found, _ = reported({"": before, "a": [[0.0, 0.0]] * 3, "ab": after}, "ab")
    assert [(item.run, item.state, item.before, item.after) for item in found.worse] == worse
    assert {item.stage for item in found.worse} == {2}


TABLE = {"": 1.0, "a": 1.2, "ab": 0.5, "abc": 0.3, "b": 0.6, "c": 0.9, "ba": 0.5, "bc": 0.35, "bca": 0.3}


@pytest.mark.parametrize(
    ("table", "added", "order"),
    [
        (TABLE, "abc", "bca"),
        ({**TABLE, "a": 1.0}, "abc", "abc"),  # as large is not larger
        ({**TABLE, "a": 0.9}, "abc", "abc"),  # each of them helps, whatever helps more
        ({**TABLE, "a": 0.4, "ac": 0.45, "acb": 0.3}, "abc", "acb"),  # it was the second one that helped nothing
        (TABLE, "ab", "ab"),  # of two, one stage is made
    ],
)
def test_the_order_is_kept_unless_one_of_three_helps_only_together_with_a_later_one(reported, table, added, order):
    found, now = reported(table, added)
    assert now == order
    if added == "ab":
        assert listed(found) == ["", "ab"]


def test_errors_are_those_of_the_windows_that_are_shown_in_the_order_of_the_search(reported: Any) -> None:
    found, added = reported({"": 1.0, "a": 0.8, "ab": 0.5}, "ab", {"": 2.0, "a": 1.5, "ab": 2.4})
    assert [stage.heldout_error for stage in found.stages] == [2.0, 1.5, 2.4]
    assert [stage.runs_improved for stage in found.stages] == ["", "2/2", "0/2"]
    assert {(item.stage, item.before, item.after) for item in found.worse} == {(2, 2.0, 2.4)}
    assert added == "ab"


NEVER = 1e9


@pytest.fixture
def refusing(monkeypatch):
    """Every named effect is refused, as it is where there are too few blocks."""
    for name in ("SURE", "VERY_SURE", "LIKELY"):
        monkeypatch.setattr(f"safedpa.diagnosis.search.acceptance.{name}", NEVER)
    monkeypatch.setattr("safedpa.diagnosis.search.forward_selection.passing_at_other_horizon", lambda *_: None)
    names = ("viscous_drag", "understeer")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])


@pytest.mark.long
def test_a_refused_effect_that_predicts_like_a_formula_is_named(refusing, tmp_path):
    log = write_case(Case("test", 4, {"viscous_drag": {"coefficient": 0.3}}, runs=3, seconds=20.0), tmp_path)
    model = load_model(str(log.model))
    report = diagnose(model, [load_run(str(path), model.system) for path in log.runs])
    assert report.unexplained is None
    assert report.verdict == "undecided"
    nearest = report.closest[0]
    assert nearest.effect == "viscous_drag"
    assert nearest.parameters["viscous_drag.coefficient"].value == pytest.approx(0.3, abs=0.02)
    assert "likely, not proven" in nearest.reason
    assert "viscous_drag" in report_text(as_document(report)).lead


def profile(values, errors, rows):
    knots = tuple(np.linspace(0.0, 1.0, len(values)).tolist())
    return Profile("throttle", "1", "speed", "m/s2", knots, tuple(values), tuple(errors), None, tuple(rows))


def test_a_peak_needs_rows_and_two_deviations():
    assert peak_of(profile([61.0, 1.0, 0.5], [66.0, 0.1, 0.1], [500, 500, 500])) == 1
    assert peak_of(profile([61.0, 1.0, 0.5], [0.1, 0.1, 0.1], [0, 500, 500])) == 1
    assert peak_of(profile([61.0, 1.0, 0.5], [66.0, 2.0, 2.0], [500, 500, 500])) is None
