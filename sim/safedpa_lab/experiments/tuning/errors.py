"""Prediction errors of tuned models by drive, in every metric that "ten times less" may mean, and their ratios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.car.predictor import OWN_STATES, STEPS
from safedpa_lab.tuning.paper import sequence_of
from safedpa_lab.tuning.predictors import AbstractPredictor, open_loop_errors
from safedpa_sim.training.data.recorded_runs import TuningDrive

METRICS: Final = ("root_mean_square", "mean_square", "squared_norm")
HORIZONS: Final = ("one_step", "one_second")
_FIRST: Final = 60
"""Tick from which predictions count: the history encoder has seen as much as it ever will."""
_EVERY: Final = 5
"""Ticks from one start of an open-loop prediction to the next."""
_DRAWS: Final = 2000


def errors_of_drive(predictor: AbstractPredictor, drive: TuningDrive) -> dict[str, Any]:
    """Of one drive, by horizon: the sums of squared own-frame errors (states,) in SI units, and how many they are."""
    seen = predictor.seen(sequence_of(predictor.networks, [drive]))
    rows = len(drive.actions)
    starts = {"one_step": torch.arange(_FIRST, rows), "one_second": torch.arange(_FIRST, rows - STEPS + 1, _EVERY)}
    found = {}
    for horizon, steps in zip(HORIZONS, (1, STEPS), strict=True):
        with torch.no_grad():
            errors = open_loop_errors(predictor, seen, starts[horizon], steps)[-1].double()
        found[horizon] = {"squares": errors.square().sum(0).tolist(), "count": len(errors)}
    return found


def metrics_of(drives: Sequence[Mapping[str, Any]], scale: FloatArray) -> dict[str, float]:
    """The three metrics of drives together, and the root mean square of each state in SI units.

    With m the mean over the steps of the squared error of each state: ``root_mean_square`` = mean over the states of
    sqrt(m) / scale, ``mean_square`` = mean over the states of m / scale^2, ``squared_norm`` = sum of m in raw SI units.
    """
    squares = np.array([drive["squares"] for drive in drives])
    counts = np.array([drive["count"] for drive in drives], dtype=np.float64)
    mean = squares.sum(0) / counts.sum()
    found = {name: float(_metrics(mean, scale)[name]) for name in METRICS}
    return found | dict(zip(OWN_STATES, np.sqrt(mean).tolist(), strict=True))


def ratios_of(
    base: Sequence[Sequence[Mapping[str, Any]]],
    row: Sequence[Sequence[Mapping[str, Any]]],
    scale: FloatArray,
    seed: int = 0,
) -> dict[str, list[float]]:
    """By metric: base over row, and the ends of its 95 % interval by drawing drives with replacement, in pairs.

    ``base`` and ``row`` hold, for each seed, the same drives: those of one seed, with whatever loads, are drawn
    together. Raises ValueError for drives that are no pairs.
    """
    if [len(group) for group in base] != [len(group) for group in row] or not base:
        raise ValueError(f"got {len(base)} and {len(row)} groups of drives, wanted pairs of the same drives")
    picked = np.random.default_rng(seed).integers(0, len(base), (_DRAWS, len(base)))
    whole = np.arange(len(base))[np.newaxis]
    reported = {}
    for name in METRICS:
        point, drawn = (
            _metrics(_means(base, index), scale)[name] / _metrics(_means(row, index), scale)[name]
            for index in (whole, picked)
        )
        reported[name] = [float(point[0]), *np.quantile(drawn, (0.025, 0.975)).tolist()]
    return reported


def _means(groups: Sequence[Sequence[Mapping[str, Any]]], picked: NDArray[np.int64]) -> FloatArray:
    """Mean squared errors (draws, states) of the groups that each draw picks."""
    squares = np.array([np.sum([drive["squares"] for drive in group], axis=0) for group in groups])
    counts = np.array([sum(drive["count"] for drive in group) for group in groups], dtype=np.float64)
    found: FloatArray = squares[picked].sum(1) / counts[picked].sum(1)[:, np.newaxis]
    return found


def _metrics(mean: FloatArray, scale: FloatArray) -> dict[str, Any]:
    """The metrics (...) of mean squared errors (..., states)."""
    scaled = mean / scale**2
    return {"root_mean_square": np.sqrt(scaled).mean(-1), "mean_square": scaled.mean(-1), "squared_norm": mean.sum(-1)}
