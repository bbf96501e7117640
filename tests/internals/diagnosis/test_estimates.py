"""Roots, divisors and degrees of freedom of what a diagnosis states, compared with values worked out by hand."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis import detectable
from safedpa.diagnosis.fit import prediction_error_method
from safedpa.diagnosis.fit.cross_validation import heldout_of
from safedpa.diagnosis.fit.kalman import _whitened
from safedpa.diagnosis.fit.multiple_shooting import _row_weights, _trimmed_scale, shooting_of
from safedpa.diagnosis.fit.trial import fit_trial
from safedpa.diagnosis.residuals.dependence import Dependences
from safedpa.diagnosis.residuals.unmodelled import _block_statistic
from safedpa.diagnosis.residuals.weak_sindy import usual_sizes
from safedpa.diagnosis.search.conditional import _fit_law
from safedpa.diagnosis.search.conditional_screen import ConditionalCandidate, _NormalEquations
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.diagnosis.search.search_state import accept_trial
from safedpa.dynamics import load_model
from safedpa.effects import Where, effect
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case


def test_a_function_has_the_deviation_of_a_jackknife_over_folds() -> None:
    """Of three folds with 1, 2 and 6 the variance by n is 14 / 3; times n - 1 that is 28 / 3."""
    parts = np.array([[9.0, 1.0, 5.0], [9.0, 2.0, 5.0], [9.0, 6.0, 5.0]])
    problem: Any = SimpleNamespace(
        solve=lambda _chosen, gram: parts if gram == 7.0 else None, whole=10.0, grams=3.0, always=1,
        coefficients=lambda chosen: np.array([float(chosen[0]), 4.0]),
    )  # fmt: skip
    values, spread = Dependences((), {}, problem, {("x", "v"): [3]}, {}, np.ones(1)).values("x", "v")
    assert values.tolist() == [3.0, 4.0]
    np.testing.assert_allclose(spread, [math.sqrt(28 / 3), 0.0])


def test_states_and_actions_are_scaled_by_their_root_mean_square() -> None:
    windows = SimpleNamespace(
        system=SimpleNamespace(state_names=("x", "v"), action_names=("u",)),
        states=np.array([[3.0, 0.0], [-4.0, 0.0], [0.0, 0.0], [0.0, 6.0]]),
        actions=np.array([[2.0], [2.0], [-2.0], [2.0]]),
    )
    assert usual_sizes(SimpleNamespace(windows=windows)) == {"x": 2.5, "v": 3.0, "u": 2.0}  # type: ignore[arg-type]


@pytest.mark.parametrize("level", [0.01, 0.2])
def test_the_first_noise_is_that_of_the_rows(level: float) -> None:
    """A ramp with white noise: third differences have sqrt(20) times its deviation; pushes are three times it."""
    random, rows = np.random.default_rng(3), 20_000
    states = np.column_stack([np.arange(rows) * 0.1, np.full(rows, 2.0)]) + level * random.normal(size=(rows, 2))
    state = (SimpleNamespace(name="x"), SimpleNamespace(name="speed"))
    system = SimpleNamespace(difference=lambda one, other: one - other, state=state)
    noise = prediction_error_method._initial_noise(SimpleNamespace(states=states, system=system))  # type: ignore[arg-type]
    np.testing.assert_allclose(noise.measured, [[level, level]], rtol=0.04)
    np.testing.assert_allclose(noise.disturbances, 3.0 * noise.measured[:, 1:])
    assert noise.seconds.tolist() == [1.0]


@pytest.mark.parametrize(
    ("runs", "square"),
    [
        (None, 20 / 576),  # sandwich over pieces: the sum of squares of scores
        ((0, 0, 1, 1, 2, 2), 1.5 * (9 + 4 + 9) / 576), ((0, 0, 0, 1, 1, 2), 1.5 * (4 + 16 + 4) / 576),
        ((0, 1, 2, 3, 4, 5), 1.2 * 20 / 576),
    ],
)  # fmt: skip
def test_a_deviation_is_the_largest_of_the_filter_and_of_sandwiches_over_pieces_and_runs(runs, square, monkeypatch):
    """Six pieces of one innovation and one number: curvature 6 * 4 = 24; scores are slope times innovation."""
    scores = np.array([2.0, 1.0, -1.0, 3.0, 1.0, 2.0])
    innovations: Any = SimpleNamespace(columns=np.full((6, 1, 1), 2.0), white=scores[:, None] / 2.0)
    monkeypatch.setattr(prediction_error_method, "prior_curvature", lambda *_: np.zeros(1))
    monkeypatch.setattr(prediction_error_method, "_MIN_RUNS", 3)
    given = None if runs is None else np.array(runs)
    found = prediction_error_method._deviations(None, ("a.x",), innovations, given)  # type: ignore[arg-type]
    assert found.tolist() == pytest.approx([math.sqrt(max(square, 1 / 24))])


@pytest.mark.parametrize(("change", "settled"), [(0.09, True), (-0.09, True), (0.11, False), (-0.11, False)])
def test_parameters_have_converged_if_none_moves_by_a_tenth_of_its_deviation(change, settled, monkeypatch):
    def model(**values: float) -> Any:
        return SimpleNamespace(settings={name: SimpleNamespace(value=value) for name, value in values.items()})

    monkeypatch.setattr(prediction_error_method, "_deviations", lambda *_: np.array([1.0, 10.0]))
    before, after = model(a=1.0, b=5.0), model(a=1.0 + change, b=5.5)
    assert prediction_error_method._has_converged(before, after, ("a", "b"), None) is settled  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("sizes", "little", "enough"),
    [((1.0,), 0.2, None),
     ((1.0, 3.0), 0.2, 3.0), ((0.5, 2.0, 3.0), 0.2, 2.0), ((3.0,), 0.80, 3.0), ((3.0,), 0.81, None)],
)  # fmt: skip
def test_the_smallest_detectable_size_passes_by_its_squares_and_by_its_fall(sizes, little, enough, monkeypatch):
    """Errors 3 and 0 before, 4 and 1 added at ordinary size: of size 3 sqrt(9 + 144) + 3, a fall of 0.805."""
    asked: list[tuple[list[float], list[float]]] = []

    def sure(squares: Any, products: Any, *_: Any) -> bool:
        asked.append((squares.tolist(), products.tolist()))
        return bool(float(squares.sum()) >= 4.0 * 5.0)

    monkeypatch.setattr(detectable, "_SIZES", sizes)
    monkeypatch.setattr(detectable, "_is_absorbed", lambda _: False)
    monkeypatch.setattr(detectable, "_passes_reliably", sure)
    monkeypatch.setattr(detectable, "_CERTAIN", math.inf)
    monkeypatch.setattr(detectable, "LITTLE_FALL", little)
    moved: Any = SimpleNamespace(
        whole=np.ones((1, 2)), remaining=np.array([[1.0, 2.0]]), ends=np.array([4.0, 1.0]),
        item=SimpleNamespace(name="a"),
    )  # fmt: skip
    null: Any = SimpleNamespace(fit=SimpleNamespace(residual=np.array([[3.0, 1.0]])))
    shooting: Any = SimpleNamespace(squares=lambda left: left**2)
    error: Any = SimpleNamespace(per_state=np.array([3.0, math.nan]))
    assert detectable._passing(moved, null, shooting, error, 1.0) == enough
    falls = {size: 1.0 - 3.0 / (math.sqrt(9.0 + 16.0 * size**2) + size) for size in sizes}
    fit_trial = [size for size in sizes if falls[size] > little and (enough is None or size <= enough)]
    assert asked == [([5.0 * size**2], [10.0 * size]) for size in fit_trial]


def weights(pushes: dict[int, tuple[float, float]], *, short: tuple[int, ...] = ()) -> Any:
    """Of 100 windows whose two states are off by 1 and 1000 units, to one side or the other; some by more."""
    off = np.where(np.arange(100) % 2, 1.0, -1.0)[:, None] * np.ones(2)
    for window, times in pushes.items():
        off[window] *= times
    residual = np.repeat((off * np.array([1.0, 1000.0]))[:, None], 8, axis=1)
    steps = np.where(np.isin(np.arange(100), short), 4, 8)
    return _row_weights(SimpleNamespace(windows=SimpleNamespace(steps=steps), rows=np.arange(1, 9)), residual)  # type: ignore[arg-type]


def test_a_disturbed_window_is_weighted_by_the_inverse_square_of_its_residual() -> None:
    """Each state is weighed in its own unit, and each window by its own rows."""
    found = weights({10: (40.0, 40.0), 11: (80.0, 80.0), 13: (160.0, 160.0), 20: (40.0, 1.0), 21: (1.0, 40.0)})
    own = found[:, 0, 0]
    assert np.ptp(found[10]) == 0.0
    assert (own[[0, 1, 2, 50, 99]] == 1.0).all()
    assert [own[10] / own[11], own[10] / own[13]] == pytest.approx([4.0, 16.0])
    assert 0.0 < own[10] < own[20] < 1.0
    assert own[20] == pytest.approx(own[21])
    found = weights({30: (40.0, 40.0), 31: (40.0, 40.0)}, short=(31, 33))
    assert (found[30, 0, 0], found[33, 0, 0]) == (pytest.approx(found[31, 0, 0]), 1.0)
    assert found[31, :, 0].tolist() == [found[31, 0, 0]] * 4 + [0.0] * 4, "rows beyond the end of a short window"


def test_the_trimmed_scale_is_the_root_mean_square_without_the_largest_5_percent() -> None:
    """Of 3 and 4 it is the root of 12.5; a row with a count of 0 is left out; of one row it is itself; never 0."""
    residual = np.array([[3.0, 0.0], [-4.0, 0.0]] * 19 + [[900.0, 0.0], [-900.0, 0.0]]).reshape(40, 1, 2)
    there = np.ones_like(residual)
    assert _trimmed_scale(residual, there).tolist() == pytest.approx([12.5**0.5, 1e-7])
    residual[0], there[0] = 1e9, 0.0
    assert _trimmed_scale(residual, there)[0] == pytest.approx((466.0 / 37.0) ** 0.5)
    few, counts = np.array([[[3.0]], [[9.0]]]), np.array([[[1.0]], [[0.0]]])
    assert _trimmed_scale(few, counts) == pytest.approx([3.0])


def test_a_gain_over_a_function_is_in_standard_errors_of_the_sum_of_blocks() -> None:
    """Four blocks whose sums are 1, 2, 3 and 6: sum 12, deviation sqrt(14 / 3), its error twice that."""
    difference, block = np.array([0.5, 0.5, 2.0, 1.0, 2.0, 4.0, 2.0]), np.array([0, 0, 2, 3, 3, 5, 5])
    assert _block_statistic(difference, block) == pytest.approx(12.0 / (2.0 * math.sqrt(14.0 / 3.0)))
    assert _block_statistic(difference, np.zeros(7, dtype=int)) == 0.0


@pytest.fixture(scope="module")
def floor(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A search that took a carpet beyond a line for a resistance everywhere."""
    carpet = {"rolling_resistance": {"deceleration": 0.9, "x_above": 0.4}}
    case = Case("test", 11, carpet, laws={"rolling_resistance": "where x above"}, runs=2, seconds=15.0)
    log = write_case(case, tmp_path_factory.mktemp("floor"))
    model = load_model(str(log.model))
    runs = [load_run(path, model.system) for path in log.runs]
    heldout = heldout_of(runs, 1.0)
    search = initial_search(model, shooting_of(runs, 1.0), heldout)
    accept_trial(search, fit_trial(search.current, [effect("car", "rolling_resistance")], search.shooting))
    return search


