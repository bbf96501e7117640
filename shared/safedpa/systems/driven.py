"""What the robots that ``safedpa up`` drives take as their action, and which systems fit."""

from __future__ import annotations

from typing import Final

from safedpa.systems.registry import systems
from safedpa.systems.system import System

__all__ = ["DRIVEN", "why_not_driven"]

DRIVEN: Final = {"car": ("target_speed", "steer"), "pendulum": ("torque",), "point": ("thrust", "turn")}
"""Actions by kind of robot."""


def why_not_driven(system: System, robot: str) -> str:
    """Why ``up`` refuses a model of this system for a robot of this kind: what it is, what was wanted; empty if not."""
    states = systems()[robot].state_names if robot in DRIVEN else ()
    if robot in DRIVEN and (system.name, system.state_names, system.action_names) == (robot, states, DRIVEN[robot]):
        return ""
    is_ = f"a {system.name} with {', '.join(system.action_names)} (states {', '.join(system.state_names)})"
    if robot not in DRIVEN:
        return f"{is_}, wanted one of {', '.join(DRIVEN)}"
    return f"{is_}, wanted a {robot} with {', '.join(DRIVEN[robot])} (states {', '.join(states)})"
