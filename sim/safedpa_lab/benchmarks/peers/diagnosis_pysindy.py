"""pysindy, in its weak form or on the steps themselves: which terms it finds next to the known ones."""

from __future__ import annotations

import importlib
import json
import sys
import time
import warnings
from typing import Any

import numpy as np

_WAYS = {"polynomial": "_polynomial", "weak": "_weak"}


def main() -> None:
    """Answers one question: cases of runs, each with states and inputs, and the way."""
    warnings.simplefilter("ignore")
    question = json.loads(sys.stdin.read())
    ps: Any = importlib.import_module("pysindy")
    answers = [_answer(ps, case, question["way"], question["threshold"]) for case in question["cases"]]
    sys.stdout.write("\n" + json.dumps({"answers": answers, "version": ps.__version__}) + "\n")


def _answer(ps: Any, case: dict[str, Any], way: str, threshold: float) -> dict[str, Any]:
    rests, slopes, middle = ([np.array(run[name]) for run in case["runs"]] for name in ("rests", "slopes", "middle"))
    used, began = time.process_time(), time.perf_counter()
    t = case["period"] * np.arange(len(rests[0]))
    library = ps.PolynomialLibrary(degree=2)
    variables = [2 + number for number in range(len(case["names"]))]
    chosen = _weak(ps, library, t) if way == "weak" else library
    model = ps.SINDy(
        optimizer=ps.STLSQ(threshold=threshold, alpha=1e-3),
        feature_library=ps.GeneralizedLibrary([chosen], inputs_per_library=[variables]),
    )
    derivatives = {} if way == "weak" else {"x_dot": slopes}
    names = ["rest_yaw", "rest_speed", *case["names"]]
    model.fit(rests, t=t if way == "weak" else case["period"], u=middle, feature_names=names, **derivatives)
    terms = [name.strip() for name in model.get_feature_names()]
    found = [
        {name: float(value) for name, value in zip(terms, row, strict=True) if value != 0.0}
        for row in model.coefficients()
    ]
    seconds = {"seconds": time.perf_counter() - began, "processor_seconds": time.process_time() - used}
    return {**seconds, "equations": found, "terms": len(terms)}


def _weak(ps: Any, library: Any, t: Any) -> Any:
    np.random.seed(0)  # where it puts its subdomains is drawn from numpy's global generator
    return ps.WeakPDELibrary(function_library=library, spatiotemporal_grid=t, K=400, is_uniform=True, include_bias=True)
