"""The learned control-affine dynamics x' = f(x, z) + g(x, z) a and the environment encoder z = mu(e).

The drift f and the control matrix g have the same input and are evaluated together. Their first layers are merged into
one matrix, and so are their last ones, together with the scaling of the outputs. Each bias is one more column, whose
input is a constant 1 that the first layer passes on. A call allocates nothing. For one state C computes the same, where
it has the same bits (``compiled``).
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import Float32Array, FloatArray
from safedpa.errors import InputError
from safedpa.networks.compiled import CompiledNetworks, Product
from safedpa.networks.frame import Frame, frame_of
from safedpa.networks.layers import Layer, dense_stack, layers_of
from safedpa.networks.plain_rows import world_row
from safedpa.networks.weights import Weights

__all__ = ["LearnedNetworks", "Paired"]


@final
class LearnedNetworks:
    """Inference of mu, f and g. With n = [(features(x) - middle) / scale, z], u = (a - action_middle) / action_scale:

        increment in the robot's own frame = increment_scale (F(n) + G(n) u)

    ``frame`` defaults to that of the weights' robot; weights for another state need their own.

    Source: Xiao, He, Dolan, Shi, Safe Deep Policy Adaptation, ICRA 2024, section III; own frame and scales are ours.
    """

    def __init__(self, weights: Weights, frame: Frame | None = None) -> None:
        self.weights = weights
        self.description = weights.description
        self._given = frame
        self._frame = frame or frame_of(weights.description.robot)
        self._mu = layers_of(weights.tensors, "mu")
        self._increments = self._paired(weights)
        self._compiled: CompiledNetworks | None = None

    def __getstate__(self) -> dict[str, Any]:
        # without the buffers: they are rebuilt, and two copies must not share them
        return {"weights": self.weights, "frame": self._given}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["weights"], state["frame"])

    def own_increment(self, state: FloatArray, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns f (..., states) and g (..., states, actions) of the increment f + g a in the robot's own frame.

        For states (..., states) and latents (..., latents); a has the action's units.
        """
        features = self._frame.features(state)
        shape = np.broadcast_shapes(features.shape[:-1], latent.shape[:-1])
        parts = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in (features, latent)]
        seen = np.concatenate(parts, axis=-1)
        found = self._increments.many(seen.reshape(-1, seen.shape[-1])).astype(np.float64)
        found = found.reshape(*shape, state.shape[-1], -1)
        return found[..., 0], found[..., 1:]

    def increment(self, state: FloatArray, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns f and g of the increment f + g a of the state itself; shapes as in ``own_increment``."""
        if state.ndim == latent.ndim == 1:
            f_of_one, g_of_one = self.increment_of_one(state.tolist(), latent.tolist())
            return np.array(f_of_one), np.array(g_of_one)
        f, g = self.own_increment(state, latent)
        turned = [self._frame.world_increment(state, g[..., index]) for index in range(g.shape[-1])]
        return self._frame.world_increment(state, f), np.stack(turned, axis=-1)

    def increment_of_one(
        self, state: Sequence[float], latent: Sequence[float]
    ) -> tuple[list[float], list[list[float]]]:
        """Returns ``increment`` for the entries of one state and latent: f (states,), g (states, actions)."""
        row, states = self.row_of_one(state, latent), len(state)
        actions = len(row) // states - 1
        return row[:states], [row[start : start + actions] for start in range(states, len(row), actions)]

    def row_of_one(self, state: Sequence[float], latent: Sequence[float]) -> list[float]:
        """Returns ``increment_of_one`` in one list: f, then g row by row."""
        compiled = self.compiled
        if compiled is not None:
            try:
                known: list[float] = compiled.known(state, latent)
                return known
            except (TypeError, ValueError, ArithmeticError):  # other sizes or odd numbers: NumPy decides
                pass
        rows = self._increments.plain_of_one((*self._frame.features_of_one(state), *latent))
        width = len(rows) // len(state)
        self._frame.turn_to_world(state, rows, width)
        return world_row(rows, width)

    @property
    def compiled(self) -> Any:
        """The ``safedpa_kernel.Networks`` with the same results for one state; None: there is none, or not yet."""
        late = self._compiled
        if late is None:
            described = self.description
            sizes = len(described.states), len(described.actions), described.latents
            late = self._compiled = CompiledNetworks(self._frame, sizes, *self._increments.products())
        return late.networks

    def wait_for_compiler(self) -> None:
        """Waits until no compiler is busy with the networks."""
        if self.compiled is None and self._compiled is not None:
            self._compiled.wait()

    def _paired(self, weights: Weights) -> Paired:
        """Returns F and G as functions of features and latent in SI units, with outputs (f, g) for each state entry."""
        # offset and scale of actions and increments are linear: they are folded into the first and last layers
        feature, scale = weights["feature_middle"].astype(np.float64), weights["feature_scale"].astype(np.float64)
        action, reach = weights["action_middle"].astype(np.float64), weights["action_scale"].astype(np.float64)
        increment = weights["increment_scale"].astype(np.float64)
        states, actions = len(increment), len(action)
        mix = np.zeros((states, 1 + actions, states + states * actions))
        for entry in range(states):
            slopes = slice(states + entry * actions, states + (entry + 1) * actions)
            mix[entry, 0, entry] = increment[entry]
            mix[entry, 1:, slopes] = np.diag(increment[entry] / reach)
            mix[entry, 0, slopes] = -increment[entry] * action / reach
        f, g = (_unscaled(layers_of(weights.tensors, name), feature, scale) for name in ("f", "g"))
        return Paired(f, g, mix.reshape(states * (1 + actions), -1))

    def encode(self, environment: FloatArray) -> FloatArray:
        """Returns z = mu((e - middle) / scale) (..., latents) for environments e (..., entries) in SI units."""
        middle, scale = self.weights["environment_middle"], self.weights["environment_scale"]
        scaled = ((environment - middle) / scale).astype(np.float32)
        return dense_stack(scaled, self._mu, "relu").astype(np.float64)


def _unscaled(layers: Sequence[Layer], middle: FloatArray, scale: FloatArray) -> list[Layer]:
    """Returns layers whose first inputs are x instead of (x - middle) / scale."""
    first, *others = layers
    weight = first.weight.astype(np.float64)
    weight[:, : len(scale)] /= scale
    return [Layer(weight, first.bias - weight[:, : len(scale)] @ middle), *others]


_PAD = 16
"""Columns after the units of each network: the constant 1, then zeros, so that rows start on cache lines."""
_CHUNK = 128
"""Inputs per batch: the values between the layers stay in the processor's cache."""
_ZERO = np.zeros((), dtype=np.float32)


class _Middle(NamedTuple):
    """One network's part of a hidden layer: its input columns, its output columns, and the matrix between them."""

    before: slice
    after: slice
    matrix: Float32Array


@final
class Paired:
    """y = M [F(x); G(x)] for two networks with ReLU and a matrix M (outputs, outputs of F + outputs of G).

    ``one`` takes a single input, ``many`` any number. Raises InputError unless F and G have equally many layers, at
    least two.
    """

    def __init__(self, first: Sequence[Layer], second: Sequence[Layer], mix: NDArray[np.float64]) -> None:
        if len(first) != len(second) or len(first) < 2:
            raise InputError(f"weights: f has {len(first)} layers, g has {len(second)}; wanted as many, two at least")
        pairs = list(zip(first, second, strict=True))
        self._enter = np.concatenate([_entering(layer) for layer in pairs[0]], axis=1)
        self._middle = [_middle(*pair) for pair in pairs[1:-1]]
        self._leave = _leaving(*pairs[-1], mix)
        self._work = _Work(self._enter, self._middle, self._leave)

    def products(self) -> tuple[list[Product], Float32Array]:
        """Returns what ``one`` computes, product by product, with arrays of its own, and the array of the input."""
        work = _Work(self._enter, self._middle, self._leave)
        return work.products, work.input[0]

    def one(self, values: Sequence[float]) -> Float32Array:
        """Returns y (outputs,) for x (inputs,), floats or an array; the next call overwrites it."""
        work = self._work
        work.input[0, :-1] = values
        work.run()
        return work.output

    def plain_of_one(self, values: Sequence[float]) -> list[float]:
        """Returns ``one`` as floats. struct copies them into the buffer faster than NumPy's assignment."""
        work = self._work
        try:
            work.put(work.first, 0, *values)
        except (OverflowError, struct.error):  # beyond float32, or another number of entries: NumPy decides
            work.input[0, :-1] = values
        work.run()
        return list(work.take(work.last))

    def many(self, inputs: NDArray[np.floating]) -> Float32Array:
        """Returns y (n, outputs) for x (n, inputs)."""
        work, outputs = self._work, np.empty((len(inputs), self._leave.shape[1]), dtype=np.float32)
        for start in range(0, len(inputs), _CHUNK):
            part = inputs[start : start + _CHUNK]
            count = len(part)
            x = work.input[:count]
            x[:, :-1] = part
            hidden = np.matmul(x, self._enter, out=work.hidden[0][:count])
            np.maximum(hidden, _ZERO, out=hidden)
            for middle, buffer in zip(self._middle, work.hidden[1:], strict=True):
                following = buffer[:count]
                for before, after, matrix in middle:
                    np.matmul(hidden[:, before], matrix, out=following[:, after])
                hidden = np.maximum(following, _ZERO, out=following)
            np.matmul(hidden, self._leave, out=outputs[start : start + count])
        return outputs


class _Work(threading.local):
    """Buffers between the layers, one set per thread: NumPy releases the interpreter lock during a product."""

    def __init__(self, enter: Float32Array, middle: Sequence[tuple[_Middle, _Middle]], leave: Float32Array) -> None:
        widths = [enter.shape[1], *(right.after.stop + _PAD for _, right in middle)]
        self.input = np.ones((_CHUNK, len(enter)), dtype=np.float32)
        self.hidden = [np.zeros((_CHUNK, width), dtype=np.float32) for width in widths]
        for (left, right), buffer in zip(middle, self.hidden[1:], strict=True):
            buffer[:, left.after.stop] = buffer[:, right.after.stop] = 1.0
        self.output: Float32Array = np.zeros(leave.shape[1], dtype=np.float32)
        self.products = self._products_of_one(enter, middle, leave)
        self.steps = [step for product in self.products for step in _steps(product)]
        self.put, self.take = (
            struct.Struct(f"{len(enter) - 1}f").pack_into,
            struct.Struct(f"{leave.shape[1]}f").unpack_from,
        )
        self.first, self.last = self.input[0].data.cast("B"), self.output.data.cast("B")

    def run(self) -> None:
        """Evaluates the networks for the first row of ``input``."""
        for step in self.steps:
            step()

    def _products_of_one(
        self, enter: Float32Array, middle: Sequence[tuple[_Middle, _Middle]], leave: Float32Array
    ) -> list[Product]:
        rows = [buffer[0] for buffer in self.hidden]
        products: list[Product] = [(enter, self.input[0], rows[0], rows[0])]
        for (left, right), before, after in zip(middle, rows, rows[1:], strict=False):
            products.append((left.matrix, before[left.before], after[left.after], None))
            products.append((right.matrix, before[right.before], after[right.after], after))
        return [*products, (leave, rows[-1], self.output, None)]


def _steps(product: Product) -> list[Callable[[], Any]]:
    """Returns the product and the ReLU after it, with all arguments bound."""
    matrix, before, after, cut = product
    steps: list[Callable[[], Any]] = [partial(before.dot, matrix, after)]
    if cut is not None:
        # zeros of the layer's shape: a comparison with a broadcast scalar takes longer
        steps.append(partial(np.maximum, cut, np.zeros_like(cut), out=cut))
    return steps


def _entering(layer: Layer) -> Float32Array:
    """Returns the matrix (inputs + 1, units + pad) of a first layer; one more column passes the constant 1 on."""
    units, inputs = layer.weight.shape
    matrix = np.zeros((inputs + 1, units + _PAD), dtype=np.float32)
    matrix[:-1, :units], matrix[-1, :units], matrix[-1, units] = layer.weight.T, layer.bias, 1.0
    return matrix


def _middle(first: Layer, second: Layer) -> tuple[_Middle, _Middle]:
    start_before = first.weight.shape[1] + _PAD
    start_after = len(first.weight) + _PAD
    made = []
    for layer, before, after in ((first, 0, 0), (second, start_before, start_after)):
        units, inputs = layer.weight.shape
        matrix = np.zeros((inputs + _PAD, units), dtype=np.float32)
        matrix[:inputs], matrix[inputs] = layer.weight.T, layer.bias
        made.append(_Middle(slice(before, before + inputs + _PAD), slice(after, after + units), matrix))
    return made[0], made[1]


def _leaving(first: Layer, second: Layer, mix: NDArray[np.float64]) -> Float32Array:
    """Returns the matrix (padded units of both, outputs) of the last layers, multiplied by ``mix``."""
    blocks, start = [], 0
    for layer in (first, second):
        share = mix[:, start : start + len(layer.weight)]
        start += len(layer.weight)
        block = np.zeros((layer.weight.shape[1] + _PAD, len(mix)))
        block[:-_PAD], block[-_PAD] = (share @ layer.weight).T, share @ layer.bias
        blocks.append(block)
    return np.concatenate(blocks).astype(np.float32)
