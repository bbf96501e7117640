"""Checks which systems ``safedpa up`` can drive as a robot."""

from __future__ import annotations

from safedpa.systems.robots import robots
from safedpa.systems.system import System

__all__ = ["why_not_driven"]


def why_not_driven(system: System, robot: str) -> str:
    """Returns why ``up`` rejects a model of this system: what it is, what is wanted; empty: it can be driven."""
    known = robots()
    is_ = f"a {system.name} with {', '.join(system.action_names)} (states {', '.join(system.state_names)})"
    if robot not in known:
        return f"{is_}, wanted one of {', '.join(known)}"
    driven = known[robot].of_system(system).system
    if (system.name, system.state_names, system.action_names) == (robot, driven.state_names, driven.action_names):
        return ""
    wanted = " or ".join(", ".join(one.system.action_names) for one in (known[robot], *known[robot].variants))
    return f"{is_}, wanted a {robot} with {wanted} (states {', '.join(driven.state_names)})"
