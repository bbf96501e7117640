"""Whether the modules that every decision runs through are the compiled ones of a built wheel, or Python source."""

from __future__ import annotations

import importlib

__all__ = ["MODULES", "compiled_modules"]

MODULES = (
    "safedpa.bus.service.service_loop",
    "safedpa.bus.service.robot_slot",
    "safedpa.bus.transport.inbox",
    "safedpa.dynamics.written_steps",
    "safedpa.networks.plain_rows",
    "safedpa.safety.prediction.predictor",
    "safedpa.robots.car.controllers.goal_seeker",
    "safedpa.robots.car.perception",
    "safedpa.robots.car.barriers.reverse_odometer",
    "safedpa.robots.car.barriers.pruning",
    "safedpa.robots.car.written_barriers",
    "safedpa.equations.chain_rule",
    "safedpa.safety.solver.constraints",
    "safedpa.safety.decision",
    "safedpa.safety.margins.error_clipping",
    "safedpa.safety.prediction.delay_estimator",
    "safedpa.safety.solver.maximin_lp",
    "safedpa.safety.validation",
    "safedpa.safety.solver.candidates",
    "safedpa.safety.solver.least_violation",
    "safedpa.safety.margins.conformal",
    "safedpa.safety.solver.active_set_2d",
    "safedpa.safety.solver.qp_scaling",
    "safedpa.safety.barriers.cache",
    "safedpa.safety.solver.sqp",
    "safedpa.safety.solver.solution",
    "safedpa.safety.solver.linearization",
    "safedpa.safety.margins.online",
    "safedpa.safety.deadlock.escape",
    "safedpa_sim.ground_forces",
)
"""What ``hatch_build.py`` compiles where it can; the source is the same, and an editable installation runs it."""


def compiled_modules() -> tuple[str, ...]:
    """Those of ``MODULES`` that are compiled in this installation: all of them or none."""
    files = ((name, importlib.import_module(name).__file__ or "") for name in MODULES)
    return tuple(name for name, file in files if not file.endswith(".py"))
