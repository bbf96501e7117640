"""What is held out together: whole runs where there are enough of them, else stretches of time; never both sides."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.compare.windows import Windows, windows_of
from safedpa.diagnosis.fit.shooting import folds_of


def windows_of_runs(plain, drive, count: int, seconds: float = 6.0) -> Windows:
    """Runs of different lengths, which no stretch of time divides alike."""
    return windows_of([drive(plain, seconds + seed, seed=seed, name=f"run {seed}") for seed in range(count)], 0.5)


@pytest.mark.parametrize(("runs", "folds"), [(3, 6), (4, 3), (6, 6), (7, 6), (7, 2)])
def test_of_three_runs_or_more_each_is_held_out_whole(plain, drive, runs, folds):
    """A fit that has seen the other half of a run knows its day, load and battery: nothing of it is unseen then."""
    windows = windows_of_runs(plain, drive, runs)
    found = folds_of(windows, folds)
    of_run = [set(found[windows.run == run].tolist()) for run in range(runs)]
    assert all(len(one) == 1 for one in of_run)
    assert len(set().union(*of_run)) == min(runs, folds)
    sizes = np.bincount([one.pop() for one in of_run])
    assert sizes.max() - sizes.min() <= 1


@pytest.mark.parametrize("runs", [1, 2])
def test_of_fewer_each_is_held_out_by_stretches_of_time(plain, drive, runs):
    windows = windows_of_runs(plain, drive, runs, 12.0)
    found = folds_of(windows, 4)
    for run in range(runs):
        own = found[windows.run == run]
        assert sorted(set(own.tolist())) == [0, 1, 2, 3]
        assert (np.diff(own) >= 0).all(), "a stretch is one piece: neighbours are too much alike"
