"""The history encoder in onnxruntime, on one thread."""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

import numpy as np

from safedpa_lab.benchmarks.timing import timed


def main() -> None:
    """Answers one question."""
    question = json.loads(sys.stdin.read())
    runtime: Any = importlib.import_module("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = runtime.InferenceSession(bytes.fromhex(question["graph"]), options)
    name = session.get_inputs()[0].name
    rows = [np.array(history, dtype=np.float32)[None] for history in question["rows"]]
    times = timed(lambda given: session.run(None, {name: given})[0], rows, question["calls"], question["seconds"])
    sys.stdout.write("\n" + json.dumps({**times, "version": runtime.__version__}) + "\n")
