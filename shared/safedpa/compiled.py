"""Whether the modules that every decision runs through are the compiled ones of a built wheel, or Python source."""

from __future__ import annotations

import importlib

__all__ = ["MODULES", "compiled_modules"]

MODULES = (
    "safedpa.networks.plain_rows",
    "safedpa.safety.affine_motion",
    "safedpa.safety.braking",
    "safedpa.safety.car_geometry",
    "safedpa.safety.chain_rule",
    "safedpa.safety.conditions",
    "safedpa.safety.decision",
    "safedpa.safety.inputs",
    "safedpa.safety.nearest",
    "safedpa.safety.prediction",
    "safedpa.safety.program_rows",
    "safedpa.safety.remembered",
    "safedpa.safety.search",
    "safedpa.safety.solution",
    "safedpa.safety.tangent",
    "safedpa.safety.towed_reach",
)
"""What ``hatch_build.py`` compiles where it can; the source is the same, and an editable installation runs it."""


def compiled_modules() -> tuple[str, ...]:
    """Those of ``MODULES`` that are compiled in this installation: all of them or none."""
    files = ((name, importlib.import_module(name).__file__ or "") for name in MODULES)
    return tuple(name for name, file in files if not file.endswith(".py"))
