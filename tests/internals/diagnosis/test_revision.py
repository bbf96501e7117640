"""Second thoughts of the search: which effects give way to others, which are taken out, and what is reported."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit import trial as trials
from safedpa.diagnosis.fit.cross_validation import HeldoutError
from safedpa.diagnosis.fit.trial import EffectTrial, initial_values
from safedpa.diagnosis.search import backward_revision
from safedpa.diagnosis.search.search_state import JudgedTrial
from safedpa.effects import Parameter

NOTHING: Any = None


def trial(*names: str, held: tuple[str, ...] = (), loss: float = 0.9) -> Any:
    fit = SimpleNamespace(
        value=-3.0, free=np.array([name not in held for name in names]), paths=tuple(f"{name}.a" for name in names),
        model=SimpleNamespace(effects=[SimpleNamespace(name=name) for name in names]),
    )  # fmt: skip
    return replace(EffectTrial(names, NOTHING, NOTHING, NOTHING, loss), fit=fit)


@pytest.fixture
def searching(monkeypatch: pytest.MonkeyPatch) -> Any:
    """searching(added, rivals, held, gain) -> search, in which ``held`` effects are at a bound in every fit."""

    def make(added: str, rivals: dict[str, str], held: str = "", gain: float = 9.0) -> Any:
        library = {name: SimpleNamespace(name=name) for name in "abcdef"}
        monkeypatch.setattr(backward_revision, "known_effects", lambda *_: library)
        monkeypatch.setattr(
            backward_revision,
            "refit_effects",
            lambda _, items, *__: trial(*[item.name for item in items], held=tuple(held)),
        )
        monkeypatch.setattr(backward_revision, "block_gain", lambda *_: gain)
        monkeypatch.setattr(backward_revision, "passes", lambda found, *_: found > 3.0)
        return SimpleNamespace(
            added=list(added), candidates=[], error=SimpleNamespace(value=0.2), shooting=None,
            rivals={name: list(own) for name, own in rivals.items()},
            current=SimpleNamespace(loss=1.0, fit=SimpleNamespace(value=-2.0)),
            error_of=lambda _: SimpleNamespace(value=0.1),
        )  # fmt: skip

    return make


@pytest.mark.parametrize(
    ("added", "rivals", "held", "gain", "left"),
    [
        ("abc", {"b": "de"}, "", 3.4, "adec"), ("abc", {"b": "de"}, "ac", 3.4, "de"),
        ("abc", {"b": "de"}, "c", 3.4, "ade"),  # what is then at a bound made up for the mistake, and goes with it
        ("abc", {"b": "de"}, "c", 0.0, "abc"),
        ("abc", {"a": "de", "c": "bf"}, "c", 9.0, "deb"),  # what went with another is not asked again
        ("ab", {"a": "bd"}, "", 9.0, "ab"), ("ab", {"a": "bde"}, "", 9.0, "deb"),  # no effect is there twice
        ("ab", {"a": "de"}, "e", 9.0, "ab"),
    ],
)  # fmt: skip
def test_an_effect_is_split_into_two_rivals_that_pass_and_are_within_bounds(searching, added, rivals, held, gain, left):
    search = searching(added, rivals, held, gain)
    backward_revision.split_effect(search)
    assert "".join(search.added) == left
    if left != added:
        assert search.error.value == 0.1
        assert set(search.current.effects) == set(left), "the model is that of the effects that are named"


@pytest.mark.parametrize(
    ("gain", "late", "fall", "left"),
    [(9.0, False, 0.01, "bd"), (9.0, True, 0.01, "ba"), (-9.0, False, 0.01, "ba"), (1.9, False, 0.01, "ba"),
     (9.0, False, 0.0004, "ba"), (9.0, False, 0.0, "ba")],
)  # fmt: skip
def test_a_rival_with_one_more_parameter_must_improve_the_log_likelihood_by_one(
    searching: Any, gain: float, late: bool, fall: float, left: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 1000 independent numbers, 0.0004 are 0.4 units of log likelihood and 0.01 are 10."""
    search = searching("ba", {"a": "d"}, gain=gain)
    search.shooting = SimpleNamespace(size=np.array([500.0, 500.0]))
    search.current.fit.paths = ("b.a",)
    search.current.fit.value = -3.0 + fall
    monkeypatch.setattr(backward_revision, "given_effect_names", lambda _: [])
    monkeypatch.setattr(backward_revision, "is_spurious_delay", lambda *_: late)
    backward_revision.exchange_effects(search)
    assert "".join(search.added) == left


