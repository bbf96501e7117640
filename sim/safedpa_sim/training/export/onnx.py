"""Export of the learned networks mu, f, g, phi and policy as ONNX files for other programs.

Every graph is built node by node from the weights and includes the scales: inputs and outputs are in SI units.

    mu.onnx       environment (batch, entries)                              -> latent (batch, latents)
    f.onnx        state (batch, states), latent (batch, latents)            -> f (batch, states)
    g.onnx        state (batch, states), latent (batch, latents)            -> g (batch, states, actions)
    phi.onnx      rows (batch, history, row)                                -> latent (batch, latents)
    policy.onnx   observation (batch, observations)                         -> action (batch, actions)

f and g predict in the robot's own frame: own-frame increment = f + g a. Rows are those of ``HistoryEncoder``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.extras import need
from safedpa.networks import Weights
from safedpa.networks.layers import layers_of
from safedpa.networks.weights import STRIDE
from safedpa.records.writers.tables import atomic_path

NETWORKS = ("mu", "f", "g", "phi", "policy")
_OPSET = 17
_IR_VERSION = 9
_LARGEST_OBSERVATION = 10.0
"""Scaled observations are clipped to this value, as in ``LearnedPolicy``."""

_FEATURES = {"car": ("yaw", "speed"), "pendulum": ("angle", "rate")}
"""State entries that the networks see: the first as cosine and sine, the second unchanged."""


def export_onnx(weights: Weights, folder: Path) -> tuple[Path, ...]:
    """Writes every network in the weights as ``<name>.onnx`` into ``folder`` and returns the paths.

    Raises MissingExtraError when the packages for ONNX are not installed.
    """
    need("train", what="--onnx")
    import onnx

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name in NETWORKS:
        if weights.has(name):
            model = _GRAPHS[name](weights)
            onnx.checker.check_model(model, full_check=True)
            path = folder / f"{name}.onnx"
            with atomic_path(path) as unfinished:
                unfinished.write_bytes(model.SerializeToString())
            written.append(path)
    return tuple(written)


@final
class _Graph:
    """Builder of an ONNX graph; each ``add`` appends a node and returns the name of its output."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, values: Any, kind: Any = np.float32) -> str:
        from onnx import numpy_helper

        name = f"constant_{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.asarray(values, dtype=kind), name))
        return name

    def add(self, kind: str, *inputs: str, **attributes: Any) -> str:
        from onnx import helper

        name = f"{kind.lower()}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def scaled(self, values: str, middle: NDArray[np.float32], scale: NDArray[np.float32]) -> str:
        """Adds (values - middle) / scale."""
        return self.add("Div", self.add("Sub", values, self.constant(middle)), self.constant(scale))

    def dense(self, values: str, weights: Weights, prefix: str, activation: str) -> str:
        """Adds dense layers with an activation between them, none after the last; ``values`` (batch, in)."""
        layers = layers_of(weights.tensors, prefix)
        for index, layer in enumerate(layers):
            values = self.add("Gemm", values, self.constant(layer.weight), self.constant(layer.bias), transB=1)
            if index < len(layers) - 1:
                values = self.add(activation, values)
        return values

    def model(self, inputs: dict[str, tuple[int, ...]], output: str, shape: tuple[int, ...], result: str) -> Any:
        """Returns the model with ``result`` as its output; shapes are without the batch dimension."""
        import onnx
        from onnx import TensorProto, helper

        self._nodes.append(helper.make_node("Identity", [result], [output], name=output))
        given, taken = (
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *sizes]) for name, sizes in pairs.items()]
            for pairs in ({output: shape}, inputs)
        )
        graph = helper.make_graph(self._nodes, self.name, taken, given, self._constants)
        opset = helper.make_opsetid("", _OPSET)
        model: onnx.ModelProto = helper.make_model(graph, opset_imports=[opset], producer_name="safedpa")
        model.ir_version = _IR_VERSION
        return model


def _mu(weights: Weights) -> Any:
    graph = _Graph("mu")
    scaled = graph.scaled("environment", weights["environment_middle"], weights["environment_scale"])
    latent = graph.dense(scaled, weights, "mu", "Relu")
    described = weights.description
    return graph.model({"environment": (len(described.environment),)}, "latent", (described.latents,), latent)


