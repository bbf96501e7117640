"""Systems: names, units, bounds and angles of each robot's state and action, declared once."""

from safedpa.systems.registry import add_system, systems
from safedpa.systems.system import System, Variable

__all__ = ["System", "Variable", "add_system", "systems"]