def test_only_accepted_candidates_are_reported_as_replaced(searching: Any) -> None:
    search = searching("ab", {})
    for stage, decision in enumerate(("rejected", "accepted")):
        for names in (("a",), ("b",)):
            search.candidates.append(JudgedTrial(stage, trial(*names), 4.0, NOTHING, decision, f"stage {stage}", ()))
    backward_revision.replace_effects(search, ("a",), ("d",), trial("d", "b"))
    assert search.added == ["d", "b"]
    found = [(item.stage, item.trial.effects, item.decision) for item in search.candidates]
    assert found == [
        (0, ("a",), "rejected"), (0, ("b",), "rejected"),
        (1, ("d",), "accepted"), (1, ("a",), "rejected"), (1, ("b",), "accepted"),
    ]  # fmt: skip
    assert search.candidates[0].reason == "stage 0"
    assert "replaced by d" in search.candidates[3].reason
    assert "replaces a" in search.candidates[2].reason


ERRORS = {"d": 0.30, "l": 0.25, "dl": 0.105, "ds": 0.29, "ls": 0.24, "dls": 0.100}


@pytest.mark.parametrize(
    ("spread", "left"), [(0.001, "dls"), (0.02, "dl"), (0.6, "dl")], ids=["sure", "within_one", "runs_that_differ"]
)
def test_an_effect_that_helps_by_less_than_one_standard_error_is_removed(spread, left, monkeypatch):
    """Without s 0.105: more than 0.100 + 0.001 / sqrt(5), less than 0.100 + 0.02 / sqrt(5).

    Without l too 0.30: less than 0.100 + 0.6 / sqrt(5), but in every run far more than with it.
    """

    def error_of(names: Any) -> HeldoutError:
        value = ERRORS["".join(sorted(names))]
        by_run = value + spread * np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
        return HeldoutError(value, np.full(4, value), by_run, np.tile(by_run[:, None], 4), by_run, np.zeros((1, 4)))

    search: Any = SimpleNamespace(added=list("dls"), candidates=[], shooting=None, without={}, error=error_of("dls"))
    monkeypatch.setattr(
        backward_revision, "refit_effects", lambda _, items, *__: SimpleNamespace(fit=[item.name for item in items])
    )
    monkeypatch.setattr(backward_revision, "_is_spurious", lambda *_: False)
    monkeypatch.setattr(backward_revision, "_at_new_bound", lambda *_: False)
    search.error_of = error_of
    monkeypatch.setattr(
        backward_revision, "known_effects", lambda *_: {name: SimpleNamespace(name=name) for name in "dls"}
    )
    backward_revision.select_smallest_model(search)
    assert "".join(search.added) == left
    assert set(search.without) == set(left)


