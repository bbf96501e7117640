"""pyoperon: one expression for what each derivative has beyond the known model; which variables it names."""

from __future__ import annotations

import importlib
import json
import re
import sys
import time
from typing import Any

import numpy as np

_LEAST = 0.1
"""Of the variance that an expression has to explain; one that explains less counts as nothing found."""


def main() -> None:
    """Answers one question: cases of runs, each with features and what the known model leaves of the derivatives."""
    question = json.loads(sys.stdin.read())
    operon: Any = importlib.import_module("pyoperon.sklearn")
    answers = [_answer(operon, case, question["seconds"]) for case in question["cases"]]
    version = importlib.import_module("importlib.metadata").version("pyoperon")
    sys.stdout.write("\n" + json.dumps({"answers": answers, "version": version}) + "\n")


def _answer(operon: Any, case: dict[str, Any], seconds: int) -> dict[str, Any]:
    features, rests = (np.concatenate([run[name] for run in case["runs"]]) for name in ("middle", "slopes"))
    used, began = time.process_time(), time.perf_counter()
    found = []
    for rest in np.ascontiguousarray(rests.T):
        search = operon.SymbolicRegressor(max_length=15, max_time=seconds, n_threads=1, random_state=1)
        search.fit(features, rest)
        text = search.get_model_string(search.model_, 3)
        left = rest - search.predict(features)
        if left.var() > (1.0 - _LEAST) * rest.var():
            found.append({"expression": text, "variables": []})
            continue
        variables = sorted({int(number) for number in re.findall(r"X(\d+)", text)})
        found.append({"expression": text, "variables": [case["names"][number - 1] for number in variables]})
    seconds_used = {"seconds": time.perf_counter() - began, "processor_seconds": time.process_time() - used}
    return {**seconds_used, "equations": found}