def _features(graph: _Graph, weights: Weights) -> str:
    """Adds the scaled features of ``state`` followed by the latent."""
    described = weights.description
    angle, plain = (described.states.index(name) for name in _FEATURES[described.robot])
    axis = graph.constant([1], np.int64)
    parts = []
    for column in (angle, plain):
        ends = (graph.constant([column], np.int64), graph.constant([column + 1], np.int64))
        parts.append(graph.add("Slice", "state", *ends, axis))
    features = graph.add("Concat", graph.add("Cos", parts[0]), graph.add("Sin", parts[0]), parts[1], axis=1)
    scaled = graph.scaled(features, weights["feature_middle"], weights["feature_scale"])
    return graph.add("Concat", scaled, "latent", axis=1) if described.latents else scaled


def _affine_inputs(weights: Weights) -> dict[str, tuple[int, ...]]:
    described = weights.description
    latent = {"latent": (described.latents,)} if described.latents else {}
    return {"state": (len(described.states),), **latent}


def _actions_effect(graph: _Graph, weights: Weights, seen: str) -> str:
    """Adds g in SI units, (batch, states, actions)."""
    states, actions = len(weights.description.states), len(weights.description.actions)
    flat = graph.dense(seen, weights, "g", "Relu")
    shaped = graph.add("Reshape", flat, graph.constant([-1, states, actions], np.int64))
    return graph.add("Mul", shaped, graph.constant(weights["increment_scale"][:, None] / weights["action_scale"]))


def _f(weights: Weights) -> Any:
    """Builds f in SI units: the offset of the action scaling moves from G into f, so that f + g a needs no scales."""
    graph = _Graph("f")
    seen = _features(graph, weights)
    scaled = graph.add("Mul", graph.dense(seen, weights, "f", "Relu"), graph.constant(weights["increment_scale"]))
    middle = graph.constant(weights["action_middle"][:, None])
    offset = graph.add("MatMul", _actions_effect(graph, weights, seen), middle)
    flat = graph.add("Squeeze", offset, graph.constant([2], np.int64))
    result = graph.add("Sub", scaled, flat)
    return graph.model(_affine_inputs(weights), "f", (len(weights.description.states),), result)


def _g(weights: Weights) -> Any:
    graph = _Graph("g")
    result = _actions_effect(graph, weights, _features(graph, weights))
    shape = (len(weights.description.states), len(weights.description.actions))
    return graph.model(_affine_inputs(weights), "g", shape, result)


def _phi(weights: Weights) -> Any:
    graph = _Graph("phi")
    seen = "rows"
    for layer in layers_of(weights.tensors, "phi.dense"):
        product = graph.add("MatMul", seen, graph.constant(layer.weight.T))
        seen = graph.add("Relu", graph.add("Add", product, graph.constant(layer.bias)))
    seen = graph.add("Transpose", seen, perm=[0, 2, 1])
    for layer in layers_of(weights.tensors, "phi.conv"):
        given = (graph.constant(layer.weight), graph.constant(layer.bias))
        seen = graph.add("Relu", graph.add("Conv", seen, *given, strides=[STRIDE]))
    flat = graph.add("Flatten", seen, axis=1)
    out = (graph.constant(weights["phi.out.weight"]), graph.constant(weights["phi.out.bias"]))
    latent = graph.add("Gemm", flat, *out, transB=1)
    latent = graph.add("Max", latent, graph.constant(weights["latent_low"]))
    latent = graph.add("Min", latent, graph.constant(weights["latent_high"]))
    described = weights.description
    row = weights["phi.dense.0.weight"].shape[1]
    return graph.model({"rows": (described.history, row)}, "latent", (described.latents,), latent)


def _policy(weights: Weights) -> Any:
    graph = _Graph("policy")
    scaled = graph.scaled("observation", weights["observation_middle"], weights["observation_scale"])
    clipped = graph.add("Clip", scaled, *(graph.constant(sign * _LARGEST_OBSERVATION) for sign in (-1.0, 1.0)))
    chosen = graph.dense(clipped, weights, "policy", "Tanh")
    chosen = graph.add("Clip", chosen, graph.constant(-1.0), graph.constant(1.0))
    scale, middle = graph.constant(weights["action_scale"]), graph.constant(weights["action_middle"])
    action = graph.add("Add", graph.add("Mul", chosen, scale), middle)
    observations = weights["policy.0.weight"].shape[1]
    return graph.model({"observation": (observations,)}, "action", (len(weights.description.actions),), action)


_GRAPHS = {"mu": _mu, "f": _f, "g": _g, "phi": _phi, "policy": _policy}
