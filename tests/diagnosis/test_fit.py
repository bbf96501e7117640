"""Fits and their deviations: lost filters, bounds, free numbers, quick ways, and the filter along recordings."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st

from safedpa.comparison.windows import windows_of
from safedpa.diagnosis.detectable import standardized_gain
from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.fit.data_checks import data_at_horizon
from safedpa.diagnosis.fit.kalman import LinearizedTrajectory, Noise, kalman_innovations
from safedpa.diagnosis.fit.least_squares import Fit, fit, known_slopes, with_values
from safedpa.diagnosis.fit.prediction_error_method import PredictionErrorFit, prediction_error_fit
from safedpa.diagnosis.fit.trial import standardized_gains
from safedpa.diagnosis.report_schema import as_document
from safedpa.diagnosis.search import final_parameters
from safedpa.diagnosis.search.final_parameters import with_final_values
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.errors import ModelFileError
from safedpa.records import load_run
from safedpa.report.diagnosis_story import report_text
from safedpa_lab.hidden import Case, write_case


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    case = Case("test", 6, {"rolling_resistance": {"deceleration": 0.3}}, runs=4, seconds=15.0)
    log = write_case(case, tmp_path_factory.mktemp("deviations"))
    model = load_model(str(log.model))
    return model, [load_run(str(path), model.system) for path in log.runs]


def fitted(given, name, **values):
    model, runs = given
    item = effect("car", name)
    model = model.with_effect(item, {key: Setting(value) for key, value in values.items()})
    evidence = data_at_horizon(runs, 1.0)
    shooting = evidence.shooting.around(model)
    found = fit(model, [f"{name}.{key}" for key in values], shooting, np.full(4, 0.01))
    return found, shooting, evidence.heldout


def lost(found, values):
    """A filter that ended elsewhere."""
    model = with_values(found.model, dict(zip(found.paths, values, strict=True)))
    return lambda *_: PredictionErrorFit(model, found.paths, np.full(len(values), 0.1), None)


@pytest.mark.parametrize("away", [1e9, 0.9], ids=["at_its_bound", "far"])
def test_a_diverged_filter_does_not_inflate_a_deviation(away, given, monkeypatch):
    found, shooting, heldout = fitted(given, "rolling_resistance", deceleration=0.3)
    own = found.deviations(shooting)[0]
    assert own < 0.01
    high = found.model.parameters["rolling_resistance.deceleration"].high
    monkeypatch.setattr(final_parameters, "prediction_error_fit", lost(found, [min(away, high)]))
    final, _ = with_final_values(found, shooting, heldout)
    assert final.values[0] == found.values[0]
    assert own <= final.deviations(shooting)[0] < 4.0 * own


def at_a_bound(columns, residual):
    """The deviation of a drag of 0, by slopes and residuals in units of the noise (windows,)."""
    model = load_model("car").with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.0)})
    slopes, left = np.array(columns)[:, None, None], np.array(residual)[:, None]
    nothing = (np.zeros((1, 1)), np.zeros(1))
    paths, free = ("viscous_drag.coefficient",), np.array([False])
    found = Fit(model, paths, 0.0, np.ones(1), left, slopes, slopes[..., None, :], free, nothing)
    return float(found.deviations(None)[0])


@pytest.mark.parametrize(
    ("columns", "residual", "wanted"),
    [
        ([4.0], [3.0], (160**0.5 - 12.0) / 16.0),  # 2 x 12 d + 16 d^2 = 1
        ([3.0, 4.0], [4.0, -3.0], 1.0 / 5.0),  # without a slope it is that of a line
        ([0.0], [3.0], np.nan),  # the data say nothing
    ],
)
def test_at_a_bound_the_deviation_is_one_sided(columns, residual, wanted):
    assert at_a_bound(columns, residual) == pytest.approx(wanted, nan_ok=True)


@settings(max_examples=30, deadline=None)
@drawn(st.integers(0, 10_000))
def test_over_the_deviation_at_a_bound_the_squares_grow_by_one(seed):
    random = np.random.default_rng(seed)
    columns, residual = random.normal(0.0, 5.0, 40), random.normal(0.0, 2.0, 40)
    far = at_a_bound(columns, residual)
    away = np.sign(columns @ residual) * columns  # into the side on which the squares grow
    assert ((residual + far * away) ** 2).sum() - (residual**2).sum() == pytest.approx(1.0)


def test_runs_that_differ_make_the_deviation_larger(given):
    """Each run with another truth: blocks within a run agree, runs do not."""
    found, shooting, _ = fitted(given, "rolling_resistance", deceleration=0.3)
    sides = np.where(shooting.windows.run % 2 == 0, 1.0, -1.0)
    shifted = replace(found, residual=found.residual + 0.05 * sides[:, None] * found.columns[..., 0])
    of_runs = shifted.deviations(shooting)[0]
    one_run = replace(shooting, windows=replace(shooting.windows, run=np.zeros_like(shooting.windows.run)))
    assert of_runs > 1.5 * shifted.deviations(one_run)[0]
    assert 0.01 < of_runs < 0.05


@pytest.mark.parametrize(
    ("name", "values"), [("steering_saturation", {"limit": 0.3}), ("viscous_drag", {"coefficient": 0.2})]
)
def test_an_effect_with_a_corner_has_the_deviation_of_the_windows_where_that_is_larger(
    given, name, values, monkeypatch
):
    """The filter follows slopes, which say nothing of a corner; of a smooth effect its deviation stands."""
    found, shooting, heldout = fitted(given, name, **values)
    certain = PredictionErrorFit(found.model, found.paths, np.full(1, 1e-9), None)
    monkeypatch.setattr(final_parameters, "prediction_error_fit", lambda *_: certain)
    stated = with_final_values(found, shooting, heldout)[0].deviations(shooting)
    wanted = found.deviations(shooting) if name == "steering_saturation" else [1e-9]
    np.testing.assert_allclose(stated, wanted)


@pytest.fixture(scope="module")
def shooting(given):
    model, runs = given
    return data_at_horizon(runs, 1.0).shooting.around(model), model


def test_gains_of_many_differences_are_those_of_each(shooting):
    random = np.random.default_rng(3)
    many = random.standard_t(2.0, (6, len(shooting[0].windows))) + 0.3
    for local in (False, True):
        each = [standardized_gain(one, shooting[0], local=local) for one in many]
        np.testing.assert_array_equal(standardized_gains(many, shooting[0], local=local), each)


def test_a_fit_started_with_known_slopes_converges_to_the_same_values(shooting):
    windows, model = shooting
    first = fit(model.with_effect(effect("car", "viscous_drag"), {}), ["viscous_drag.coefficient"], windows, np.ones(4))
    both = first.model.with_effect(effect("car", "rolling_resistance"), {"deceleration": Setting(0.1)})
    paths = ["viscous_drag.coefficient", "rolling_resistance.deceleration"]
    known = known_slopes(first, paths)
    assert known.shape[-1] == 1
    slow = fit(both, paths, windows, first.scale)
    quick = fit(both, paths, windows, first.scale, known=known, enough=slow.value + 1.0)
    np.testing.assert_allclose(quick.values, slow.values, atol=0.02 * slow.deviations(windows).max())
    assert slow.values[1] == pytest.approx(0.3, abs=0.02)
    assert fit(both, paths, windows, first.scale, known=known, enough=-np.inf).value >= quick.value


def test_slopes_are_differences_of_residuals(shooting):
    windows, model = shooting
    with_drag = model.with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.1)})
    more = with_drag.with_settings({"viscous_drag.coefficient": Setting(0.11)})
    slopes = np.empty((*windows.measured.shape, 1))
    residual = windows.linearised([with_drag, more], [0.01], slopes)
    each = windows.residuals([with_drag, more])
    np.testing.assert_array_equal(residual, each[0])
    counts = windows.counts > 0
    np.testing.assert_allclose(slopes[..., 0][counts], ((each[1] - each[0]) / 0.01)[counts], atol=1e-9)


def test_with_values_equals_a_newly_constructed_model():
    given = load_model("car").with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.1, free=True)})
    settings = {"viscous_drag.coefficient": Setting(0.2), "base.wheelbase": Setting(0.3, free=True)}
    found = given.with_settings(settings)
    wanted = PhysicsModel(given.base, given.effects, {**given.settings, **settings}, given.period, given.holds)
    assert (found.settings, found.latent_names) == (wanted.settings, wanted.latent_names)
    assert found.clock is not given.clock
    state, action = np.array([0.0, 0.0, 0.3, 1.0]), np.array([1.5, 0.1])
    np.testing.assert_array_equal(found.advance(state, action, ())[0], wanted.advance(state, action, ())[0])
    for path, value in (("viscous_drag.coefficient", -9.0), ("viscous_drag.size", 0.1)):
        with pytest.raises(ModelFileError, match=path):
            given.with_settings({path: Setting(value)})


@pytest.fixture
def runs(plain, drive):
    random = np.random.default_rng(2)
    noise = (0.002, 0.002, 0.003, 0.015)
    clean = [drive(plain, 20.0, seed, name=f"drive_{seed}") for seed in range(3)]
    return [replace(run, states=run.states + random.normal(0.0, noise, run.states.shape)) for run in clean]


@pytest.mark.parametrize("guess", [0.9, 3.1, 20.0])
@pytest.mark.parametrize("wheelbase", [0.1, 0.29, 2.0])
def test_a_bad_guess_converges_to_the_same_values_as_a_good_one(guess, wheelbase, plain, runs):
    model = plain.with_settings({"base.drive_gain": Setting(guess, True), "base.wheelbase": Setting(wheelbase, True)})
    evidence = data_at_horizon(runs, 1.0)
    found = initial_search(model, evidence.shooting, evidence.heldout).first.fit
    values = dict(zip(found.paths, found.values.tolist(), strict=True))
    assert values["base.drive_gain"] == pytest.approx(3.0, abs=0.05)
    assert values["base.wheelbase"] == pytest.approx(0.3, abs=0.01)


def test_a_base_that_is_worse_than_no_change_is_reported_first(plain, runs, monkeypatch):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "payload")])
    lost = plain.with_settings({"base.wheelbase": Setting(0.05)})
    document = as_document(diagnose(lost, runs))
    assert document["naive"]["no_change"] < document["stages"][0]["heldout_error"]
    assert report_text(document).lead.startswith(
        "The given model, its free parameters refitted, predicts worse than predicting "
    )
    assert not report_text(as_document(diagnose(plain, runs))).lead.startswith("The given model")


ROWS, RETAINED, PERIOD = 9, 0.8, 0.1
MEASURED, PUSH, SECONDS = 0.3, 0.7, 0.5


@pytest.fixture
def track():
    """One state whose rate is disturbed, with one parameter, in two pieces."""
    random = np.random.default_rng(3)
    shape = (2, ROWS, 1)
    return LinearizedTrajectory(
        transition=np.full((*shape, 1), RETAINED), drift=random.normal(size=shape),
        columns=random.normal(size=(*shape, 1)), measured=random.normal(size=shape), period=np.full((2, ROWS), PERIOD),
        inside=np.ones((2, ROWS), dtype=bool), counted=np.ones((2, ROWS), dtype=bool), noise_factor=np.ones(shape),
        nonlinearity=np.zeros(shape), disturbed=np.array([0]),
    )  # fmt: skip


def joint_of(track, piece, shift=0.0):
    """Measurements of a piece less their means, and their covariance; all rows at once."""
    decay = np.exp(-PERIOD / SECONDS)
    starts = np.diag([(30.0 * MEASURED) ** 2, PUSH**2])
    step = np.array([[RETAINED, PERIOD], [0.0, decay]])
    noise = np.diag([(1e-5 * MEASURED) ** 2, (1.0 - decay**2) * PUSH**2])
    mean, means = np.array([track.measured[piece, 0, 0], 0.0]), []
    joint = np.zeros((2 * ROWS, 2 * ROWS))
    joint[:2, :2] = starts
    for row in range(ROWS):
        means.append(mean[0])
        mean = step @ mean + np.array([track.drift[piece, row, 0] + shift * track.columns[piece, row, 0, 0], 0.0])
        if row:
            now, before = slice(2 * row, 2 * row + 2), slice(2 * row - 2, 2 * row)
            joint[now, : 2 * row] = step @ joint[before, : 2 * row]
            joint[: 2 * row, now] = joint[now, : 2 * row].T
            joint[now, now] = step @ joint[before, before] @ step.T + noise
    covariance = joint[::2, ::2] + np.diag((MEASURED * track.noise_factor[piece, :, 0]) ** 2)
    return track.measured[piece, :, 0] - np.array(means), covariance


def dense(track, piece, shift):
    """-2 log likelihood of a piece, without the constant."""
    error, covariance = joint_of(track, piece, shift)
    return error @ np.linalg.solve(covariance, error) + np.linalg.slogdet(covariance)[1]


def noise_of(*scales):
    scale = np.array(scales)
    return Noise(MEASURED * scale[:, None], PUSH * np.ones((len(scale), 1)), SECONDS * np.ones(len(scale)))


def test_the_likelihood_is_that_of_all_rows_at_once(track):
    expected = dense(track, 0, 0.0) + dense(track, 1, 0.0)
    assert kalman_innovations(track, noise_of(1.0)).cost == pytest.approx([expected], rel=1e-9)


@pytest.mark.parametrize("doubtful", [False, True])
def test_each_innovation_is_measured_by_its_own_deviation(track, doubtful):
    """Of a row given all before it, from the joint normal distribution: what outliers are found by, and what is white.

    Their squares and the logs of their deviations add up to the likelihood.
    """
    if doubtful:
        track = replace(track, noise_factor=np.where(np.arange(ROWS)[None, :, None] == 4, 7.0, track.noise_factor))
    found = kalman_innovations(track, noise_of(1.0))
    for piece in range(2):
        error, covariance = joint_of(track, piece)
        cost = 0.0
        for row in range(ROWS):
            known = np.linalg.solve(covariance[:row, :row], covariance[:row, row]) if row else np.zeros(0)
            surprise, variance = error[row] - known @ error[:row], covariance[row, row] - known @ covariance[:row, row]
            assert found.ratio[piece, row, 0] == pytest.approx(surprise / np.sqrt(variance), rel=1e-9, abs=1e-12)
            assert found.white[piece, row] == pytest.approx(surprise / np.sqrt(variance), rel=1e-9, abs=1e-12)
            cost += surprise**2 / variance + np.log(variance)
        assert cost == pytest.approx(dense(track, piece, 0.0), rel=1e-9)


def test_the_noise_of_an_outlier_grows_with_its_distance(plain, with_effect, drive):
    """A jump of 25 deviations among noise of one: it is left out of the numbers, and the noise stays the noise."""
    truth = with_effect(plain, "viscous_drag", coefficient=0.3)
    run = noisy(drive(truth, 20.0), 0)
    states = run.states.copy()
    states[100:300:50] += 25.0 * np.array((0.004, 0.004, 0.006, 0.03))
    start = with_effect(plain, "viscous_drag", coefficient=0.2)
    paths, free = ["viscous_drag.coefficient"], np.array([True])
    clean = prediction_error_fit(start, paths, free, windows_of([run], 1.0))
    found = prediction_error_fit(start, paths, free, windows_of([replace(run, states=states)], 1.0))
    np.testing.assert_allclose(found.noise.measured[0], clean.noise.measured[0], rtol=0.25)
    assert abs(found.model.settings["viscous_drag.coefficient"].value - 0.3) < 3.0 * found.deviations[0]
    assert found.deviations[0] < 1.5 * clean.deviations[0]


def test_noise_variants_are_computed_independently(track):
    together = kalman_innovations(track, noise_of(1.0, 2.0, 0.5), slopes=False).cost
    alone = [kalman_innovations(track, noise_of(scale), slopes=False).cost[0] for scale in (1.0, 2.0, 0.5)]
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_slopes_are_those_of_the_innovations(track):
    found = kalman_innovations(track, noise_of(1.0))
    shifted = kalman_innovations(replace(track, drift=track.drift + 0.1 * track.columns[..., 0]), noise_of(1.0))
    np.testing.assert_allclose(shifted.white, found.white + 0.1 * found.columns[..., 0], atol=1e-9)


def test_rows_outside_a_piece_do_not_affect_the_result(track):
    half = np.arange(ROWS) < 5
    inside = np.stack([half, np.ones(ROWS, dtype=bool)])
    one = kalman_innovations(replace(track, inside=inside, counted=inside), noise_of(1.0))
    other = replace(track, inside=inside, counted=inside, measured=np.where(inside[..., None], track.measured, 1e3))
    np.testing.assert_allclose(kalman_innovations(other, noise_of(1.0)).cost, one.cost, rtol=1e-12)


def noisy(run, seed, noise=(0.004, 0.004, 0.006, 0.03)):
    """The run as a sensor shows it."""
    random = np.random.default_rng([seed, 1])
    return replace(run, states=run.states + np.array(noise) * random.normal(size=run.states.shape))


def test_parameters_of_a_noisy_drive_lie_within_their_deviations(plain, with_effect, drive):
    truth = with_effect(plain, "viscous_drag", coefficient=0.3)
    runs = [noisy(drive(truth, 20.0, seed, name=str(seed)), seed) for seed in range(3)]
    start = with_effect(plain, "viscous_drag", coefficient=0.2)
    found = prediction_error_fit(start, ["viscous_drag.coefficient"], np.array([True]), windows_of(runs, 1.0))
    value, deviation = found.model.settings["viscous_drag.coefficient"].value, found.deviations[0]
    assert deviation < 0.02
    assert abs(value - 0.3) < 3.0 * deviation
    np.testing.assert_allclose(found.noise.measured[0], [0.004, 0.004, 0.006, 0.03], rtol=0.2)


def test_a_fixed_parameter_does_not_change(plain, with_effect, drive):
    model = with_effect(plain, "viscous_drag", coefficient=0.3)
    paths, free = ["base.drive_gain", "viscous_drag.coefficient"], np.array([True, False])
    found = prediction_error_fit(model, paths, free, windows_of([noisy(drive(model, 20.0), 0)], 1.0))
    assert found.model.settings["viscous_drag.coefficient"] == Setting(0.3)
    assert np.isfinite(found.deviations).tolist() == [True, False]


def test_recordings_too_short_for_the_filter_return_none(plain, drive):
    windows = windows_of([drive(plain, 1.5)], 0.5)
    assert prediction_error_fit(plain, ["base.drive_gain"], np.array([True]), windows) is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "parameter", "value"), [("steering_lag", "time_constant", 0.143), ("steering_delay", "seconds", 0.114)]
)
def test_actuators_are_followed_within_each_row(tmp_path, name, parameter, value):
    """What a lag makes of a command changes within a row: its mean is off by three stated deviations."""
    log = write_case(Case("test", 1793393573, {name: {parameter: value}}), tmp_path / "case")
    model = load_model(str(log.model))
    windows = windows_of([load_run(str(path), model.system) for path in log.runs], 1.0)
    path = f"{name}.{parameter}"
    initial_search = model.with_effect(effect("car", name), {parameter: Setting(0.993 * value)})
    found = prediction_error_fit(initial_search, [path], np.array([True]), windows)
    (std,) = found.deviations
    assert std < 4e-4 * value
    assert abs(found.model.settings[path].value - value) < 2.5 * std


def test_commands_between_rows_are_means_of_neighbours_and_can_be_taken_back(given):
    recorded = data_at_horizon(given[1], 1.0)
    between = recorded.with_commands(between_rows=True)
    assert between.with_commands(between_rows=True).shooting is between.shooting
    back = between.with_commands(between_rows=False)
    for name in ("shooting", "heldout"):
        before, during, after = (getattr(item, name).windows for item in (recorded, between, back))
        (begin, end), u = before.bounds[0], before.actions
        np.testing.assert_allclose(during.actions[begin : end - 1], 0.5 * (u[begin : end - 1] + u[begin + 1 : end]))
        np.testing.assert_array_equal(during.actions[end - 1], u[end - 1])
        np.testing.assert_array_equal(after.actions, u)
