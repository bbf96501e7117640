"""Kalman filters along recordings: a model linearised about a reference trajectory, many pieces at once.

The filter state z = (deviation from the reference, disturbances of the rates) follows

z[k+1] = T[k] z[k] + (model(reference[k]) - reference[k+1], 0) + G[k] shift
measured - reference = first part of z + noise

with one more column of the mean per parameter, which is its derivative. The disturbances are first-order Markov
processes. They absorb what a lasting push does to the speed, so that it does not bias the parameters.

Source: Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 7; Ljung, System Identification, 2nd ed., 1999,
section 7.2 (prediction errors).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray

# Process noise of every state, relative to the measurement noise: keeps the covariances positive definite.
_PROCESS_NOISE = 1e-5
# Standard deviation of a piece's start, relative to the measurement noise: wide enough to leave the start free.
_START_SPREAD = 30.0


@dataclass(frozen=True)
class Noise:
    """Noise parameters of the filter, one set or several (...).

    ``measured`` (..., states): standard deviation of the measurement, in state units. ``disturbances``
    (..., disturbed): standard deviation of the disturbances, in state units per second. ``seconds`` (...,): correlation
    time of the disturbances, after which 37 % of one is left.
    """

    measured: FloatArray
    disturbances: FloatArray
    seconds: FloatArray


@dataclass(frozen=True)
class LinearizedTrajectory:
    """A model linearised about a reference trajectory, by piece and row (pieces, rows, ...).

    ``transition`` (..., states, states) and ``drift`` (..., states) lead from a row to the next. ``columns``
    (..., states, paths) are derivatives of that step with respect to the parameters. ``measured`` (..., states):
    measured - reference. ``period`` (...): time to the next row [s].
    """

    transition: FloatArray
    drift: FloatArray
    columns: FloatArray
    measured: FloatArray
    period: FloatArray
    inside: NDArray[np.bool_]
    """Rows that exist."""
    counted: NDArray[np.bool_]
    """Rows that exist and lie after the settling time of the filter."""
    noise_factor: FloatArray
    """Factor on the measurement noise (pieces, rows, states): 1, or more for outliers."""
    nonlinearity: FloatArray
    """Linearisation error over one standard deviation of the measurement (pieces, rows, states), in the state's unit.

    The filter adds it as process noise.
    """
    disturbed: NDArray[np.int64]
    """Indices of the states whose rates are disturbed."""


@dataclass(frozen=True)
class Innovations:
    """Innovations of one pass of the filter.

    ``white`` (pieces, rows * states) are the whitened innovations and ``columns`` (..., paths) their derivatives.
    ``states`` (pieces, rows, states): filtered deviation from the reference. ``ratio``: innovation over its standard
    deviation, by state. ``cost`` (noises,): -2 log likelihood without its constant.
    """

    white: FloatArray
    columns: FloatArray
    states: FloatArray
    ratio: FloatArray
    cost: FloatArray


def kalman_innovations(track: LinearizedTrajectory, noise: Noise, slopes: bool = True) -> Innovations:
    """Runs the filter once over every piece.

    Without ``slopes`` the noise may have several variants (variants, ...), and only ``cost`` of each is computed.
    """
    pieces, rows, size = track.measured.shape
    columns = track.columns if slopes else track.columns[..., :0]
    covariance, mean = _initial_state(track, noise, columns.shape[-1])
    white = np.zeros((pieces, rows, size, 1 + columns.shape[-1]))
    states, ratio, cost = np.zeros((pieces, rows, size)), np.zeros((pieces, rows, size)), np.zeros(len(covariance))
    spread = (noise.measured[:, None] * np.ones((pieces, 1))) ** 2
    disturbance, step = _disturbance_model(track, noise), np.zeros(covariance.shape)
    for row in range(rows):
        inside, counted = track.inside[:, row], track.counted[:, row]
        innovation = -mean[..., :size, :]
        innovation[..., 0] += track.measured[:, row]
        total = covariance[..., :size, :size].copy()
        # An outlier gets a larger measurement noise instead of being dropped, so the cost stays a likelihood.
        _diagonal_of(total)[...] += spread * track.noise_factor[:, row] ** 2
        solved, log = _whitened(total, np.concatenate([covariance[..., :size, :], innovation], axis=-1))
        width = covariance.shape[-1]
        # Rows beyond the end of a piece get a zero gain, so the batch needs no ragged arrays.
        gain, whitened = solved[..., :width] * inside[:, None, None], np.ascontiguousarray(solved[..., width:])
        # Only counted rows: the settling time before them depends on the arbitrary initial covariance.
        cost += (((whitened[..., 0] ** 2).sum(axis=-1) + log) * counted).sum(axis=-1)
        # A contiguous copy: BLAS takes ten times as long on the transposed view.
        transposed = np.ascontiguousarray(gain.swapaxes(-1, -2))
        mean = mean + transposed @ whitened
        covariance = covariance - transposed @ gain
        if slopes:
            white[:, row] = whitened[0] * counted[:, None, None]
            states[:, row] = mean[0, ..., :size, 0]
            ratio[:, row] = innovation[0, ..., 0] / np.sqrt(_diagonal_of(total[0])) * inside[:, None]
        mean, covariance = _predict(track, row, mean, covariance, columns, disturbance, step)
    flat = white.reshape(pieces, rows * size, -1)
    return Innovations(flat[..., 0], flat[..., 1:], states, ratio, cost)


def _whitened(total: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns L^-1 right (..., n, columns) with L L' = total (..., n, n), and log det total (...,).

    The Cholesky factor is computed entry by entry for all matrices at once. For a few states that takes half the time
    of one LAPACK call per matrix.
    """
    entries, lines = (np.ascontiguousarray(np.moveaxis(each, (-2, -1), (0, 1))) for each in (total, right))
    found, root, log = np.empty_like(lines), list[list[FloatArray]](), np.zeros(total.shape[:-2])
    for row, line in enumerate(lines):
        factor_row: list[FloatArray] = []
        for column, other in enumerate(root):
            rest = entries[row, column]
            for one, two in zip(factor_row, other, strict=False):
                rest = rest - one * two
            factor_row.append(rest * other[-1])
        square = entries[row, row]
        for one in factor_row:
            square = square - one * one
        if not square.min(initial=np.inf) > 0.0:
            raise np.linalg.LinAlgError("a covariance is not positive")
        log += np.log(square)
        found[row] = line
        for column, one in enumerate(factor_row):
            found[row] -= one * found[column]
        # The diagonal holds the inverse: multiplying by it is faster than dividing.
        factor_row.append(1.0 / np.sqrt(square))
        found[row] *= factor_row[-1]
        root.append(factor_row)
    return np.moveaxis(found, (0, 1), (-2, -1)), log