def test_an_effect_is_not_removed_if_another_would_reach_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the drag the error grows by little, and the turning drag is at its largest value."""

    def left(_search: Any, items: Any, *_enough: Any) -> Any:
        free = np.array(["viscous_drag" in {item.name for item in items}])
        return SimpleNamespace(fit=SimpleNamespace(free=free), effects=())

    def error(value: float) -> Any:
        return SimpleNamespace(value=value, standard_error=0.05, by_run=np.full(3, value))

    library = {name: SimpleNamespace(name=name) for name in ("turning_drag", "viscous_drag")}
    search: Any = SimpleNamespace(
        added=list(library), candidates=[], shooting=None, without={}, error=error(0.2),
        current=left(None, [library["viscous_drag"]]),
    )  # fmt: skip
    monkeypatch.setattr(backward_revision, "refit_effects", left)
    monkeypatch.setattr(backward_revision, "known_effects", lambda *_: library)
    monkeypatch.setattr(backward_revision, "_is_spurious", lambda *_: False)
    search.error_of = lambda fit: error(0.4 if fit.free.all() else 0.21)
    backward_revision.select_smallest_model(search)
    assert search.added == ["turning_drag", "viscous_drag"]


@pytest.mark.parametrize(("correlated", "pairs"), [(0.99, [("a", "b")]), (0.1, []), (-0.99, [("a", "b")])])
@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_effects_with_correlated_parameters_are_grouped(correlated: float, pairs: Any, size: float) -> None:
    """The covariance is C = D R D with R's one correlation; columns with J'J = C^-1."""
    covariance = np.array([[1.0, correlated * size, 0.0], [correlated * size, size**2, 0.0], [0.0, 0.0, 4.0]])
    columns = np.linalg.cholesky(np.linalg.inv(covariance)).T[None]
    fitted = SimpleNamespace(columns=columns, paths=("a.x", "b.y", "c.z"))
    search: Any = SimpleNamespace(added=["a", "b", "c"], current=SimpleNamespace(fit=fitted))
    assert backward_revision._groups(search) == [("a",), ("b",), ("c",), *pairs]
    search.added = ["a", "b"]
    assert backward_revision._groups(search) == [("a",), ("b",)], "never all of them"


@pytest.mark.parametrize(
    "parameter",
    [
        Parameter("a", "m", 0.0, 1.0, 0.9), Parameter("a", "m", -1.0, 1.0, 0.9),
        Parameter("a", "m", 0.1, 1.0, 0.9, neutral=None), Parameter("a", "1", 0.5, 1.5, 1.4, neutral=1.0),
        Parameter("a", "1", 0.9, 5.0, 5.0, neutral=1.0), Parameter("a", "1", 4.99, 5.01, 5.0, neutral=None),
        Parameter("a", "1", 4.99, 5.01, 5.0, neutral=4.99), Parameter("a", "1", 4.99, 5.01, 4.99, neutral=5.0),
    ],
)  # fmt: skip
def test_initial_values_are_within_bounds_and_not_neutral(parameter: Parameter) -> None:
    item: Any = SimpleNamespace(parameters=(parameter,))
    found = [start["a"] for start in initial_values(item)]
    assert len(set(found)) >= (2 if parameter.high - parameter.low > 0.1 else 1)
    assert all(parameter.low <= value <= parameter.high for value in found)
    if parameter.high - parameter.low > 0.1:
        assert parameter.neutral not in found


@pytest.mark.parametrize(("each", "left"), [((3, 4), 12), ((4, 4), 16), ((5, 5), 9), ((2, 5, 3), 9), ((40,), 9)])
def test_of_more_than_16_starts_9_are_spread_from_the_first_to_the_last(each, left, monkeypatch):
    item: Any = SimpleNamespace(parameters=[SimpleNamespace(name=f"p{n}") for n in range(len(each))])
    monkeypatch.setattr(trials, "_grid", lambda parameter, _: list(range(each[int(parameter.name[1:])])))
    every = [tuple(one.values()) for one in initial_values(item)]
    assert len(every) == left
    assert every == sorted(set(every))
    assert (every[0], every[-1]) == ((0,) * len(each), tuple(count - 1 for count in each))


def test_effects_that_do_not_pass_together_leave_the_first_model(searching: Any) -> None:
    """Of two effects one is removed, and the other does not pass alone."""
    search = searching("ab", {}, gain=1.0)
    search.current.fit = trial("a", "b").fit
    search.current.fit.columns = np.eye(2)[None]
    search.first, search.first_error = trial(), SimpleNamespace(value=0.3)
    search.error_of = lambda _: SimpleNamespace(value=0.2)
    backward_revision.backward_elimination(search)
    assert (search.added, search.current, search.error) == ([], search.first, search.first_error)
