"""Gains on unseen blocks in standard errors, how much alike two explanations are, and pushes that are cut."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from safedpa.diagnosis.experiment import choice
from safedpa.diagnosis.fit.trial import block_gain, likeness
from safedpa.diagnosis.remains.weak_form import Regression
from safedpa.diagnosis.search.patch import capped
from safedpa.diagnosis.search.places import Strip


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


def test_steady_gains_of_few_blocks_are_no_proof() -> None:
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
def test_a_regression_is_sure_by_the_sum_of_blocks_over_its_standard_error_with_glitches_cut(
    gains: list[float], blocks: int, most: float
) -> None:
    sums = np.minimum(gains, most).reshape(blocks, -1).sum(axis=1)
    wanted = sums.sum() / (sums.std(ddof=1) * math.sqrt(blocks))
    problem = regression(blocks, len(gains) // blocks)
    before, after = np.array(gains) + 7.0, np.full(len(gains), 7.0)
    for size in (1.0, 100.0):
        assert problem.sure(size * before, size * after) == pytest.approx(wanted, rel=1e-9)
    assert problem.sure(after, before) == pytest.approx(-wanted, rel=1e-9)


def test_with_fewer_than_eight_blocks_a_regression_is_sure_of_nothing() -> None:
    assert regression(7, 3).sure(np.full(21, 2.0), np.ones(21)) == 0.0
    assert regression(8, 3).sure(np.full(24, 2.0), np.linspace(0.5, 1.0, 24)) > 0.0


def test_with_nothing_to_gain_two_standard_errors_are_exceeded_in_one_case_of_twenty() -> None:
    random, problem = np.random.default_rng(11), regression(60, 10)
    found = np.array([problem.sure(random.normal(0.0, 30.0, 600), np.zeros(600)) for _ in range(2000)])
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
def test_two_trials_are_alike_by_the_cosine_of_what_they_explain(
    one: Any, other: Any, alike: float, size: float
) -> None:
    assert likeness(explains(one), explains(size * np.array(other))) == pytest.approx(alike)
    assert likeness(explains(size * np.array(other)), explains(one)) == pytest.approx(alike)


@pytest.mark.parametrize(
    ("sizes", "largest"),
    [((1.0,) * 19 + (100.0,), 6.0), ((1.0,) * 6 + (10.0,) * 4, 10.0), ((0.5,) * 19 + (100.0,), 3.0), ((2.0,) * 5, 2.0)],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_pushes_are_cut_at_six_medians_or_at_what_a_tenth_exceeds(sizes: Any, largest: float, sign: float) -> None:
    found = capped(sign * np.array(sizes)[:, None] * np.array([1.0, 1e-3]))
    assert np.abs(found).max(axis=0) == pytest.approx([largest, 1e-3 * largest], abs=1e-8)
    assert (np.sign(found) == sign).all()
    np.testing.assert_allclose(found[0], sign * sizes[0] * np.array([1.0, 1e-3]))


def test_strips_on_the_floor_are_tried_in_directions_evenly_over_half_a_turn() -> None:
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    starts = list(Strip().starts(points))
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


@pytest.mark.parametrize(("times", "told"), [((0.5, 0.75), ""), ((0.5, 3.0), "second"), ((3.0, 0.5), "first")])
def test_the_next_experiment_separates_models_most_in_units_of_the_noise(
    times: tuple[float, float], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise 0.1 and 2: the root mean square of the difference over it is the same in both states."""
    start, rows = np.zeros(2), np.zeros((8, 1))
    monkeypatch.setattr(choice, "manoeuvres", lambda _: {"first": (start, rows), "second": (start, rows + 1.0)})
    models: Any = {name: Drifting(size, times) for name, size in (("one", 0.0), ("two", 1.0), ("three", 3.0))}
    noise, most = np.array([0.1, 2.0]), max(times)
    others: Any = [Drifting(size, times) for size in (1.0, 0.3, 4.0)]
    own: Any = Drifting(0.0, times)
    best = "first" if times[0] > times[1] else "second"
    found = choice.telling_manoeuvres(own, others, noise)
    assert found == [best if most * size >= 1.0 else "" for size in (1.0, 0.3, 4.0)]
    experiment = choice.chosen_experiment(models, noise)
    assert experiment is not None
    assert (experiment.manoeuvre == told) is bool(told)
    assert (f"differ there by {most:.0f} times the noise" in experiment.why) is bool(told)
    assert choice.chosen_experiment({"one": own}, noise) is None
