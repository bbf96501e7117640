"""Which models ``safedpa up`` can drive its simulated robots with."""

from __future__ import annotations

from typing import Final

from safedpa.dynamics import PhysicsModel
from safedpa.systems import systems

__all__ = ["DRIVEN", "why_not_driven"]

DRIVEN: Final = {"car": ("target_speed", "steer"), "pendulum": ("torque",), "point": ("thrust", "turn")}
"""What the simulated robots take as their action."""


def why_not_driven(model: PhysicsModel, robot: str) -> str:
    """Why ``up`` refuses the model for a robot of this kind, in words: what it is and what was wanted; empty if not."""
    system = model.system
    states = systems()[robot].state_names if robot in DRIVEN else ()
    if robot in DRIVEN and (system.name, system.state_names, system.action_names) == (robot, states, DRIVEN[robot]):
        return ""
    is_ = f"a {system.name} with {', '.join(system.action_names)} (states {', '.join(system.state_names)})"
    if robot not in DRIVEN:
        return f"{is_}, wanted one of {', '.join(DRIVEN)}"
    return f"{is_}, wanted a {robot} with {', '.join(DRIVEN[robot])} (states {', '.join(states)})"
