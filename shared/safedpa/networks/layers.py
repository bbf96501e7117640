"""Dense and convolutional layers in NumPy, so that a service needs no deep-learning framework."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from safedpa.arrays import AnyFloatArray
from safedpa.errors import InputError

__all__ = ["Activation", "Layer", "convolution_stack", "dense_stack", "layers_of"]

Activation = Literal["relu", "tanh"]


class Layer(NamedTuple):
    """Weight and bias: (out, in) and (out,) of a dense layer, (out, in, kernel) and (out,) of a convolution."""

    weight: AnyFloatArray
    bias: AnyFloatArray


def layers_of(tensors: Mapping[str, AnyFloatArray], prefix: str) -> tuple[Layer, ...]:
    """Returns the layers ``prefix.0``, ``prefix.1``, ... of a weights file; none if there is no such network.

    Raises InputError if a weight has no bias.
    """
    layers: list[Layer] = []
    while (name := f"{prefix}.{len(layers)}.weight") in tensors:
        bias = f"{prefix}.{len(layers)}.bias"
        if bias not in tensors:
            raise InputError(f"weights: got '{name}' without '{bias}', wanted both; write the file again")
        layers.append(Layer(tensors[name], tensors[bias]))
    return tuple(layers)


def dense_stack(
    x: AnyFloatArray, layers: Sequence[Layer], activation: Activation, *, last_linear: bool = True
) -> AnyFloatArray:
    """Returns W_n s(... s(W_1 x + b_1) ...) + b_n (..., out) for x (..., in), with the activation s.

    If not ``last_linear``, the activation is also applied after the last layer.
    """
    last, leading = len(layers) - 1, x.shape[:-1]
    x = x.reshape(-1, x.shape[-1]) if x.ndim > 2 else x  # one matrix product, not one per leading index
    for index, (weight, bias) in enumerate(layers):
        x = x @ weight.T
        x += bias
        if index < last or not last_linear:
            x = np.maximum(x, 0.0, out=x) if activation == "relu" else np.tanh(x, out=x)
    return x.reshape(*leading, x.shape[-1])


def convolution_stack(x: AnyFloatArray, layers: Sequence[Layer], stride: int) -> AnyFloatArray:
    """Applies convolutions over time without padding, each followed by ReLU: (..., time, in) to (..., time', out).

    y[t, o] = relu(b[o] + sum over i, j of W[o, i, j] x[stride t + j, i]).
    """
    for weight, bias in layers:
        out, inputs, kernel = weight.shape
        leading, steps = x.shape[:-2], (x.shape[-2] - kernel) // stride + 1
        row_by_row = x.reshape(*leading, -1)
        # each window as one row of a matrix, without a copy: the convolution becomes one matrix product
        windows = np.lib.stride_tricks.sliding_window_view(row_by_row, kernel * inputs, axis=-1)
        flat = windows[..., :: stride * inputs, :].reshape(-1, kernel * inputs)
        y = flat @ weight.transpose(2, 1, 0).reshape(-1, out)
        y += bias
        x = np.maximum(y, 0.0, out=y).reshape(*leading, steps, out)
    return x
