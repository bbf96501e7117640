"""Whether the modules that every decision runs through are the compiled ones of a built wheel, or Python source."""

from __future__ import annotations

import importlib

__all__ = ["MODULES", "compiled_modules"]

MODULES = (
    "safedpa.bus.loop.service",
    "safedpa.bus.loop.slot",
    "safedpa.bus.loop.trace",
    "safedpa.bus.transport.inbox",
    "safedpa.bus.transport.intake",
    "safedpa.dynamics.written_steps",
    "safedpa.networks.plain_rows",
    "safedpa.safety.affine_motion",
    "safedpa.robots.car.compensated_seeker",
    "safedpa.robots.car.goal_seeker",
    "safedpa.robots.car.perception",
    "safedpa.robots.car.reversed_way",
    "safedpa.robots.car.sensed_far",
    "safedpa.robots.car.written_barriers",
    "safedpa.equations.chain_rule",
    "safedpa.safety.conditions",
    "safedpa.safety.decision",
    "safedpa.safety.ceiling",
    "safedpa.safety.found_delay",
    "safedpa.safety.highest",
    "safedpa.safety.inputs",
    "safedpa.safety.lattice",
    "safedpa.safety.least_unsafe",
    "safedpa.safety.margin",
    "safedpa.safety.nearest",
    "safedpa.safety.prediction",
    "safedpa.safety.program_rows",
    "safedpa.safety.remembered",
    "safedpa.safety.retreat",
    "safedpa.safety.search",
    "safedpa.safety.searched",
    "safedpa.safety.solution",
    "safedpa.safety.tangent",
    "safedpa.safety.watched_margin",
    "safedpa.safety.way_out",
    "safedpa_sim.ground_forces",
)
"""What ``hatch_build.py`` compiles where it can; the source is the same, and an editable installation runs it."""


def compiled_modules() -> tuple[str, ...]:
    """Those of ``MODULES`` that are compiled in this installation: all of them or none."""
    files = ((name, importlib.import_module(name).__file__ or "") for name in MODULES)
    return tuple(name for name, file in files if not file.endswith(".py"))
