"""The modules that a wheel compiles with mypyc, and whether this installation has the compiled ones."""

from __future__ import annotations

from importlib.util import find_spec

__all__ = ["MODULES", "compiled_modules"]

MODULES = (
    "safedpa.bus.service.service_loop",
    "safedpa.bus.service.robot_slot",
    "safedpa.bus.transport.inbox",
    "safedpa.dynamics.generated_steps",
    "safedpa.networks.plain_rows",
    "safedpa.safety.prediction.predictor",
    "safedpa.robots.car.controllers.goal_seeker",
    "safedpa.robots.car.perception",
    "safedpa.robots.car.barriers.reverse_odometer",
    "safedpa.robots.car.barriers.pruning",
    "safedpa.robots.car.generated_barriers",
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
"""Modules on the path of every decision. ``hatch_build.py`` compiles them; an editable installation runs the source."""


def compiled_modules() -> tuple[str, ...]:
    """Returns those of ``MODULES`` that are compiled in this installation: all of them or none."""
    found = ((name, find_spec(name)) for name in MODULES)  # None: a generated module, in an installation without them
    return tuple(name for name, spec in found if spec is not None and not str(spec.origin).endswith(".py"))