def _initial_state(track: LinearizedTrajectory, noise: Noise, paths: int) -> tuple[FloatArray, FloatArray]:
    """Returns the covariance and mean before the first row: the first measurement, with a wide covariance."""
    pieces, _, size = track.measured.shape
    variances = np.concatenate([_START_SPREAD * noise.measured, noise.disturbances], axis=-1) ** 2
    covariance = np.repeat(_diagonal(variances)[:, None], pieces, axis=1)
    mean = np.zeros((len(variances), pieces, variances.shape[-1], 1 + paths))
    # The derivative columns start at 0: the start does not depend on the parameters.
    mean[..., :size, 0] = track.measured[:, 0]
    return covariance, mean


def _disturbance_model(track: LinearizedTrajectory, noise: Noise) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns the decay of a disturbance per row, its added variance, and the process noise of the states.

    Shapes: (variants, pieces, rows), (variants, pieces, rows, disturbed), (variants, states).
    """
    decay = np.exp(-track.period / noise.seconds[:, None, None])
    # Added variance (1 - decay^2) keeps the disturbance stationary at its standard deviation.
    added = (1.0 - decay**2)[..., None] * noise.disturbances[:, None, None] ** 2
    return decay, added, (_PROCESS_NOISE * noise.measured) ** 2


def _predict(
    track: LinearizedTrajectory,
    row: int,
    mean: FloatArray,
    covariance: FloatArray,
    columns: FloatArray,
    disturbance: tuple[FloatArray, FloatArray, FloatArray],
    step: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Predicts mean and covariance of the next row; ``step`` is a work array (variants, pieces, entries, entries).

    ``step`` is zero before the first call: entries that are never written stay zero.
    """
    decay, added, process = disturbance
    size = track.measured.shape[-1]
    step[..., :size, :size] = track.transition[:, row]
    for entry, state in enumerate(track.disturbed.tolist(), start=size):
        # A disturbance is a rate, so it adds period times itself to its state.
        step[..., state, entry] = track.period[:, row]
        step[..., entry, entry] = decay[..., row]
    mean = step @ mean
    mean[..., :size, 0] += track.drift[:, row]
    mean[..., :size, 1:] += columns[:, row]
    covariance = step @ covariance @ np.ascontiguousarray(step.swapaxes(-1, -2))
    # Rounding makes the product slightly asymmetric, which would grow from row to row.
    covariance = 0.5 * (covariance + covariance.swapaxes(-1, -2))
    variances = _diagonal_of(covariance)
    variances[..., :size] += process[:, None] + track.nonlinearity[:, row] ** 2
    variances[..., size:] += added[:, :, row]
    return mean, covariance


def _diagonal_of(matrices: FloatArray) -> FloatArray:
    """Returns a writable view of the diagonals (..., n)."""
    return np.asarray(np.einsum("...ii->...i", matrices))


def _diagonal(entries: FloatArray) -> FloatArray:
    return np.asarray(entries[..., None] * np.eye(entries.shape[-1]))
