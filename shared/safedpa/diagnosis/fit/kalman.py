"""Kalman filters along recordings, many pieces side by side: a linear model about a reference track.

state entries z = (deviation from the reference track, disturbances of the rates), and one column a parameter next to:

z[k+1] = T[k] z[k] + (model(reference[k]) - reference[k+1], 0) + G[k] shift
measured - reference = first part of z + noise

The disturbances are first-order Markov processes. So what a lasting push makes of the speed is not mistaken for what
the model's parameters would make of it: in windows that restart, the start knows the push before it.

Source: Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 7; Ljung, System Identification, 2nd ed., 1999,
section 7.2 (prediction errors).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray

__all__ = ["Innovations", "LinearizedTrajectory", "Noise", "kalman_innovations"]

_SMALL = 1e-5
"""Share of the measurement's deviation that the state may wander by itself in a row: keeps covariances positive."""
_UNKNOWN = 30.0
"""Times the measurement's deviation by which a piece's start may be off."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations: of the measurement (..., states) and of the disturbances (..., disturbed), in the state's
    unit and that per second; ``seconds`` (...,): time after which a disturbance has fallen to 37 %."""

    measured: FloatArray
    pushes: FloatArray
    seconds: FloatArray


@dataclass(frozen=True)
class LinearizedTrajectory:
    """A model about a reference, piece by piece (pieces, rows, ...).

    transition (..., states, states) and drift (..., states) lead from a row to the next; columns (..., states, paths):
    what a parameter changes in it; seen (..., states): measured - reference; period (...): s to the next row.
    """

    transition: FloatArray
    drift: FloatArray
    columns: FloatArray
    seen: FloatArray
    period: FloatArray
    inside: NDArray[np.bool_]
    """Rows that exist."""
    counted: NDArray[np.bool_]
    """Rows that exist and are not there for the filter to settle only."""
    doubt: FloatArray
    """Factor of the measurement's deviation (pieces, rows, states): 1, more where a row is unlike its neighbours."""
    bent: FloatArray
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

    white: FloatArray
    columns: FloatArray
    states: FloatArray
    ratio: FloatArray
    cost: FloatArray


def kalman_innovations(track: LinearizedTrajectory, noise: Noise, slopes: bool = True) -> Innovations:
    """One pass over every piece.

    Without ``slopes`` noises (variants, ...) side by side, and only ``cost``, that of each, is worked out.
    """
    pieces, rows, size = track.seen.shape
    wide = track.columns if slopes else track.columns[..., :0]
    covariance, mean = _begin(track, noise, wide.shape[-1])
    white = np.zeros((pieces, rows, size, 1 + wide.shape[-1]))
    states, ratio, cost = np.zeros((pieces, rows, size)), np.zeros((pieces, rows, size)), np.zeros(len(covariance))
    spread = (noise.measured[:, None] * np.ones((pieces, 1))) ** 2
    push, step = _pushes(track, noise), np.zeros(covariance.shape)
    for row in range(rows):
        inside, counted = track.inside[:, row], track.counted[:, row]
        surprise = -mean[..., :size, :]
        surprise[..., 0] += track.seen[:, row]
        total = covariance[..., :size, :size].copy()
        _diagonal_of(total)[...] += spread * track.doubt[:, row] ** 2
        solved, log = _whitened(total, np.concatenate([covariance[..., :size, :], surprise], axis=-1))
        width = covariance.shape[-1]
        gain, own = solved[..., :width] * inside[:, None, None], np.ascontiguousarray(solved[..., width:])
        cost += (((own[..., 0] ** 2).sum(axis=-1) + log) * counted).sum(axis=-1)
        turned = np.ascontiguousarray(gain.swapaxes(-1, -2))  # BLAS, asked for a view, takes ten times as long
        mean = mean + turned @ own
        covariance = covariance - turned @ gain
        if slopes:
            white[:, row] = own[0] * counted[:, None, None]
            states[:, row] = mean[0, ..., :size, 0]
            ratio[:, row] = surprise[0, ..., 0] / np.sqrt(_diagonal_of(total[0])) * inside[:, None]
        mean, covariance = _onward(track, row, mean, covariance, wide, push, step)
    flat = white.reshape(pieces, rows * size, -1)
    return Innovations(flat[..., 0], flat[..., 1:], states, ratio, cost)


