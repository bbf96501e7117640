"""What is held out together: whole runs where there are three, else stretches of time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.compare.windows import Windows, windows_of
from safedpa.diagnosis.fit.shooting import folds_of


def simulated(plain, drive, count: int, seconds: float = 6.0) -> Windows:
    """Runs of different lengths, which no stretch of time divides evenly."""
    return windows_of([drive(plain, seconds + seed, seed=seed, name=f"run {seed}") for seed in range(count)], 0.5)


@pytest.mark.parametrize(("runs", "folds"), [(3, 6), (4, 3), (6, 6), (7, 6), (7, 2)])
def test_three_runs_or_more_are_held_out_whole(plain, drive, runs, folds):
    """A fit that has seen the other half of a run knows its day, load and battery: nothing of it is unseen then."""
    windows = simulated(plain, drive, runs)
    found = folds_of(windows, folds)
    of_run = [set(found[windows.run == run].tolist()) for run in range(runs)]
    assert all(len(one) == 1 for one in of_run)
    assert len(set().union(*of_run)) == min(runs, folds)
    sizes = np.bincount([one.pop() for one in of_run])
    assert sizes.max() - sizes.min() <= 1


@pytest.mark.parametrize("runs", [1, 2])
def test_fewer_runs_are_held_out_by_stretches_of_time(plain, drive, runs):
    windows = simulated(plain, drive, runs, 12.0)
    found = folds_of(windows, 4)
    for run in range(runs):
        own = found[windows.run == run]
        assert sorted(set(own.tolist())) == [0, 1, 2, 3]
        assert (np.diff(own) >= 0).all(), "each fold is one stretch"


def windows_of_runs(*runs: tuple[int, float]) -> Any:
    """Of each run so many windows of 1 s, one after the other, the first at so many s by its clock."""
    counts = [count for count, _ in runs]
    clock = np.concatenate([first + np.arange(count + 1) for count, first in runs])
    start = np.concatenate([np.arange(count) + sum(c + 1 for c in counts[:at]) for at, count in enumerate(counts)])
    own = {"names": "abcdef"[: len(runs)], "run": np.repeat(np.arange(len(runs)), counts), "clock": clock}
    return type("Windows", (), {**own, "start": start, "end": start + 1, "__len__": lambda _: sum(counts)})()


@pytest.mark.parametrize(
    ("runs", "folds", "found"),
    [
        (((3, 0.0), (2, 5.0), (4, 0.0)), 5, [0] * 3 + [1] * 2 + [2] * 4),  # three runs are held out whole
        (((1, 0.0), (1, 0.0), (1, 0.0), (2, 0.0)), 3, [0, 1, 2, 0, 0]),
        (((10, 0.0),), 5, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]),  # of fewer, stretches of time in each
        (((10, 100.0), (4, 7.0)), 2, [0] * 5 + [1] * 5 + [0, 0, 1, 1]),
        (((4, 0.0), (10, 50.0)), 2, [0, 0, 1, 1] + [0] * 5 + [1] * 5),
    ],
)
def test_folds_are_runs_or_equal_stretches_of_time(runs: Any, folds: int, found: list[int]) -> None:
    assert folds_of(windows_of_runs(*runs), folds).tolist() == found
