"""Circles without load: what is recorded, and that it shows what tuning needs."""

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_sim.training.tuning_data import PERIOD, record_circles


@pytest.fixture(scope="module")
def runs():
    return record_circles(2000, seed=3, run_pairs=1000)


def test_as_many_pairs_as_asked_for_in_runs_of_one_length(runs):
    assert [len(run.t) - 1 for run in runs] == [1000, 1000]
    assert runs[0].period == pytest.approx(PERIOD)


def test_the_same_seed_gives_the_same_runs_and_another_one_others(runs):
    again, other = record_circles(1000, 3, 1000)[0], record_circles(1000, 4, 1000)[0]
    assert np.array_equal(again.states, runs[0].states)
    assert not np.array_equal(other.states, runs[0].states)


def test_commands_are_held_for_one_to_three_seconds(runs):
    changes = np.flatnonzero(np.any(np.diff(runs[0].actions, axis=0) != 0.0, axis=1))
    holds = np.diff(changes) * PERIOD
    assert holds.min() >= 1.0 - 1e-9
    assert holds.max() <= 3.0 + 1e-9


def test_commands_cover_the_range_and_the_car_follows_them_late(runs):
    run = runs[0]
    assert run.actions[:, 0].min() < -0.3
    assert run.actions[:, 0].max() > 1.5
    assert np.abs(run.actions[:, 1]).max() > 0.3
    error = np.abs(run.states[1:, 3] - run.actions[:-1, 0])
    changes = np.flatnonzero(np.abs(np.diff(run.actions[:, 0])) > 0.5)
    assert np.mean(error[changes + 1]) > 3.0 * np.mean(error[changes - 1])


def test_nothing_to_record_is_refused():
    with pytest.raises(InputError, match="0 pairs"):
        record_circles(0, 1)