def _whitened(total: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """L^-1 right (..., n, columns) with L L' = total (..., n, n), and log det total (...,).

    Entry by entry for all matrices at once: for a few states half the time of LAPACK's calls, one a matrix.
    """
    entries, lines = (np.ascontiguousarray(np.moveaxis(each, (-2, -1), (0, 1))) for each in (total, right))
    found, root, log = np.empty_like(lines), list[list[FloatArray]](), np.zeros(total.shape[:-2])
    for row, line in enumerate(lines):
        own: list[FloatArray] = []
        for column, other in enumerate(root):
            rest = entries[row, column]
            for one, two in zip(own, other, strict=False):
                rest = rest - one * two
            own.append(rest * other[-1])
        square = entries[row, row]
        for one in own:
            square = square - one * one
        if not square.min(initial=np.inf) > 0.0:
            raise np.linalg.LinAlgError("a covariance is not positive")
        log += np.log(square)
        found[row] = line
        for column, one in enumerate(own):
            found[row] -= one * found[column]
        own.append(1.0 / np.sqrt(square))  # of the diagonal the inverse, by which everything is multiplied
        found[row] *= own[-1]
        root.append(own)
    return np.moveaxis(found, (0, 1), (-2, -1)), log


def _begin(track: LinearizedTrajectory, noise: Noise, paths: int) -> tuple[FloatArray, FloatArray]:
    pieces, _, size = track.seen.shape
    own = np.concatenate([_UNKNOWN * noise.measured, noise.pushes], axis=-1) ** 2
    covariance = np.repeat(_diagonal(own)[:, None], pieces, axis=1)
    mean = np.zeros((len(own), pieces, own.shape[-1], 1 + paths))
    mean[..., :size, 0] = track.seen[:, 0]
    return covariance, mean


def _pushes(track: LinearizedTrajectory, noise: Noise) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What is left of a disturbance after each row (variants, pieces, rows), its fresh variance, that of the states."""
    retained = np.exp(-track.period / noise.seconds[:, None, None])
    fresh = (1.0 - retained**2)[..., None] * noise.pushes[:, None, None] ** 2
    return retained, fresh, (_SMALL * noise.measured) ** 2


def _onward(
    track: LinearizedTrajectory,
    row: int,
    mean: FloatArray,
    covariance: FloatArray,
    wide: FloatArray,
    push: tuple[FloatArray, FloatArray, FloatArray],
    step: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """From one row to the next; ``step`` (variants, pieces, entries, entries) is written over, zeros at first."""
    retained, fresh, small = push
    size = track.seen.shape[-1]
    step[..., :size, :size] = track.transition[:, row]
    for entry, state in enumerate(track.disturbed.tolist(), start=size):
        step[..., state, entry] = track.period[:, row]
        step[..., entry, entry] = retained[..., row]
    mean = step @ mean
    mean[..., :size, 0] += track.drift[:, row]
    mean[..., :size, 1:] += wide[:, row]
    covariance = step @ covariance @ np.ascontiguousarray(step.swapaxes(-1, -2))
    covariance = 0.5 * (covariance + covariance.swapaxes(-1, -2))
    own = _diagonal_of(covariance)
    own[..., :size] += small[:, None] + track.bent[:, row] ** 2
    own[..., size:] += fresh[:, :, row]
    return mean, covariance


def _diagonal_of(matrices: FloatArray) -> FloatArray:
    """A view of the diagonals (..., n) that can be written."""
    return np.asarray(np.einsum("...ii->...i", matrices))


def _diagonal(entries: FloatArray) -> FloatArray:
    return np.asarray(entries[..., None] * np.eye(entries.shape[-1]))
