"""``python -m safedpa_lab.benchmarks.python_source CALLS SECONDS``: decisions of this installation, as JSON.

Asked from an installation with compiled modules, it runs in a Python that does not see them, so that one line of the
benchmark stands for the compiled modules and one for the source that they are made of.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import safedpa
from safedpa.compiled import compiled_modules
from safedpa.dynamics import load_model
from safedpa_lab.benchmarks.filter_problem import decisions, problem_with

_MODULE = "safedpa_lab.benchmarks.python_source"
_PATIENCE_SECONDS = 60.0
"""Beyond what is timed: the scene, and the beginning of a Python."""


def of_source(calls: int, seconds: float) -> dict[str, Any]:
    """Microseconds of decisions with the networks and eight obstacles by the Python source, or ``{"missing": why}``."""
    if not compiled_modules():
        return {"missing": "what is measured above is the Python source: nothing is compiled in this installation"}
    compiled = Path(safedpa.__file__).parents[1]
    paths = without(compiled, os.environ.get("PYTHONPATH", ""))
    command = [sys.executable, "-m", _MODULE, str(calls), repr(seconds)]
    surroundings = {**os.environ, "PYTHONPATH": paths}
    limit = seconds + _PATIENCE_SECONDS
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
            env=surroundings,
            cwd=Path(__file__).parent,
        )
    except subprocess.TimeoutExpired:
        return {"missing": f"gave no answer within {limit:.0f} s"}
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no words"])[-1]
        return {"missing": f"without {compiled} no source is found: {last[:200]}"}
    answer: dict[str, Any] = json.loads(done.stdout)
    if answer.pop("compiled"):
        return {"missing": "this Python has no source next to the compiled modules"}
    return answer


def without(folder: Path, paths: str) -> str:
    """The entries of a PYTHONPATH but ``folder``."""
    retained = [path for path in paths.split(os.pathsep) if path and Path(path).resolve() != folder.resolve()]
    return os.pathsep.join(retained)


def _main(calls: int, seconds: float) -> None:
    found = decisions(problem_with(8), load_model("car_learned"), calls, seconds)
    sys.stdout.write(json.dumps({**found, "compiled": bool(compiled_modules())}) + "\n")


if __name__ == "__main__":
    _main(int(sys.argv[1]), float(sys.argv[2]))
