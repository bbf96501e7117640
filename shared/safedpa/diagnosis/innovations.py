"""Kalman filters along recordings, many pieces side by side: a linear model about a reference track.

state entries z = (deviation from the reference track, disturbances of the rates), and one column a parameter beside:

z[k+1] = T[k] z[k] + (model(reference[k]) - reference[k+1], 0) + G[k] shift
measured - reference = first part of z + noise

The disturbances are first-order Markov processes. So what a lasting push makes of the speed is not mistaken for what
the model's parameters would make of it: in windows that start anew, the start knows the push before it.

Source: Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 7; Ljung, System Identification, 2nd ed., 1999,
section 7.2 (prediction errors).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.diagnosis.windows import Floats

__all__ = ["Innovations", "LinearTrack", "Noise", "filtered"]

_SMALL = 1e-5
"""Share of the measurement's deviation that the state may wander by itself in a row: keeps covariances positive."""
_UNKNOWN = 30.0
"""Times the measurement's deviation by which a piece's start may be off."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations: of the measurement (..., states) and of the disturbances (..., disturbed), in the state's
    unit and that per second; ``seconds`` (...,): time after which a disturbance has fallen to 37 %."""

    measured: Floats
    pushes: Floats
    seconds: Floats


@dataclass(frozen=True)
class LinearTrack:
    """A model about a reference, piece by piece (pieces, rows, ...).

    transition (..., states, states) and drift (..., states) lead from a row to the next; columns (..., states, paths):
    what a parameter changes in it; seen (..., states): measured - reference; period (...): s to the next row.
    """

    transition: Floats
    drift: Floats
    columns: Floats
    seen: Floats
    period: Floats
    inside: NDArray[np.bool_]
    """Rows that exist."""
    counted: NDArray[np.bool_]
    """Rows that exist and are not there for the filter to settle only."""
    doubt: Floats
    """Factor of the measurement's deviation (pieces, rows, states): 1, more where a row is unlike its neighbours."""
    bent: Floats
    """How far the model is from linear over what the measurement leaves open (pieces, rows, states), in the state's
    unit: it counts as noise of the step."""
    disturbed: NDArray[np.int64]
    """Indices of the states whose rates are disturbed."""


@dataclass(frozen=True)
class Innovations:
    """white (pieces, rows * states) and columns (..., paths): innovations and their slopes in standard deviations.

    ``states`` (pieces, rows, states): filtered deviation from the reference; ``ratio``: innovation over its standard
    deviation, state by state; ``cost`` (noises,): -2 log likelihood without its constant.
    """

    white: Floats
    columns: Floats
    states: Floats
    ratio: Floats
    cost: Floats


def filtered(track: LinearTrack, noise: Noise, slopes: bool = True) -> Innovations:
    """One pass over every piece. Noises (variants, ...) side by side: then only ``cost`` is that of each."""
    variants = len(noise.measured)
    pieces, rows, size = track.seen.shape
    wide = track.columns if slopes else track.columns[..., :0]
    covariance, mean = _begin(track, noise, wide.shape[-1])
    white = np.zeros((pieces, rows, size, 1 + wide.shape[-1]))
    states, ratio, cost = np.zeros((pieces, rows, size)), np.zeros((pieces, rows, size)), np.zeros(variants)
    spread = (noise.measured[:, None] * np.ones((pieces, 1))) ** 2
    push = _pushes(track, noise)
    for row in range(rows):
        inside = track.inside[:, row]
        seen = np.zeros((pieces, size, 1 + wide.shape[-1]))
        seen[..., 0] = track.seen[:, row]
        surprise = seen - mean[..., :size, :]
        total = covariance[..., :size, :size] + _diagonal(spread * track.doubt[:, row] ** 2)
        root = np.linalg.cholesky(total)
        own = np.linalg.solve(root, surprise)
        gain = np.linalg.solve(total, covariance[..., :size, :]) * inside[:, None, None]
        mean = mean + gain.swapaxes(-1, -2) @ surprise
        covariance = covariance - covariance[..., :, :size] @ gain
        counted = track.counted[:, row]
        log = 2.0 * np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
        cost += (((own[..., 0] ** 2).sum(axis=-1) + log) * counted).sum(axis=-1)
        white[:, row] = own[0] * counted[:, None, None]
        states[:, row] = mean[0, ..., :size, 0]
        ratio[:, row] = surprise[0, ..., 0] / np.sqrt(np.diagonal(total[0], axis1=-2, axis2=-1)) * inside[:, None]
        mean, covariance = _onward(track, row, mean, covariance, wide, push)
    flat = white.reshape(pieces, rows * size, -1)
    return Innovations(flat[..., 0], flat[..., 1:], states, ratio, cost)


def _begin(track: LinearTrack, noise: Noise, paths: int) -> tuple[Floats, Floats]:
    pieces, _, size = track.seen.shape
    own = np.concatenate([_UNKNOWN * noise.measured, noise.pushes], axis=-1) ** 2
    covariance = np.repeat(_diagonal(own)[:, None], pieces, axis=1)
    mean = np.zeros((len(own), pieces, own.shape[-1], 1 + paths))
    mean[..., :size, 0] = track.seen[:, 0]
    return covariance, mean


def _pushes(track: LinearTrack, noise: Noise) -> tuple[Floats, Floats, Floats]:
    """What is left of a disturbance after each row (variants, pieces, rows), its fresh variance, that of the states."""
    kept = np.exp(-track.period / noise.seconds[:, None, None])
    fresh = (1.0 - kept**2)[..., None] * noise.pushes[:, None, None] ** 2
    return kept, fresh, (_SMALL * noise.measured) ** 2


def _onward(
    track: LinearTrack,
    row: int,
    mean: Floats,
    covariance: Floats,
    wide: Floats,
    push: tuple[Floats, Floats, Floats],
) -> tuple[Floats, Floats]:
    """From one row to the next."""
    kept, fresh, small = push
    size, pushes = track.seen.shape[-1], len(track.disturbed)
    step = np.zeros((*kept.shape[:2], size + pushes, size + pushes))
    step[..., :size, :size] = track.transition[:, row]
    at = size + np.arange(pushes)
    step[..., track.disturbed, at] = track.period[:, row, None]
    step[..., at, at] = kept[:, :, row, None]
    mean = step @ mean
    mean[..., :size, 0] += track.drift[:, row]
    mean[..., :size, 1:] += wide[:, row]
    covariance = step @ covariance @ step.swapaxes(-1, -2)
    entries = np.arange(size)
    covariance[..., entries, entries] += small[:, None] + track.bent[:, row] ** 2
    covariance[..., at, at] += fresh[:, :, row]
    return mean, 0.5 * (covariance + covariance.swapaxes(-1, -2))


def _diagonal(entries: Floats) -> Floats:
    return np.asarray(entries[..., None] * np.eye(entries.shape[-1]))
