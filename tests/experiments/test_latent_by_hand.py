"""When a latent tells loads apart, from drives and answers that are written down by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import car_latent
from safedpa_lab.experiments.car_drives import Drive
from safedpa_lab.experiments.car_latent import LinearDiscriminant

MODEL: Any = SimpleNamespace(latent_names=("z",))
CROSS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
CROSSES = np.concatenate([CROSS + np.array([2.0, 0.0]), CROSS + np.array([0.0, 4.0])])
"""Of two classes, around (2, 0) and (0, 4)."""


@pytest.mark.parametrize("size", [1.0, 100.0])
def test_weights_are_means_over_the_variance_within_the_classes(size: float) -> None:
    """Squares of 4 in each direction over 8 - 2, so that a variance is 2/3."""
    found = LinearDiscriminant.fit(size * CROSSES, ["a"] * 4 + ["b"] * 4)
    assert found.classes == ("a", "b")
    np.testing.assert_allclose(found.means, size * np.array([[2.0, 0.0], [0.0, 4.0]]))
    np.testing.assert_allclose(found.weights, np.array([[3.0, 0.0], [0.0, 6.0]]) / size, rtol=1e-5, atol=1e-9)


def test_an_entry_that_never_changes_decides_nothing() -> None:
    labels = ["a"] * 4 + ["b"] * 4
    tried = np.random.default_rng(1).uniform(-2.0, 5.0, (50, 2))
    said = LinearDiscriminant.fit(CROSSES, labels).classify(tried)
    idle = LinearDiscriminant.fit(np.column_stack([CROSSES, np.full(8, 0.5)]), labels)
    assert idle.classify(np.column_stack([tried, np.full(50, 0.5)])) == said
    assert set(said) == {"a", "b"}


def test_what_is_said_of_which_load_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four without a load one is taken for a box, of three boxes two for none."""
    known = np.array([[-1.0], [-1.2], [1.0], [1.2]]), ["none", "none", "box", "box"]
    tried = np.array([[-1.0], [-0.9], [-1.3], [1.1], [0.9], [-1.1], [-0.8]]), ["none"] * 4 + ["box"] * 3
    parts = iter([known, tried])
    monkeypatch.setattr(car_latent, "_labelled", lambda *_: next(parts))
    monkeypatch.setattr(car_latent, "_bands", lambda *_: {"none": 0.1, "box": 0.1})
    told = car_latent.latent_result(MODEL, [], [], [], np.ones(4))
    assert told["confusion"] == {"none": {"none": 3, "box": 1}, "box": {"none": 2, "box": 1}}
    assert (told["accuracy"]["right"], told["accuracy"]["of"]) == (4, 7)
    assert told["accuracy"] == told["hitched_or_not"]
    assert {load: len(points) for load, points in told["points"]["by_load"].items()} == {"none": 4, "box": 3}


def changes(said: list[str], loads: list[str], errors: list[float], monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(car_latent, "latents_along", lambda *_: None)
    monkeypatch.setattr(car_latent, "_error_sizes", lambda *_: np.array(errors))
    discriminant: Any = SimpleNamespace(classify=lambda _: said)
    band = {"none": 0.1, "box": 0.2, "chair": 0.3}
    return car_latent._changes(MODEL, Drive((), tuple(loads)), discriminant, band, np.ones(4))


def test_a_change_of_load_is_watched_until_the_next_or_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hitched at tick 20, another at 45, until tick 60; the latent follows after 4 and 5, the error after 6 and 2."""
    loads = ["none"] * 20 + ["box"] * 25 + ["chair"] * 15
    said = ["none"] * 24 + ["box"] * 26 + ["chair"] * 10
    errors = [0.05] * 20 + [0.5] * 6 + [0.15] * 19 + [0.5] * 2 + [0.25] * 12
    assert changes(said, loads, errors, monkeypatch) == [
        {"from": "none", "to": "box", "watched": 25, "latent_ticks": 4, "error_ticks": 6},
        {"from": "box", "to": "chair", "watched": 15, "latent_ticks": 5, "error_ticks": 2},
    ]


@pytest.mark.parametrize(("early", "noticed"), [(0, 0), (1, 0), (5, 0), (6, None), (10, None)])
def test_what_was_said_before_it_was_true_is_not_noticed(
    early: int, noticed: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In more than half of the ten ticks before the change."""
    said = ["none"] * (20 - early) + ["box"] * (early + 15)
    (row,) = changes(said, ["none"] * 20 + ["box"] * 15, [0.0] * 34, monkeypatch)
    assert row["latent_ticks"] == noticed


def test_a_drive_without_a_change_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert changes(["none"] * 20, ["none"] * 20, [0.0] * 19, monkeypatch) == []
