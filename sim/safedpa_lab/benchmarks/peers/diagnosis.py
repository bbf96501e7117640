"""Programs that look for terms of equations, on logs with something hidden; one function for each."""

from __future__ import annotations

import importlib
import json
import re
import sys
import time
import warnings
from typing import Any

import numpy as np

_LEAST = 0.1
"""Of the variance that an expression has to explain; one that explains less counts as nothing found."""


def operon() -> None:
    """pyoperon: one expression for what each derivative has beyond the known model; which variables it names.

    A question has cases of runs, each with features and what the known model leaves of the derivatives.
    """
    question = json.loads(sys.stdin.read())
    operon: Any = importlib.import_module("pyoperon.sklearn")
    answers = [_of_operon(operon, case, question["seconds"]) for case in question["cases"]]
    version = importlib.import_module("importlib.metadata").version("pyoperon")
    sys.stdout.write("\n" + json.dumps({"answers": answers, "version": version}) + "\n")


def _of_operon(operon: Any, case: dict[str, Any], seconds: int) -> dict[str, Any]:
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


def pysindy() -> None:
    """pysindy, in its weak form or on the steps themselves: which terms it finds next to the known ones.

    A question has cases of runs, each with states and inputs, and the way.
    """
    warnings.simplefilter("ignore")
    question = json.loads(sys.stdin.read())
    ps: Any = importlib.import_module("pysindy")
    answers = [_of_pysindy(ps, case, question["way"], question["threshold"]) for case in question["cases"]]
    sys.stdout.write("\n" + json.dumps({"answers": answers, "version": ps.__version__}) + "\n")


def _of_pysindy(ps: Any, case: dict[str, Any], way: str, threshold: float) -> dict[str, Any]:
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