@pytest.mark.parametrize("begin", [(0.0, 0.9), (1.0, 0.45), (2.0, 0.1), (2.0, 0.45), (2.0, 0.9)])
def test_a_law_is_not_fitted_with_the_slopes_of_the_plain_effect(floor: Any, begin: tuple[float, float]) -> None:
    start = dict(zip(("x_above", "deceleration"), begin, strict=True))
    item = effect("car", "rolling_resistance")
    found = _fit_law(floor, ConditionalCandidate(item, Where("above", "x", 0.05), start))
    settings = found.fit.model.settings  # type: ignore[union-attr]
    assert settings["rolling_resistance.x_above"].value == pytest.approx(0.4, abs=0.1)
    assert settings["rolling_resistance.deceleration"].value == pytest.approx(0.9, abs=0.05)


@pytest.mark.parametrize("paths", [0, 1, 5])
def test_screened_laws_equal_a_linear_fit_of_each(paths: int) -> None:
    """The fall of unseen squares of each window, all numbers fitted without its fold by NumPy's least squares."""
    random = np.random.default_rng(paths)
    columns, column, residual = (random.normal(size=(24, 9, *more)) for more in ((paths,), (), ()))
    laws, fold = random.random((3, 24)), np.arange(24) % 4
    null: Any = SimpleNamespace(fit=SimpleNamespace(residual=residual, columns=columns))
    falls, values = _NormalEquations(null, SimpleNamespace(fold=fold)).reductions(column, laws)  # type: ignore[arg-type]
    assert values.shape == (3, paths + 1)
    for law in range(3):
        wide = np.concatenate([columns, (laws[law][:, None] * column)[..., None]], axis=-1)
        wanted = np.zeros(24)
        for own in np.unique(fold):
            for sign, used in ((1.0, columns), (-1.0, wide)):
                target = residual[fold != own].reshape(-1)
                values = -np.linalg.lstsq(used[fold != own].reshape(len(target), used.shape[-1]), target)[0]
                wanted[fold == own] += sign * ((residual + used @ values)[fold == own] ** 2).sum(axis=1)
        np.testing.assert_allclose(falls[law], wanted, rtol=1e-6, atol=1e-6)


def test_whitening_uses_the_cholesky_factor() -> None:
    random = np.random.default_rng(2)
    root, right = random.normal(size=(5, 7, 3, 3)), random.normal(size=(5, 7, 3, 4))
    total = root @ root.swapaxes(-1, -2) + np.eye(3)
    found, log = _whitened(total, right)
    np.testing.assert_allclose(found, np.linalg.solve(np.linalg.cholesky(total), right), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(log, np.linalg.slogdet(total)[1], rtol=1e-12, atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError, match="not positive"):
        _whitened(-total, right)
