"""The modules that a wheel compiles with mypyc, and whether this installation has the compiled ones."""

from __future__ import annotations

from importlib.util import find_spec

__all__ = ["MODULES", "compiled_modules"]

MODULES = (
    "safedpa.bus.service.service_loop",
    "safedpa.bus.service.robot_slot",
    "safedpa.bus.transport.inbox",
    "safedpa.robots.car.controllers.goal_seeker",
    "safedpa.robots.car.perception",
    "safedpa.robots.car.barriers.reverse_odometer",
    "safedpa.robots.car.barriers.pruning",
    "safedpa.safety.barriers.disc_selection",
    "safedpa.safety.margins.error_clipping",
    "safedpa.safety.prediction.delay_estimator",
    "safedpa.safety.validation",
    "safedpa.safety.margins.conformal",
    "safedpa.safety.margins.online",
    "safedpa.safety.deadlock.escape",
    "safedpa.safety.deadlock.detector",
    "safedpa.safety.prediction.command_history",
    "safedpa.safety.prediction.dead_time",
    "safedpa.safety.session.plausibility",
    "safedpa.safety.session.session_memory",
    "safedpa.safety.session.guarded_session",
    "safedpa.safety.session.filter_session",
    "safedpa.runtime.robot_session",
    "safedpa.safety.barriers.cache",
    "safedpa.safety.solver.constraints",
    "safedpa_sim.ground_forces",
)
"""Modules of the services on the path of every tick, apart from the decision, which is C (``safedpa.native``).

``hatch_build.py`` compiles them; an editable installation runs the source."""


def compiled_modules() -> tuple[str, ...]:
    """Returns those of ``MODULES`` that are compiled in this installation: all of them or none."""
    found = ((name, find_spec(name)) for name in MODULES)
    return tuple(name for name, spec in found if spec is not None and not str(spec.origin).endswith(".py"))
