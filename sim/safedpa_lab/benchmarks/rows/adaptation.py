"""One step of the learned adaptation, next to the same networks in other programs."""

from __future__ import annotations

import itertools
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation import HistoryEstimator
from safedpa.dynamics import LearnedBase, load_model
from safedpa.networks import HistoryEncoder, Weights
from safedpa_lab.benchmarks.peer_process import ask_peer
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target, microseconds, missing
from safedpa_lab.benchmarks.timing import timed

_MODEL: Final = "car_learned"
_LACKS = "the networks alone, on rows that are ready: no scaling, no history, no range"


def measure(effort: Effort) -> Row:
    """The step from a transition to the latent, and the encoder alone on a history that is ready."""
    calls, seconds = effort.of((300, 0.3), (20_000, 4.0))
    model = load_model(_MODEL)
    assert isinstance(model.base, LearnedBase)
    weights = model.base.weights
    estimator, encoder = HistoryEstimator(model), HistoryEncoder(weights)
    transitions = _transitions()
    step = timed(
        lambda given: estimator.update(given[0], given[1], given[2], model.period), transitions, calls, seconds
    )
    histories = _histories(encoder)
    alone = timed(encoder.encode, histories, calls, seconds)
    ours = (
        microseconds("safedpa, transition to latent", step),
        microseconds("safedpa, encoder", alone, note="a whole history at once"),
    )
    target = Target("p50 of a step", 25.0, step["wall"]["p50"], "us")
    history = weights.description.history
    work = f"one step of the adaptation: 1-D CNN over {history} transitions"
    return Row("adaptation", work, "p50", ours, tuple(_peers(weights, histories, calls, seconds, effort)), (target,))


def _transitions() -> list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """State, action and next state of a car that goes about."""
    random = np.random.default_rng(3)
    states = np.cumsum(random.normal(0.0, 0.02, (201, 4)), axis=0)
    return [(before, random.uniform(-0.3, 0.3, 2), after) for before, after in itertools.pairwise(states)]


def _histories(encoder: HistoryEncoder) -> list[NDArray[np.float64]]:
    random = np.random.default_rng(4)
    return [random.normal(0.0, 0.5, (encoder.length, encoder.row_length)) for _ in range(50)]


def _peers(
    weights: Weights, histories: list[NDArray[np.float64]], calls: int, seconds: float, effort: Effort
) -> list[Entry]:
    tensors = {name: value.tolist() for name, value in weights.tensors.items() if name.startswith("phi.")}
    question: dict[str, Any] = {"calls": calls, "seconds": seconds, "rows": [rows.tolist() for rows in histories]}
    found: list[Entry] = []
    asked = (
        ("torch eager", "torch", "adaptation:torch", {"tensors": tensors, "way": "eager"}),
        ("torch.jit, frozen", "torch", "adaptation:torch", {"tensors": tensors, "way": "jit"}),
        ("onnxruntime", "onnxruntime", "adaptation:onnx", {"graph": _graph(weights)}),
    )
    for name, package, script, own in asked:
        answer = ask_peer(script, package, {**question, **own}, effort.interpreters) if own.get("graph", True) else {}
        if not answer or "missing" in answer:
            why = answer.get("missing", "the package onnx, which writes the graph, is not installed")
            found.append(missing(name, why, note=_LACKS))
        else:
            found.append(microseconds(name, answer, note=_LACKS, version=answer["version"]))
    return found


def _graph(weights: Weights) -> str:
    """phi as an ONNX file, in hexadecimal digits; empty where it cannot be written."""
    import tempfile
    from pathlib import Path

    from safedpa.errors import InputError
    from safedpa_sim.training.export.onnx import export_onnx

    with tempfile.TemporaryDirectory() as folder:
        try:
            export_onnx(weights, Path(folder))
        except InputError:
            return ""
        return (Path(folder) / "phi.onnx").read_bytes().hex()
