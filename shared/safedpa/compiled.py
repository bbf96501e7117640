"""Whether the modules that every decision runs through are the compiled ones of a built wheel, or Python source."""

from __future__ import annotations

import importlib

__all__ = ["MODULES", "compiled_modules"]

MODULES = (
    "safedpa.networks.plain_rows",
    "safedpa.safety.affine_motion",
    "safedpa.robots.car.written_barriers",
    "safedpa.robots.car.written_steps",
    "safedpa.equations.chain_rule",
    "safedpa.safety.conditions",
    "safedpa.safety.decision",
    "safedpa.safety.inputs",
    "safedpa.safety.lattice",
    "safedpa.safety.least_unsafe",
    "safedpa.safety.nearest",
    "safedpa.safety.prediction",
    "safedpa.safety.program_rows",
    "safedpa.safety.remembered",
    "safedpa.safety.retreat",
    "safedpa.safety.search",
    "safedpa.safety.solution",
    "safedpa.safety.tangent",
)
"""What ``hatch_build.py`` compiles where it can; the source is the same, and an editable installation runs it."""


def compiled_modules() -> tuple[str, ...]:
    """Those of ``MODULES`` that are compiled in this installation: all of them or none."""
    files = ((name, importlib.import_module(name).__file__ or "") for name in MODULES)
    return tuple(name for name, file in files if not file.endswith(".py"))
