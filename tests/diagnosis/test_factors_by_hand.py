"""Standard errors, cuts, means and copies, from numbers that are written down by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.adaptation.estimator import LatentEstimator
from safedpa.compare.comparison import PREDICTORS, compare_model
from safedpa.compare.excerpt import without_repeated
from safedpa.compare.summary import as_json
from safedpa.diagnosis.fit.heldout import HeldoutError
from safedpa.diagnosis.search import places
from safedpa.diagnosis.search.patch import capped
from safedpa.live.watch import _heading
from safedpa.records.run import Stretch
from safedpa.robots.car.system import CAR
from safedpa.safety import drive_heights


@pytest.mark.parametrize(
    ("folds", "error"),
    [((1.0, 2.0, 3.0), 1.0 / math.sqrt(3.0)), ((1.0, math.nan, 3.0), math.sqrt(2.0) / math.sqrt(2.0)), ((4.0,), 0.0),
     ((math.nan, 4.0), 0.0), ((2.0,) * 6, 0.0), ((0.0, 0.0, 0.0, 4.0), 1.0)],
)  # fmt: skip
def test_a_standard_error_is_the_spread_of_the_folds_over_the_root_of_their_number(
    folds: tuple[float, ...], error: float
) -> None:
    none = np.zeros(0)
    assert HeldoutError(0.0, none, none, none, np.array(folds), none).standard_error == pytest.approx(error)


@pytest.mark.parametrize(
    ("sizes", "largest"),
    [((1.0,) * 19 + (100.0,), 6.0), ((1.0,) * 6 + (10.0,) * 4, 10.0), ((0.5,) * 19 + (100.0,), 3.0), ((2.0,) * 5, 2.0)],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_pushes_are_cut_at_six_medians_or_at_what_a_tenth_exceeds(
    sizes: tuple[float, ...], largest: float, sign: float
) -> None:
    found = capped(sign * np.array(sizes)[:, None] * np.array([1.0, 1e-3]))
    assert np.abs(found).max(axis=0) == pytest.approx([largest, 1e-3 * largest], abs=1e-8)
    assert (np.sign(found) == sign).all()
    np.testing.assert_allclose(found[0], sign * sizes[0] * np.array([1.0, 1e-3]))


def test_strips_are_tried_in_directions_evenly_over_half_a_turn() -> None:
    """Beyond half a turn the same strips come again."""
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    angles = sorted({found["angle"] for found, _ in places.Strip().starts(points)})
    assert angles == pytest.approx([math.pi * turn / len(angles) for turn in range(len(angles))])
    assert len(angles) >= 4
    for found, inside in places.Strip().starts(points):
        across = points @ [math.cos(found["angle"]), math.sin(found["angle"])]
        assert (inside == (np.abs(across - found["offset"]) < found["half_width"])).all()


@pytest.mark.parametrize("states", [1, 4])
@pytest.mark.parametrize(("deviations", "weight"), [(0.5, 1.0), (3.0, 1.0), (6.0, 0.5), (12.0, 0.25), (0.0, 1.0)])
def test_a_surprise_of_more_than_so_many_deviations_a_state_counts_less(
    states: int, deviations: float, weight: float
) -> None:
    """surprise: the sum over the states of squares, each in its own deviation."""
    own = LatentEstimator.__new__(LatentEstimator)
    told = SimpleNamespace(correct=lambda *_: ([0.2, 8.0], states * deviations**2))
    vars(own).update(
        _belief=told, _noise=None, _largest=3.0, _free=[1.0, 1.0], _low=[0.0, 0.0], _high=[9.0, 2.5], latent=None
    )
    own._learn([0.0] * states, [])
    assert own.latent == pytest.approx([1.0 + 0.2 * weight, min(1.0 + 8.0 * weight, 2.5)])


@pytest.mark.parametrize(
    ("tick", "by", "expected"),
    [(8, "filter", True), (9, "filter", False), (7, "filter", False), (8, "watchdog", False), (None, "", False)],
)
def test_a_height_is_foreseen_where_the_filters_action_was_in_force_in_the_very_next_tick(
    tick: int | None, by: str, expected: bool
) -> None:
    done: list[str] = []
    memory: Any = SimpleNamespace(
        usable_latent=lambda *_: (None, []),
        barriers=(),
        margin=SimpleNamespace(expect=lambda _: done.append("nothing")),
        foresee=lambda *_: done.append("foreseen"),
    )
    following: Any = None if tick is None else SimpleNamespace(tick=tick, applied_by=by, applied=(1.0, 0.0))
    state: Any = SimpleNamespace(tick=7)
    drive_heights._go_on(memory, SimpleNamespace(state=state, latent=None), following)  # type: ignore[arg-type]
    assert done == ["foreseen" if expected else "nothing"]


@pytest.mark.parametrize("size", [0.01, 1.0, 30.0])
@pytest.mark.parametrize(("aside", "told"), [(0.0, True), (0.5, True), (1.5, False), (9.0, False)])
def test_an_error_turns_with_the_heading_where_most_of_it_does_whatever_its_size(
    size: float, aside: float, told: bool
) -> None:
    """cos(yaw) and ``aside`` times what changes its sign twice as often: the correlation is 1 / sqrt(1 + aside^2)."""
    yaws = np.arange(24) * 2.0 * math.pi / 24.0
    forecasts: Any = [SimpleNamespace(began=np.array([0.0, 0.0, yaw, 1.0])) for yaw in yaws]
    errors = size * (np.cos(yaws) + aside * np.cos(2.0 * yaws))
    assert (_heading(CAR, forecasts, errors) != "") is told


@pytest.mark.parametrize(
    ("rows", "shared", "copy"), [(40, 40, True), (40, 21, True), (40, 20, False), (19, 19, False), (20, 20, True)]
)
def test_a_recording_is_a_copy_where_more_than_half_of_its_rows_are_in_another(
    plain: Any, drive: Any, rows: int, shared: int, copy: bool
) -> None:
    """Of twenty rows at least: of fewer nothing is said."""
    whole, other = drive(plain, 10.0, 1, name="whole"), drive(plain, 10.0, 2, name="other")
    states = np.concatenate([whole.states[50 : 50 + shared], other.states[: rows - shared]])
    actions = np.concatenate([whole.actions[50 : 50 + shared], other.actions[: rows - shared]])
    piece = replace(
        other, name="piece", t=other.t[:rows], states=states, actions=actions, stretches=(Stretch(0, rows),)
    )
    for runs in ([piece, whole], [whole, piece]):
        kept, findings = without_repeated(runs)
        assert [run.name for run in kept] == [run.name for run in runs if not (copy and run.name == "piece")]
        assert [(name, finding.count) for name, finding in findings] == ([("piece", shared)] if copy else [])


def test_the_document_of_a_comparison_has_every_horizon_run_and_factor(
    plain: Any, drive: Any, with_effect: Any
) -> None:
    other = with_effect(plain, "viscous_drag", coefficient=0.4)
    runs = [drive(other, 8.0, seed, name=f"run {seed}") for seed in range(2)]
    found = compare_model(plain, runs, 1.0)
    document = as_json(found)
    assert [row["seconds"] for row in document["horizons"]] == [item.seconds for item in found.horizons]
    for row, item in zip(document["horizons"], found.horizons, strict=True):
        assert set(row) == {"seconds", *PREDICTORS}
        for name in PREDICTORS:
            assert row[name]["error"] == pytest.approx(item.errors[name].value, rel=1e-3)
    assert set(document["naive"]) == set(PREDICTORS[1:])
    assert [row["name"] for row in document["runs"]] == ["run 0", "run 1"]
    assert document["explained"].keys() == {item.variable for item in found.factors}
    assert len(document["place"]) == len(found.cells)
    assert (document["windows"], document["horizon"], document["robot"]) == (len(found.windows), 1.0, "car")
    assert document["error"] == pytest.approx(found.error.value, rel=1e-3)
    assert document["parameters"] == {path: setting.value for path, setting in plain.settings.items()}
    assert document["parameters"]["base.drive_gain"] == 3.0
