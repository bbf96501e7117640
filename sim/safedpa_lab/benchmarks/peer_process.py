"""Peers run in a process of their own, in whichever Python has them: their packages never meet this project's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[1]
_BEGIN = """
import sys, types
root, script = sys.argv[1:3]
package = types.ModuleType("safedpa_lab")
package.__path__ = [root]
sys.modules["safedpa_lab"] = package
import importlib
module, function = script.split(":")
getattr(importlib.import_module("safedpa_lab.benchmarks.peers." + module), function)()
"""
"""Only this project's scripts for peers are importable there, by a package of their own making: nothing else of the
environment in which this project is installed."""
_ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "JAX_ENABLE_X64": "1",
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
"""As the peers' own pages recommend for problems of this size; it makes them faster."""


def ask_peer(
    script: str, package: str, question: Mapping[str, Any], interpreters: Sequence[str], seconds: float = 180.0
) -> dict[str, Any]:
    """What a ``script``, MODULE:FUNCTION of ``peers``, answers to a question, or ``{"missing": why}``.

    ``package`` has to be importable; the first of ``interpreters`` that has it is used, this one at last.
    """
    interpreter = interpreter_with(package, tuple(interpreters))
    if interpreter is None:
        return {"missing": f"{package} is not installed here; pip install 'safedpa-lab[peers]', or --peers PYTHON"}
    command = [interpreter, "-c", _BEGIN, str(_ROOT), script]
    try:
        done = subprocess.run(
            command,
            input=json.dumps(question),
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
            env=_surroundings(),
        )
    except subprocess.TimeoutExpired:
        return {"missing": f"gave no answer within {seconds:.0f} s"}
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no words"])[-1]
        return {"missing": f"failed with exit code {done.returncode}: {last[:200]}"}
    answer: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return answer


def _surroundings() -> dict[str, str]:
    """Of a peer: one thread, and no path to packages of this Python."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | _ONE_THREAD


@cache
def interpreter_with(package: str, interpreters: tuple[str, ...]) -> str | None:
    """The first Python that finds the package; None where none does."""
    look = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({package!r}) is None)"
    for interpreter in (*interpreters, sys.executable):
        done = subprocess.run([interpreter, "-c", look], capture_output=True, check=False, env=_surroundings())
        if done.returncode == 0:
            return interpreter
    return None
