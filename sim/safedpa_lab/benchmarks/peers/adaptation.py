"""The history encoder in other programs, on one thread; a function for each answers one question."""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

import numpy as np

from safedpa_lab.benchmarks.timing import timed

_STRIDE = 4


def onnx() -> None:
    """In onnxruntime."""
    question = json.loads(sys.stdin.read())
    runtime: Any = importlib.import_module("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = runtime.InferenceSession(bytes.fromhex(question["graph"]), options)
    name = session.get_inputs()[0].name
    rows = [np.array(history, dtype=np.float32)[None] for history in question["rows"]]
    times = timed(lambda given: session.run(None, {name: given})[0], rows, question["calls"], question["seconds"])
    sys.stdout.write("\n" + json.dumps({**times, "version": runtime.__version__}) + "\n")


def torch() -> None:
    """As layers of torch, eager or as a frozen script, without gradients."""
    question = json.loads(sys.stdin.read())
    torch: Any = importlib.import_module("torch")
    torch.set_num_threads(1)
    encoder = _encoder(torch, question["tensors"]).eval()
    rows = [torch.tensor(history, dtype=torch.float32).unsqueeze(0) for history in question["rows"]]
    with torch.inference_mode():
        if question["way"] == "jit":
            encoder = torch.jit.freeze(torch.jit.trace(encoder, rows[0]))
        times = timed(lambda given: encoder(given).numpy(), rows, question["calls"], question["seconds"])
    sys.stdout.write("\n" + json.dumps({**times, "version": torch.__version__}) + "\n")


def _encoder(torch: Any, tensors: dict[str, Any]) -> Any:
    layers: list[Any] = []
    for kind, prefix in (("Linear", "phi.dense"), ("Conv1d", "phi.conv")):
        index = 0
        while f"{prefix}.{index}.weight" in tensors:
            weight = torch.tensor(tensors[f"{prefix}.{index}.weight"])
            bias = torch.tensor(tensors[f"{prefix}.{index}.bias"])
            sizes = (weight.shape[1], weight.shape[0])
            more = {} if kind == "Linear" else {"kernel_size": weight.shape[2], "stride": _STRIDE}
            layer = getattr(torch.nn, kind)(*sizes, **more)
            layer.load_state_dict({"weight": weight, "bias": bias})
            layers += [layer, torch.nn.ReLU()]
            index += 1
        if kind == "Linear":
            layers.append(_transposed(torch))
    weight = torch.tensor(tensors["phi.out.weight"])
    out = torch.nn.Linear(weight.shape[1], weight.shape[0])
    out.load_state_dict({"weight": weight, "bias": torch.tensor(tensors["phi.out.bias"])})
    return torch.nn.Sequential(*layers, torch.nn.Flatten(), out)


def _transposed(torch: Any) -> Any:
    class Transposed(torch.nn.Module):  # type: ignore[misc]
        def forward(self, x: Any) -> Any:
            return x.transpose(1, 2)

    return Transposed()
