"""Evaluates the history encoder phi incrementally: results for earlier rows are reused.

phi has the last k rows as input. A tick adds one row and shifts the others by one. The dense layers work row by row, so
only the newest row is new. A convolution with kernel K and stride 4 has windows that end at the newest value and at
every fourth one before it; the newest window of four ticks ago is now the second newest. So only its newest output is
new. With c the outputs of the previous layer, of which every D-th is an input (D = 1, 4, ...),

    c'[t] = relu(b + sum over j of W[j] c[t - D (K - 1 - j)])

A tick takes one matrix-vector product per layer, a tenth of phi over the whole history, and every sum has the same
terms. Source: Paine et al., Fast WaveNet generation algorithm, arXiv:1611.09482.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from safedpa.arrays import Float32Array, FloatArray
from safedpa.errors import InputError
from safedpa.networks.history import HistoryEncoder
from safedpa.networks.layers import Layer
from safedpa.networks.weights import STRIDE

__all__ = ["HistoryStreams"]


_ZERO = np.zeros((), dtype=np.float32)


@final
class HistoryStreams:
    """phi of the last k rows of several robots, which get a row at the same time.

    ``push`` returns ``HistoryEncoder.encode`` of the last k rows (zeros before the first), to single precision.
    """

    def __init__(self, encoder: HistoryEncoder, robots: int = 1) -> None:
        self.robots, self._encoder = robots, encoder
        # for one robot np.dot has less overhead; it cannot write into the rows that several robots need
        self._product: Any = np.dot if robots == 1 else np.matmul
        self._input = np.ones((robots, encoder.row_length), dtype=np.float32)
        self._dense = [_Dense(layer, robots) for layer in encoder.dense]
        self._series, lag = _series_of(encoder, robots)
        self._lag = lag
        self._kernels = [(_by_time(layer.weight), layer.bias) for layer in encoder.convolutions]
        last = self._series[-1]
        self._out = _by_time(encoder.out.weight.reshape(len(encoder.out.weight), last.width, last.kernel))
        self._out_bias = encoder.out.bias
        self._latent: Float32Array = np.zeros((robots, encoder.latents), dtype=np.float32)
        self._low, self._high = encoder.low.astype(np.float32), encoder.high.astype(np.float32)
        self._ticks = 0
        self._of_nothing = _values_of_nothing(encoder)
        self.reset()

    def push(self, rows: FloatArray | Sequence[Sequence[float]]) -> Float32Array:
        """Returns z (robots, latents) after one more row (robots, row_length); the next call overwrites it."""
        product, tick = self._product, self._ticks
        self._input[:] = rows
        value = self._input
        for dense in self._dense:
            value = dense.of(value, product)
        self._series[0].keep(value, tick)
        for (matrix, bias), before, after in zip(self._kernels, self._series, self._series[1:], strict=False):
            y = after.place(tick)
            product(before.window(tick), matrix, out=y)
            np.add(y, bias, out=y)
            np.maximum(y, _ZERO, out=y)
            after.commit(tick)
        self._ticks = tick + 1
        return self._encoded(tick)

    def reset(self, which: slice | Sequence[int] = slice(None)) -> None:
        """Starts new histories, of all robots or of those named."""
        for series, value in zip(self._series, self._of_nothing, strict=True):
            series.fill(which, value)

    def _encoded(self, tick: int) -> Float32Array:
        latent = self._latent
        self._product(self._series[-1].window(tick - self._lag), self._out, out=latent)
        np.add(latent, self._out_bias, out=latent)
        np.maximum(latent, self._low, out=latent)
        return np.minimum(latent, self._high, out=latent)


@final
class _Dense:
    """relu(W x + b) for x (robots, in), into one buffer."""

    def __init__(self, layer: Layer, robots: int) -> None:
        self._matrix, self._bias = np.ascontiguousarray(layer.weight.T), layer.bias
        self._output = np.zeros((robots, len(layer.weight)), dtype=np.float32)

    def of(self, x: Float32Array, product: Any) -> Float32Array:
        output = self._output
        product(x, self._matrix, out=output)
        np.add(output, self._bias, out=output)
        return np.maximum(output, _ZERO, out=output)


@final
class _Series:
    """A ring buffer of each robot's last ``kernel`` of every ``spacing``-th value (width,), contiguous in memory.

    Each value is written twice, ``kernel`` positions apart, so that the last ``kernel`` are contiguous and in order
    wherever the ring starts. All views are made once.
    """

    def __init__(self, robots: int, width: int, kernel: int, spacing: int) -> None:
        self.width, self.kernel = width, kernel
        self._values = np.zeros((spacing, robots, 2 * kernel * width), dtype=np.float32)
        self._places: list[Float32Array] = []
        self._twins: list[Float32Array] = []
        self._windows: list[Float32Array] = []
        for place in range(kernel):
            for phase in self._values:
                start, twin = place * width, (place + kernel) * width
                self._places.append(phase[:, start : start + width])
                self._twins.append(phase[:, twin : twin + width])
                self._windows.append(phase[:, start + width : twin + width])

    def place(self, tick: int) -> Float32Array:
        """Returns the buffer (robots, width) for the value of a tick; call ``commit`` after writing."""
        return self._places[tick % len(self._places)]

    def commit(self, tick: int) -> None:
        at = tick % len(self._places)
        self._twins[at][:] = self._places[at]

    def keep(self, value: Float32Array, tick: int) -> None:
        self.place(tick)[:] = value
        self.commit(tick)

    def window(self, tick: int) -> Float32Array:
        """Returns (robots, kernel * width): the values 0, ``spacing``, 2 ``spacing``, ... ticks before, newest last."""
        return self._windows[tick % len(self._windows)]

    def fill(self, which: slice | Sequence[int], value: Float32Array) -> None:
        """Sets the values of all ticks so far to one value (1, width)."""
        self._values[:, which] = np.tile(value, 2 * self.kernel)


def _values_of_nothing(encoder: HistoryEncoder) -> list[Float32Array]:
    """Returns the inputs (1, width) of each convolution and of the last layer for rows of zeros."""
    seen = np.zeros((1, encoder.row_length), dtype=np.float32)
    for layer in encoder.dense:
        seen = np.maximum(seen @ layer.weight.T + layer.bias, _ZERO)
    values = [seen]
    for weight, bias in encoder.convolutions:
        seen = np.maximum(np.tile(seen, weight.shape[2]) @ _by_time(weight) + bias, _ZERO)
        values.append(seen)
    return values


def _series_of(encoder: HistoryEncoder, robots: int) -> tuple[list[_Series], int]:
    """Returns the inputs of each convolution and of the last layer, and the lag of the last layer in ticks."""
    # convolutions without padding leave out the newest values of a history that the strides do not divide
    series, spacing, length, lag = [], 1, encoder.length, 0
    width = len(encoder.dense[-1].weight) if encoder.dense else encoder.row_length
    for layer in encoder.convolutions:
        kernel = layer.weight.shape[2]
        if length < kernel:
            raise InputError(f"history: got {encoder.length} rows, too few for the convolutions; wanted more")
        series.append(_Series(robots, width, kernel, spacing))
        lag += (length - kernel) % STRIDE * spacing
        width, length, spacing = len(layer.weight), (length - kernel) // STRIDE + 1, spacing * STRIDE
    series.append(_Series(robots, width, length, spacing))
    return series, lag


def _by_time(weight: Float32Array) -> Float32Array:
    """Returns a kernel (out, in, time) as a matrix (time * in, out), in the order of a window in memory."""
    return np.ascontiguousarray(weight.transpose(2, 1, 0).reshape(-1, len(weight)))
