"""Does the latent distinguish loads, and how soon does it follow when a load is hitched or released while driving?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.networks import frame_of
from safedpa_lab.experiments.car.drives import Drive
from safedpa_lab.experiments.car.predictor import latents_along, predictor_of
from safedpa_lab.experiments.common.statistics import wilson_interval

_FULL = 60
"""Tick from which a history is as long as it ever will be."""
WITHIN = 50
"""Ticks within which a change of load shall be noticed: the k of the paper's history."""
_LASTING = (8, 10)
"""Of the ten ticks from one on so many must be classified as the new load for the latent to have arrived there."""
_BAND = 0.9
"""Quantile of the one-step errors in ordinary drives with a load that their band ends at."""


@final
@dataclass(frozen=True)
class LinearDiscriminant:
    """Fisher's linear discriminant: classes with means m_c and one covariance S; the class of the largest
    m_c' S^-1 z - m_c' S^-1 m_c / 2. Source: Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 4.3.
    """

    classes: tuple[str, ...]
    means: FloatArray
    """(classes, latents)."""
    weights: FloatArray
    """(classes, latents): S^-1 m_c."""

    @staticmethod
    def fit(latents: FloatArray, labels: Sequence[str]) -> LinearDiscriminant:
        """From latents (n, latents) and their labels (n,)."""
        classes = tuple(dict.fromkeys(labels))
        names = np.array(labels)
        means = np.array([latents[names == name].mean(axis=0) for name in classes])
        centred = latents - means[[classes.index(name) for name in labels]]
        covariance = np.atleast_2d(centred.T @ centred) / max(len(latents) - len(classes), 1)
        covariance += 1e-6 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))  # z may have idle entries
        return LinearDiscriminant(classes, means, np.linalg.solve(covariance, means.T).T)

    def classify(self, latents: FloatArray) -> list[str]:
        """The class of each latent (n, latents)."""
        scores = latents @ self.weights.T - 0.5 * np.sum(self.means * self.weights, axis=1)
        return [self.classes[index] for index in scores.argmax(axis=1)]


def principal_plane(latents: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (latents,), the two directions (2, latents) of largest variance, and their shares of the variance (2,)."""
    middle = latents.mean(axis=0)
    _, sizes, directions = np.linalg.svd(latents - middle, full_matrices=False)
    shares = sizes**2 / max(float(np.sum(sizes**2)), 1e-12)
    return middle, directions[:2], shares[:2]


def latent_result(
    model: PhysicsModel,
    fitting: Sequence[Drive],
    heldout: Sequence[Drive],
    hitching: Sequence[Drive],
    scale: FloatArray,
) -> dict[str, Any]:
    """Held-out accuracy, confusion, ticks until a change of load is noticed, and points for a plot."""
    known, labels = _labelled(model, fitting)
    discriminant = LinearDiscriminant.fit(known, labels)
    tested, truth = _labelled(model, heldout)
    notice = discriminant.classify(tested)
    band = _bands(model, fitting, scale)
    changes = [change for drive in hitching for change in _changes(model, drive, discriminant, band, scale)]
    return {
        "latents": list(model.latent_names),
        "accuracy": _accuracy(notice, truth),
        "hitched_or_not": _accuracy([name != "none" for name in notice], [name != "none" for name in truth]),
        "confusion": {
            load: {
                other: sum(1 for s, t in zip(notice, truth, strict=True) if (t, s) == (load, other)) for other in band
            }
            for load in band
        },
        "changes": changes,
        "adaptation": _adaptation(changes),
        "points": _points(tested, truth),
    }


def _labelled(model: PhysicsModel, drives: Sequence[Drive]) -> tuple[FloatArray, list[str]]:
    parts = [(latents_along(model, drive)[_FULL:], drive.loads[_FULL:]) for drive in drives]
    return np.concatenate([latents for latents, _ in parts]), [load for _, loads in parts for load in loads]


def _accuracy(notice: Sequence[object], truth: Sequence[object]) -> dict[str, Any]:
    right = sum(one == other for one, other in zip(notice, truth, strict=True))
    return {"right": right, "of": len(truth), "share": right / len(truth)}


def _error_sizes(model: PhysicsModel, drive: Drive, scale: FloatArray) -> FloatArray:
    """(n,) root mean square over the states of the scaled one-step error of each transition."""
    errors = frame_of("car").own_increment(drive.states[1:], predictor_of(model, drive).one_step()) / scale
    return np.asarray(np.sqrt(np.mean(errors**2, axis=1)))


def _bands(model: PhysicsModel, drives: Sequence[Drive], scale: FloatArray) -> dict[str, float]:
    """By load: the one-step error that nine tenths of the steps stay below once the history is full."""
    sizes: dict[str, list[FloatArray]] = {}
    for drive in drives:
        sizes.setdefault(drive.loads[0], []).append(_error_sizes(model, drive, scale)[_FULL:])
    return {load: float(np.quantile(np.concatenate(parts), _BAND)) for load, parts in sizes.items()}


def _changes(
    model: PhysicsModel, drive: Drive, discriminant: LinearDiscriminant, band: dict[str, float], scale: FloatArray
) -> list[dict[str, Any]]:
    """One row for each change of load: ticks until the latent is classified right, and until the error is in band."""
    notice = discriminant.classify(latents_along(model, drive))
    sizes = _error_sizes(model, drive, scale)
    ticks = [tick for tick in range(1, len(drive.loads)) if drive.loads[tick] != drive.loads[tick - 1]]
    rows = []
    for start, end in pairwise([*ticks, len(drive.loads)]):
        load = drive.loads[start]
        right = np.array([name == load for name in notice[start:end]])
        before = [name == load for name in notice[max(0, start - _LASTING[1]) : start]]
        noticed = None if 2 * sum(before) > len(before) else _first_lasting(right)  # noticed before the change
        calm = sizes[start : end - 1] <= band[load]
        rows.append(
            {
                "from": drive.loads[start - 1],
                "to": load,
                "watched": end - start,
                "latent_ticks": noticed,
                "error_ticks": _first_lasting(calm),
            }
        )
    return rows


def _first_lasting(fine: NDArray[np.bool_]) -> int | None:
    """The first tick after which at least eight of ten ticks are right; None if there is none."""
    least, window = _LASTING
    for tick in range(len(fine) - window + 1):
        if fine[tick] and fine[tick : tick + window].sum() >= least:
            return tick
    return None


def _adaptation(changes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Median and share within WITHIN ticks, over all changes; one that never arrived counts as not within."""
    summary = {}
    for key in ("latent_ticks", "error_ticks"):
        values = [float("inf") if change[key] is None else float(change[key]) for change in changes]
        within = sum(value <= WITHIN for value in values)
        median = float(np.median(values)) if values else float("inf")
        summary[key] = {
            "median": median if np.isfinite(median) else None,
            "within": within,
            "of": len(values),
            "interval_95": list(wilson_interval(within, len(values))) if values else None,
        }
    return summary


def _points(latents: FloatArray, labels: Sequence[str], most: int = 400) -> dict[str, Any]:
    """Latents in their principal plane, at most so many of each load, evenly taken."""
    middle, directions, shares = principal_plane(latents)
    flat, names = (latents - middle) @ directions.T, np.array(labels)
    chosen = {}
    for load in dict.fromkeys(labels):
        own = flat[names == load]
        chosen[load] = np.round(own[:: max(1, len(own) // most)], 4).tolist()
    return {"by_load": chosen, "shares": shares.tolist()}
