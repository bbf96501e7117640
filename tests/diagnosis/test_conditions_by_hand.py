"""Which law an effect is given: conditions one by one, rounds, and the model that stands for it afterwards."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.search import conditions
from safedpa.effects import effects_of


def trial(name: str, *, free: bool = True, **said: bool) -> Any:
    fit = SimpleNamespace(free=np.array([True, free]))
    return SimpleNamespace(name=name, fit=fit, said={"passes": True, "runs": True, "rows": True, "law": True} | said)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each condition says of a trial what stands in it; of those that pass the first is taken."""
    for function, key in (
        ("_passes", "passes"), ("_in_most_runs", "runs"), ("_of_some_rows", "rows"), ("_more_than_its_law", "law"),
    ):  # fmt: skip
        monkeypatch.setattr(conditions, function, lambda one, *_, key=key: one.said[key])
    monkeypatch.setattr(conditions, "_fewest", lambda passing, _: [one.name for one in passing])


@pytest.mark.usefixtures("asked")
@pytest.mark.parametrize("lacking", ["passes", "runs", "rows", "law", "free"])
def test_a_law_that_lacks_one_thing_is_none(lacking: str) -> None:
    """Of a number at its bound, in few runs, of all rows or none, or no better than its law alone: each is enough."""
    nobody: Any = None
    doubtful, sound = trial("doubtful", **{lacking: False}), trial("sound")
    assert conditions._chosen(nobody, [doubtful, sound], nobody) == ["sound"]
    assert conditions._chosen(nobody, [doubtful], nobody) is None
    assert conditions._chosen(nobody, [], nobody) is None


@pytest.mark.parametrize(
    ("laws", "places", "accepted", "any_law"),
    [
        ([], [], [], False),
        (["law"], [], ["law"], True),
        ([], ["floor"], ["floor"], True),
        (["law"], ["floor"], ["law", "floor"], True),  # a place where no law is left
        (["one", "two", "three", "four"], [], ["one", "two", "three"], True),  # three rounds
    ],
)
def test_laws_are_given_one_after_the_other_and_places_where_no_law_is_left(
    laws: list[str], places: list[str], accepted: list[str], *, any_law: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    did: list[str] = []
    left, floors = list(laws), list(places)
    monkeypatch.setattr(conditions, "_lawful", lambda *_: left.pop(0) if left else None)
    monkeypatch.setattr(conditions, "_on_the_floor", lambda *_: floors.pop(0) if floors else None)
    monkeypatch.setattr(conditions, "_one_sided", lambda best, _: best)
    monkeypatch.setattr(conditions, "_accept", lambda _search, best, _heldout: did.append(best))
    monkeypatch.setattr(conditions, "removals", lambda *_: did.append("what stood for it goes"))
    nobody: Any = None
    assert conditions.conditional(nobody, [], nobody) is any_law
    assert did == [word for name in accepted for word in (name, "what stood for it goes")]


@pytest.fixture
def over_two(plain: Any, with_effect: Any) -> Any:
    """A car with a drag, and an understeer whose number is to be given a law."""
    return with_effect(with_effect(plain, "viscous_drag", coefficient=0.7), "understeer", gradient=0.03)


@pytest.mark.parametrize(
    ("without", "left"), [((), ["viscous_drag", "understeer"]), (("viscous_drag",), ["understeer"])]
)
def test_under_a_law_an_effect_stands_once_and_the_others_keep_their_numbers(
    over_two: Any, without: tuple[str, ...], left: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    item = effects_of("car")["understeer"]
    monkeypatch.setattr(conditions, "conditioned", lambda own, *_: own)
    nobody: Any = None
    made = conditions._with_law(over_two, item, nobody, {"gradient": 0.05}, without)
    assert [own.name for own in made.effects] == left
    assert made.settings["understeer.gradient"].value == 0.05, "not the number that it had without a law"
    assert {path.split(".")[0] for path in made.settings} - {"base"} == set(left)
    if not without:
        assert made.settings["viscous_drag.coefficient"].value == 0.7
    bounded = conditions._with_law(over_two, item, nobody, {"gradient": 1e9}, without)
    known = next(parameter for parameter in item.parameters if parameter.name == "gradient")
    assert bounded.settings["understeer.gradient"].value == known.high


def test_beside_a_law_everything_else_is_fitted_as_before(over_two: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The law's own numbers are fitted anew: those of the same names without it meant something else."""
    item = effects_of("car")["understeer"]
    given: list[Any] = []

    def fit(model: Any, paths: Any, _shooting: Any, _scale: Any, **more: Any) -> Any:
        given.append((model, paths, more))
        return SimpleNamespace(value=-2.0)

    monkeypatch.setattr(conditions, "conditioned", lambda own, *_: own)
    monkeypatch.setattr(conditions, "fit", fit)
    monkeypatch.setattr(conditions, "known_of", lambda _fit, rest: tuple(rest))
    monkeypatch.setattr(conditions, "trial_of", lambda found, _shooting, names, _null: (found.value, names))
    paths = ("base.drive_gain", "viscous_drag.coefficient", "understeer.gradient")
    null = SimpleNamespace(fit=SimpleNamespace(model=over_two, paths=paths, value=-1.0, scale=None))
    search: Any = SimpleNamespace(current=null, shooting=None)
    proposal: Any = SimpleNamespace(item=item, law=None, start={"gradient": 0.05})
    assert conditions._fitted(search, proposal) == (-2.0, ("understeer",))
    assert conditions._fitted(search, proposal, ("viscous_drag",)) == (-2.0, ("understeer",))
    (_, both, known), (_, alone, _) = given
    assert both == ["base.drive_gain", "viscous_drag.coefficient", "understeer.gradient"]
    assert alone == ["base.drive_gain", "understeer.gradient"]
    assert known["known"] == ("base.drive_gain", "viscous_drag.coefficient")
