"""Dense and convolutional layers in numpy: some matrix products, and nothing else at work in a service."""

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
    """The layers ``prefix.0``, ``prefix.1``, ... of a weights file; none when there is no such network.

    Raises InputError when a weight comes without its bias.
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
    """y = W_n s(... s(W_1 x + b_1) ...) + b_n for x (..., in), shape (..., out); s is the activation.

    ``last_linear`` false applies the activation after the last layer, too.
    """
    last, leading = len(layers) - 1, x.shape[:-1]
    x = x.reshape(-1, x.shape[-1]) if x.ndim > 2 else x  # one product of matrices instead of one for each leading index
    for index, (weight, bias) in enumerate(layers):
        x = x @ weight.T
        x += bias
        if index < last or not last_linear:
            x = np.maximum(x, 0.0, out=x) if activation == "relu" else np.tanh(x, out=x)
    return x.reshape(*leading, x.shape[-1])


def convolution_stack(x: AnyFloatArray, layers: Sequence[Layer], stride: int) -> AnyFloatArray:
    """Convolutions over time with ReLU after each, without padding: x (..., time, in) to (..., shorter time, out).

    y[t, o] = relu(b[o] + sum over i, j of W[o, i, j] x[stride t + j, i]).
    """
    for weight, bias in layers:
        out, inputs, kernel = weight.shape
        leading, steps = x.shape[:-2], (x.shape[-2] - kernel) // stride + 1
        row_by_row = x.reshape(*leading, -1)
        windows = np.lib.stride_tricks.sliding_window_view(row_by_row, kernel * inputs, axis=-1)
        flat = windows[..., :: stride * inputs, :].reshape(-1, kernel * inputs)
        y = flat @ weight.transpose(2, 1, 0).reshape(-1, out)
        y += bias
        x = np.maximum(y, 0.0, out=y).reshape(*leading, steps, out)
    return x
