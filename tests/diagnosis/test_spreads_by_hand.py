"""Roots, divisors and degrees of freedom of what diagnosis states, against values that are written down by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis import detectable
from safedpa.diagnosis.experiment import choice
from safedpa.diagnosis.fit import refinement, trial
from safedpa.diagnosis.fit.elimination import Elimination
from safedpa.diagnosis.fit.least_squares import inverse_of
from safedpa.diagnosis.fit.trial import likeness
from safedpa.diagnosis.remains.dependence import Dependences
from safedpa.diagnosis.remains.weak_form import _sizes
from safedpa.diagnosis.search import revision
from safedpa.diagnosis.search.judgement import _taken_up
from safedpa.diagnosis.search.second_opinion import _Numbers
from safedpa.fleet.alike import _differ_in, _variance
from safedpa.fleet.common import _coin, _wide
from safedpa.fleet.discovery import upper_tail
from safedpa.fleet.outcome import Number, Tried, _evidence
from safedpa.fleet.pooled_evidence import pooled_number


def explains(*values: float) -> Any:
    return SimpleNamespace(explained=np.array(values))


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ((3.0, 4.0), (6.0, 8.0), 1.0), ((3.0, 4.0), (-6.0, -8.0), -1.0), ((3.0, 0.0), (0.0, 5.0), 0.0),
        ((3.0, 4.0), (4.0, 3.0), 0.96), ((5.0, 12.0), (3.0, 4.0), 63 / 65), ((0.0, 0.0), (3.0, 4.0), 0.0),
    ],
)  # fmt: skip
def test_two_trials_are_alike_by_the_cosine_of_what_they_explain(
    one: tuple[float, ...], other: tuple[float, ...], alike: float
) -> None:
    assert likeness(explains(*one), explains(*other)) == pytest.approx(alike)


@pytest.mark.parametrize("sizes", [(1.0, 1.0), (1e-3, 1e3), (100.0, 7.0)])
def test_an_inverse_is_one_whatever_units_the_numbers_have(sizes: tuple[float, float]) -> None:
    """Of [[2, 1], [1, 3]] it is [[3, -1], [-1, 2]] / 5; in other units each entry is divided by both."""
    outer = np.outer(sizes, sizes)
    found = inverse_of(np.array([[2.0, 1.0], [1.0, 3.0]]) * outer)
    np.testing.assert_allclose(found, np.array([[0.6, -0.2], [-0.2, 0.4]]) / outer, rtol=1e-6)


@pytest.mark.parametrize("scale", [(1.0, 1.0), (0.5, 4.0)])
@pytest.mark.parametrize("counts", [1.0, 0.25])
def test_reduced_residuals_are_what_least_squares_leaves_window_by_window(
    scale: tuple[float, float], counts: float
) -> None:
    """Rows count by the root of their counts over the scale of their state; numpy's own solver knows the rest."""
    random, scales = np.random.default_rng(1), np.array(scale)
    weights = np.ones((3, 5, 2))
    weights[1, 2:] = counts
    tangent, columns = random.normal(size=(3, 5, 2, 2)), random.normal(size=(3, 5, 2, 4))
    made = Elimination(weights, tangent)
    reduced = made.reduced(columns, scales)
    squares = made.squares(made.products(columns.transpose(3, 0, 1, 2)), scales)
    left = np.zeros((3, 5, 2, 4))
    for window in range(3):
        root = (np.sqrt(weights[window]) / scales).reshape(-1, 1)
        basis, wanted = root * tangent[window].reshape(-1, 2), root * columns[window].reshape(-1, 4)
        rest = wanted - basis @ np.linalg.lstsq(basis, wanted, rcond=None)[0]
        np.testing.assert_allclose(reduced[window], rest, atol=1e-6)
        left[window] = rest.reshape(5, 2, 4)
    np.testing.assert_allclose(squares, (left**2).sum(axis=(0, 1)) * scales[:, None] ** 2, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize(("each", "left"), [((3, 4), 12), ((4, 4), 16), ((5, 5), 9), ((2, 5, 3), 9), ((40,), 9)])
def test_of_many_starts_so_many_are_spread_from_the_first_to_the_last(
    each: tuple[int, ...], left: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of up to 16; of more 9."""
    names = [SimpleNamespace(name=f"p{n}") for n in range(len(each))]
    monkeypatch.setattr(trial, "_grid", lambda parameter, _: list(range(each[int(parameter.name[1:])])))
    every = [tuple(one.values()) for one in trial.starts_of(SimpleNamespace(parameters=names))]  # type: ignore[arg-type]
    assert len(every) == left
    assert every == sorted(set(every))
    assert (every[0], every[-1]) == ((0,) * len(each), tuple(count - 1 for count in each))


def test_a_function_has_the_deviation_of_a_jackknife_over_folds() -> None:
    """Of three folds with 1, 2 and 6 the variance by n is 14 / 3; times n - 1 that is 28 / 3."""
    parts = np.array([[9.0, 1.0, 5.0], [9.0, 2.0, 5.0], [9.0, 6.0, 5.0]])
    problem: Any = SimpleNamespace(
        solved=lambda _chosen, gram: parts if gram == 7.0 else None, whole=10.0, grams=3.0, always=1,
        coefficients=lambda chosen: np.array([float(chosen[0]), 4.0]),
    )  # fmt: skip
    known = Dependences((), {}, problem, {("x", "v"): [3]}, {}, np.ones(1))
    values, spread = known.values("x", "v")
    assert values.tolist() == [3.0, 4.0]
    np.testing.assert_allclose(spread, [math.sqrt(28 / 3), 0.0])


def test_states_and_actions_have_their_root_mean_square() -> None:
    windows = SimpleNamespace(
        system=SimpleNamespace(state_names=("x", "v"), action_names=("u",)),
        states=np.array([[3.0, 0.0], [-4.0, 0.0], [0.0, 0.0], [0.0, 6.0]]),
        actions=np.array([[2.0], [2.0], [-2.0], [2.0]]),
    )
    assert _sizes(SimpleNamespace(windows=windows)) == {"x": 2.5, "v": 3.0, "u": 2.0}  # type: ignore[arg-type]


@pytest.mark.parametrize("level", [0.01, 0.2])
def test_the_first_noise_is_that_of_the_rows(level: float) -> None:
    """A ramp with white noise: third differences have sqrt(20) times its deviation; pushes are three times it."""
    random, rows = np.random.default_rng(3), 20_000
    states = np.column_stack([np.arange(rows) * 0.1, np.full(rows, 2.0)]) + level * random.normal(size=(rows, 2))
    system = SimpleNamespace(
        difference=lambda one, other: one - other, state=(SimpleNamespace(name="x"), SimpleNamespace(name="speed"))
    )
    noise = refinement._first_noise(None, SimpleNamespace(states=states, system=system))  # type: ignore[arg-type]
    np.testing.assert_allclose(noise.measured, [[level, level]], rtol=0.04)
    np.testing.assert_allclose(noise.pushes, 3.0 * noise.measured[:, 1:])
    assert noise.seconds.tolist() == [1.0]


SCORES = np.array([2.0, 1.0, -1.0, 3.0, 1.0, 2.0])


def innovations(slopes: float = 2.0) -> Any:
    """Six pieces of one innovation and one number: curvature 6 * 4 = 24; scores are slope times innovation."""
    return SimpleNamespace(columns=np.full((6, 1, 1), slopes), white=SCORES[:, None] / slopes)


@pytest.mark.parametrize(
    ("runs", "square"),
    [
        (None, 20 / 576),  # sandwich over pieces: the sum of squares of scores
        ((0, 0, 1, 1, 2, 2), 1.5 * (9 + 4 + 9) / 576),
        ((0, 0, 0, 1, 1, 2), 1.5 * (4 + 16 + 4) / 576),
        ((0, 1, 2, 3, 4, 5), 1.2 * 20 / 576),
    ],
)
def test_a_deviation_is_the_largest_of_the_filter_and_of_sandwiches_over_pieces_and_runs(
    runs: tuple[int, ...] | None, square: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refinement, "_prior", lambda *_: np.zeros((1, 1)))
    monkeypatch.setattr(refinement, "_FEWEST_RUNS", 3)
    given = None if runs is None else np.array(runs)
    found = refinement._deviations(None, ("a.x",), innovations(), given)  # type: ignore[arg-type]
    assert found.tolist() == pytest.approx([math.sqrt(max(square, 1 / 24))])


@pytest.mark.parametrize(("change", "settled"), [(0.09, True), (-0.09, True), (0.11, False), (-0.11, False)])
def test_numbers_are_settled_where_none_moves_by_a_tenth_of_its_deviation(
    change: float, settled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def model(**values: float) -> Any:
        return SimpleNamespace(settings={name: SimpleNamespace(value=value) for name, value in values.items()})

    monkeypatch.setattr(refinement, "_deviations", lambda *_: np.array([1.0, 10.0]))
    before, after = model(a=1.0, b=5.0), model(a=1.0 + change, b=5.5)
    assert refinement._settled(before, after, ("a", "b"), None) is settled  # type: ignore[arg-type]


def test_what_windows_and_filter_say_in_deviations() -> None:
    """w = (2, 4), f = (1, -3), s = (0.5, 2): away 2 and 1.5; left (8 - 3) / (16 + 4)."""
    said = _Numbers(np.array([2.0, 4.0]), np.array([1.0, -3.0]), np.array([0.5, 2.0]))
    assert said.away.tolist() == [2.0, 1.5]
    assert said.left == pytest.approx(0.25)


@pytest.mark.parametrize(("tried", "enough"), [((1.0,), None), ((1.0, 3.0), 3.0), ((0.5, 2.0, 3.0), 2.0)])
def test_the_smallest_size_that_passes(
    tried: tuple[float, ...], enough: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: errors 3 and 0; an ordinary size adds 4 and 1: of size 2 the root of 9 + 64 and 2, 1 - 3 / 10.54."""
    seen: list[tuple[float, list[float], list[float]]] = []

    def sure(squares: Any, products: Any, *_: Any) -> bool:
        seen.append((len(seen), squares.tolist(), products.tolist()))
        return bool(float(squares.sum()) >= 4.0 * 5.0)

    monkeypatch.setattr(detectable, "_SIZES", tried)
    monkeypatch.setattr(detectable, "_taken", lambda _: False)
    monkeypatch.setattr(detectable, "_sure", sure)
    monkeypatch.setattr(detectable, "_CERTAIN", math.inf)
    monkeypatch.setattr(detectable, "LITTLE_FALL", 0.2)
    moved: Any = SimpleNamespace(
        whole=np.ones((1, 2)), left=np.array([[1.0, 2.0]]), ends=np.array([4.0, 1.0]), item=SimpleNamespace(name="a"),
    )  # fmt: skip
    null: Any = SimpleNamespace(fit=SimpleNamespace(residual=np.array([[3.0, 1.0]])))
    shooting: Any = SimpleNamespace(squares=lambda left: left**2)
    error: Any = SimpleNamespace(per_state=np.array([3.0, math.nan]))
    assert detectable._passing(moved, null, shooting, error, 1.0) == enough
    falls = [1.0 - 3.0 / (math.sqrt(9.0 + 16.0 * size**2) + size) for size in tried]
    asked = [size for size, fall in zip(tried, falls, strict=True) if fall > 0.2]
    asked = asked[: asked.index(enough) + 1] if enough else asked
    assert [squares for _, squares, _ in seen] == [[5.0 * size**2] for size in asked]
    assert [products for *_, products in seen] == [[10.0 * size] for size in asked]


def test_the_edge_below_which_a_fall_is_little_is_that_of_the_root_of_the_squares(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """3 and 4 make 5: the error falls by 0.4 of it, neither more nor less."""
    moved: Any = SimpleNamespace(
        whole=np.ones((1, 1)), left=np.array([[1.0]]), ends=np.array([4.0]), item=SimpleNamespace(name="a")
    )
    null: Any = SimpleNamespace(fit=SimpleNamespace(residual=np.array([[1.0]])))
    shooting: Any = SimpleNamespace(squares=lambda left: left**2)
    error: Any = SimpleNamespace(per_state=np.array([3.0]))
    monkeypatch.setattr(detectable, "_SIZES", (1.0,))
    monkeypatch.setattr(detectable, "_taken", lambda _: False)
    monkeypatch.setattr(detectable, "_sure", lambda *_: True)
    for little, found in ((0.399, 1.0), (0.401, None)):
        monkeypatch.setattr(detectable, "LITTLE_FALL", little)
        assert detectable._passing(moved, null, shooting, error, 1.0) == found


@pytest.mark.parametrize(("drive", "differs"), [("slow", 0.5), ("fast", 3.0)])
def test_a_manoeuvre_tells_models_apart_by_the_root_mean_square_in_units_of_the_noise(
    drive: str, differs: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two states with noise 0.1 and 2: a model's difference is as many times the noise in each."""
    drives = {"slow": ("slow", None), "fast": ("fast", None), "still": ("still", None)}
    times = {"slow": 0.5, "fast": differs if drive == "fast" else 0.75, "still": 0.0}
    noise = np.array([0.1, 2.0])

    def driven(model: Any, start: str, _: Any) -> Any:
        return model * times[start] * noise * np.ones((4, 2)) * np.array([1.0, -1.0])

    monkeypatch.setattr(choice, "manoeuvres", lambda _: drives)
    monkeypatch.setattr(choice, "_driven", driven)
    told: Any = choice.telling_manoeuvres(0.0, [1.0, 0.5, 4.0], noise)  # type: ignore[arg-type, list-item]
    most = max(times.values())
    assert told == ["fast" if most * size >= 1.0 else "" for size in (1.0, 0.5, 4.0)]
    models: Any = {"one": 0.0, "two": 1.0, "three": 3.0}
    found = choice.chosen_experiment(models, noise)
    assert found is not None
    if most >= 1.0:
        assert f"differ there by {most:.0f} times the noise" in found.why
        assert found.manoeuvre == "fast"
    else:
        assert "fast" not in str(found)


@pytest.mark.parametrize(("correlated", "pairs"), [(0.99, [("a", "b")]), (0.1, []), (-0.99, [("a", "b")])])
@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_effects_go_in_pairs_where_their_numbers_are_correlated(
    correlated: float, pairs: list[tuple[str, ...]], size: float
) -> None:
    """The covariance is C = D R D with R's one correlation; columns with J'J = C^-1. A unit has no say."""
    covariance = np.array([[1.0, correlated * size, 0.0], [correlated * size, size**2, 0.0], [0.0, 0.0, 4.0]])
    columns = np.linalg.cholesky(np.linalg.inv(covariance)).T[None]
    fitted = SimpleNamespace(columns=columns, paths=("a.x", "b.y", "c.z"))
    search: Any = SimpleNamespace(added=["a", "b", "c"], current=SimpleNamespace(fit=fitted))
    assert revision._groups(search) == [("a",), ("b",), ("c",), *pairs]
    search.added = ["a", "b"]
    assert revision._groups(search) == [("a",), ("b",)], "never all of them"


@pytest.mark.parametrize(
    ("new", "taken"), [((0.0, 5.0, 0.0), "a.y"), ((-3.0, 0.0, 0.0), "a.x"), ((0.0, 5.0, 5.0), ""), ((0.0, 0, 0), "")]
)
def test_a_free_number_that_does_the_same_is_named(new: tuple[float, ...], taken: str) -> None:
    """Of two free ones, one of them a thousand times as large as the other."""
    columns = np.array([[1000.0, 0.0, 0.0], [0.0, 1.0, 0.0], list(new)]).T.reshape(1, 3, 3)
    trial: Any = SimpleNamespace(fit=SimpleNamespace(columns=columns), effects=("b",))
    null: Any = SimpleNamespace(fit=SimpleNamespace(paths=("a.x", "a.y")))
    assert _taken_up(trial, null) == taken


@pytest.mark.parametrize(
    ("deviate", "tail"), [(0.0, 0.5), (1.0, 0.158655), (1.959964, 0.025), (-1.0, 0.841345), (3.0, 0.00134990)]
)
def test_the_upper_tail_is_that_of_the_tables(deviate: float, tail: float) -> None:
    assert upper_tail(deviate) == pytest.approx(tail, rel=1e-5)


@pytest.mark.parametrize(("hits", "trials"), [(30, 51), (40, 60), (70, 100), (26, 52), (540, 1000)])
def test_many_coins_are_nearly_those_that_are_counted_out(hits: int, trials: int) -> None:
    counted = sum(math.comb(trials, k) for k in range(hits, trials + 1)) / 2**trials
    assert _coin(hits, trials) == pytest.approx(counted, rel=0.25)


def number(value: float, std: float = math.nan) -> Number:
    return Number(value, std, "1")


def test_a_pooled_number_by_hand() -> None:
    """Values 1, 2, 6 with deviation 1: weights 1, centre 3, surplus 14 - 2 = 12, size 3 - 1 = 2, spread sqrt(6)."""
    found = pooled_number([number(1.0, 1.0), number(2.0, 1.0), number(6.0, 1.0)])
    assert found.mean == pytest.approx(3.0)
    assert (found.low, found.high, found.robots, found.stated) == (1.0, 6.0, 3, 1.0)
    assert found.spread == pytest.approx(math.sqrt(6.0))
    assert found.std == pytest.approx(math.sqrt(7.0 / 3.0))


def test_robots_that_are_surer_count_more_in_what_is_pooled() -> None:
    """Deviations 1 and 2 of 0 and 1: nothing beyond them: weights 1 and 1 / 4, mean 0.2, deviation 1 / sqrt(1.25)."""
    found = pooled_number([number(0.0, 1.0), number(1.0, 2.0)])
    assert found.spread == 0.0
    assert [found.mean, found.std] == pytest.approx([0.2, 1.25**-0.5])
    again = pooled_number([number(0.0, 1.0), number(1.0, 2.0), number(0.2)])
    assert (again.stated, again.spread) == (1.5, 0.0)
    assert again.std == pytest.approx((1.25 + 1.0 / 2.25) ** -0.5)


@pytest.mark.parametrize(
    ("one", "other", "square"), [(3.0, 4.0, 25.0), (0.5, 0.0, 0.25), (0.0, 0.0, math.inf), (math.nan, 1.0, math.inf)]
)
def test_a_difference_has_both_variances(one: float, other: float, square: float) -> None:
    assert _variance(number(0.0, one), number(0.0, other)) == square


@pytest.mark.parametrize(("std", "differ"), [(0.01, True), (3.0, False), (0.5, False), (0.0, False)])
def test_numbers_differ_where_they_do_widely_and_surely(
    std: float, differ: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """5 and 6 off: the change (2, -2), of sizes 3.6 and 5 by hand; surely is three deviations here."""
    monkeypatch.setattr("safedpa.fleet.alike.neutral_of", lambda *_: 1.0)
    monkeypatch.setattr("safedpa.fleet.alike.APART", 0.5)
    monkeypatch.setattr("safedpa.fleet.alike.SURELY", 4.1)
    one, other = ({"x": number(x, std), "y": number(y, std)} for x, y in ((4.0, 3.0), (2.0, 5.0)))
    assert _differ_in("a", ("x", "y"), one, other, "car") is differ


@pytest.mark.parametrize(("std", "differ"), [(0.48, True), (0.50, False)])
def test_surely_is_counted_in_both_deviations_together(
    std: float, differ: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """4 / (2 s^2) over 2.9^2 up to s = 0.4877."""
    monkeypatch.setattr("safedpa.fleet.alike.neutral_of", lambda *_: 0.0)
    monkeypatch.setattr("safedpa.fleet.alike.APART", 0.1)
    monkeypatch.setattr("safedpa.fleet.alike.SURELY", 2.9)
    assert _differ_in("a", ("x",), {"x": number(3.0, std)}, {"x": number(1.0, std)}, "car") is differ


@pytest.mark.parametrize(("apart", "differ"), [(0.9, True), (1.1, False)])
def test_widely_is_counted_by_half_of_both_sizes(apart: float, differ: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """3 and 1 from doing nothing: a change of 2, half of both is 2."""
    monkeypatch.setattr("safedpa.fleet.alike.neutral_of", lambda *_: 1.0)
    monkeypatch.setattr("safedpa.fleet.alike.APART", apart)
    monkeypatch.setattr("safedpa.fleet.alike.SURELY", 1.0)
    assert _differ_in("a", ("x",), {"x": number(4.0, 0.1)}, {"x": number(2.0, 0.1)}, "car") is differ


@pytest.mark.parametrize(("spread", "wide"), [(0.99, True), (0.95, False)])
def test_a_number_is_wide_where_it_spreads_by_half_of_what_sets_two_apart(
    spread: float, wide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("safedpa.fleet.common.neutral_of", lambda *_: 1.0)
    monkeypatch.setattr("safedpa.fleet.common.APART", 0.65)
    pooled: Any = SimpleNamespace(mean=4.0, spread=spread)
    assert _wide("car", "a", "x", pooled) is wide, "the change is 3, and 0.325 of it 0.975"


@pytest.mark.parametrize(
    ("score", "numbers", "evidence"),
    [
        (50.0, {"x": number(9.0, 0.1)}, 50.0),
        (0.5, {"x": number(9.0, 0.5)}, 16.0 / 3.0),
        (0.5, {"x": number(9.0, 4.0), "y": number(-3.0, 0.5)}, 8.0 / 3.0),
        (0.5, {"x": number(9.0, 0.0), "y": number(2.0)}, 0.5),
        (2.0, {"x": number(1.5, 0.5)}, 2.0),
    ],
)
def test_evidence_of_a_robot_is_that_of_blocks_or_a_third_of_the_filters(
    score: float, numbers: dict[str, Number], evidence: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("safedpa.fleet.outcome.neutral_of", lambda *_: 1.0)
    monkeypatch.setattr("safedpa.fleet.outcome._BLOCKS", 10.0)
    monkeypatch.setattr("safedpa.fleet.outcome._BY_FILTER", 3.0)
    assert _evidence(Tried("a", numbers, score, ()), "car") == pytest.approx(evidence)
