"""Numbers by a Kalman filter along recordings: the filter against a dense Gaussian, the numbers against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.compare.windows import windows_of
from safedpa.diagnosis.fit.innovations import LinearTrack, Noise, filtered
from safedpa.diagnosis.fit.refinement import refined
from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case

ROWS, KEPT, PERIOD = 9, 0.8, 0.1
MEASURED, PUSH, SECONDS = 0.3, 0.7, 0.5


@pytest.fixture
def track():
    """One state whose rate is disturbed, with one parameter, in two pieces."""
    random = np.random.default_rng(3)
    shape = (2, ROWS, 1)
    return LinearTrack(
        transition=np.full((*shape, 1), KEPT),
        drift=random.normal(size=shape),
        columns=random.normal(size=(*shape, 1)),
        seen=random.normal(size=shape),
        period=np.full((2, ROWS), PERIOD),
        inside=np.ones((2, ROWS), dtype=bool),
        counted=np.ones((2, ROWS), dtype=bool),
        doubt=np.ones(shape),
        bent=np.zeros(shape),
        disturbed=np.array([0]),
    )


def joint_of(track, piece, shift=0.0):
    """Measurements of a piece less their means, and their covariance; all rows at once."""
    decay = np.exp(-PERIOD / SECONDS)
    starts = np.diag([(30.0 * MEASURED) ** 2, PUSH**2])
    step = np.array([[KEPT, PERIOD], [0.0, decay]])
    noise = np.diag([(1e-5 * MEASURED) ** 2, (1.0 - decay**2) * PUSH**2])
    mean, means = np.array([track.seen[piece, 0, 0], 0.0]), []
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
    covariance = joint[::2, ::2] + np.diag((MEASURED * track.doubt[piece, :, 0]) ** 2)
    return track.seen[piece, :, 0] - np.array(means), covariance


def dense(track, piece, shift):
    """-2 log likelihood of a piece, without the constant."""
    error, covariance = joint_of(track, piece, shift)
    return error @ np.linalg.solve(covariance, error) + np.linalg.slogdet(covariance)[1]


def noise_of(*scales):
    scale = np.array(scales)
    return Noise(MEASURED * scale[:, None], PUSH * np.ones((len(scale), 1)), SECONDS * np.ones(len(scale)))


def test_the_likelihood_is_that_of_all_rows_at_once(track):
    expected = dense(track, 0, 0.0) + dense(track, 1, 0.0)
    assert filtered(track, noise_of(1.0)).cost == pytest.approx([expected], rel=1e-9)


@pytest.mark.parametrize("doubtful", [False, True])
def test_each_innovation_is_measured_by_its_own_deviation(track, doubtful):
    """Of a row given all before it, from the joint normal distribution: what outliers are found by, and what is white.

    Their squares and the logs of their deviations add up to the likelihood.
    """
    if doubtful:
        track = replace(track, doubt=np.where(np.arange(ROWS)[None, :, None] == 4, 7.0, track.doubt))
    found = filtered(track, noise_of(1.0))
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


def test_a_row_that_lies_off_is_doubted_by_as_many_times_as_it_lies_off(plain, with_effect, drive):
    """A jump of 25 deviations among noise of one: it is left out of the numbers, and the noise stays the noise."""
    truth = with_effect(plain, "viscous_drag", coefficient=0.3)
    run = noisy(drive(truth, 20.0), 0)
    states = run.states.copy()
    states[100:300:50] += 25.0 * np.array((0.004, 0.004, 0.006, 0.03))
    start = with_effect(plain, "viscous_drag", coefficient=0.2)
    paths, free = ["viscous_drag.coefficient"], np.array([True])
    clean = refined(start, paths, free, windows_of([run], 1.0))
    found = refined(start, paths, free, windows_of([replace(run, states=states)], 1.0))
    np.testing.assert_allclose(found.noise.measured[0], clean.noise.measured[0], rtol=0.25)
    value = found.model.settings["viscous_drag.coefficient"].value
    assert abs(value - 0.3) < 3.0 * found.deviations[0]
    assert found.deviations[0] < 1.5 * clean.deviations[0]


def test_noises_side_by_side_do_not_mix(track):
    together = filtered(track, noise_of(1.0, 2.0, 0.5), slopes=False).cost
    alone = [filtered(track, noise_of(scale), slopes=False).cost[0] for scale in (1.0, 2.0, 0.5)]
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_slopes_are_those_of_the_innovations(track):
    found = filtered(track, noise_of(1.0))
    shifted = filtered(replace(track, drift=track.drift + 0.1 * track.columns[..., 0]), noise_of(1.0))
    np.testing.assert_allclose(shifted.white, found.white + 0.1 * found.columns[..., 0], atol=1e-9)


def test_rows_that_are_not_there_change_nothing(track):
    half = np.arange(ROWS) < 5
    inside = np.stack([half, np.ones(ROWS, dtype=bool)])
    one = filtered(replace(track, inside=inside, counted=inside), noise_of(1.0))
    other = replace(track, inside=inside, counted=inside, seen=np.where(inside[..., None], track.seen, 1e3))
    np.testing.assert_allclose(filtered(other, noise_of(1.0)).cost, one.cost, rtol=1e-12)


def noisy(run, seed, noise=(0.004, 0.004, 0.006, 0.03)):
    """The run as a sensor shows it."""
    random = np.random.default_rng([seed, 1])
    return replace(run, states=run.states + np.array(noise) * random.normal(size=run.states.shape))


def test_parameters_of_a_noisy_drive_lie_within_their_deviations(plain, with_effect, drive):
    truth = with_effect(plain, "viscous_drag", coefficient=0.3)
    runs = [noisy(drive(truth, 20.0, seed, name=str(seed)), seed) for seed in range(3)]
    start = with_effect(plain, "viscous_drag", coefficient=0.2)
    found = refined(start, ["viscous_drag.coefficient"], np.array([True]), windows_of(runs, 1.0))
    value, deviation = found.model.settings["viscous_drag.coefficient"].value, found.deviations[0]
    assert deviation < 0.02
    assert abs(value - 0.3) < 3.0 * deviation
    np.testing.assert_allclose(found.noise.measured[0], [0.004, 0.004, 0.006, 0.03], rtol=0.2)


def test_a_number_that_is_not_free_stays(plain, with_effect, drive):
    model = with_effect(plain, "viscous_drag", coefficient=0.3)
    paths, free = ["base.drive_gain", "viscous_drag.coefficient"], np.array([True, False])
    found = refined(model, paths, free, windows_of([noisy(drive(model, 20.0), 0)], 1.0))
    assert found.model.settings["viscous_drag.coefficient"] == Setting(0.3)
    assert np.isfinite(found.deviations).tolist() == [True, False]


def test_recordings_too_short_for_a_filter_give_nothing(plain, drive):
    windows = windows_of([drive(plain, 1.5)], 0.5)
    assert refined(plain, ["base.drive_gain"], np.array([True]), windows) is None


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
    begun = model.with_effect(effect("car", name), {parameter: Setting(0.993 * value)})
    found = refined(begun, [path], np.array([True]), windows)
    (std,) = found.deviations
    assert std < 4e-4 * value
    assert abs(found.model.settings[path].value - value) < 2.5 * std
