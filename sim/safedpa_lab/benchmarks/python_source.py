"""``python -m safedpa_lab.benchmarks.python_source CALLS SECONDS``: decisions without a compiler, as JSON.

Asked by the benchmark in a process in which compiling and loading compiled decisions is forbidden.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from safedpa.dynamics import load_model
from safedpa_lab.benchmarks.filter_problem import decisions, problem_with

_MODULE = "safedpa_lab.benchmarks.python_source"
_PATIENCE_SECONDS = 60.0
"""Beyond what is timed: the scene, and the beginning of a Python."""


def without_compiler(calls: int, seconds: float) -> dict[str, Any]:
    """Microseconds of decisions with physics and eight obstacles by Python, or ``{"missing": why}``."""
    command = [sys.executable, "-m", _MODULE, str(calls), repr(seconds)]
    limit = seconds + _PATIENCE_SECONDS
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
            env={**os.environ, "SAFEDPA_COMPILE": "0"},
            cwd=Path(__file__).parent,
        )
    except subprocess.TimeoutExpired:
        return {"missing": f"gave no answer within {limit:.0f} s"}
    if done.returncode != 0:
        return {"missing": (done.stderr.strip().splitlines() or ["no output"])[-1][:200]}
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


if __name__ == "__main__":
    found = decisions(problem_with(8), load_model("car"), int(sys.argv[1]), float(sys.argv[2]))
    sys.stdout.write(json.dumps(found) + "\n")
