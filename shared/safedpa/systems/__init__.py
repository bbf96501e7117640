"""Kinds of robots: names, units, bounds and angles of state and action, each declared once."""

from safedpa.systems.car import CAR, CAR_THROTTLE
from safedpa.systems.pendulum import PENDULUM
from safedpa.systems.point import POINT
from safedpa.systems.registry import add_system, systems
from safedpa.systems.system import System, Variable

__all__ = ["CAR", "CAR_THROTTLE", "PENDULUM", "POINT", "System", "Variable", "add_system", "systems"]
