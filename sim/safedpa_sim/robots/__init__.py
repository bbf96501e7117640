"""Simulated robots: the reality that the services face."""

from safedpa_sim.robots.changes import CHANGES, PlannedChange
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.core import BRAKE, CarRobot
from safedpa_sim.robots.footprint import footprint
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.loads import LOADS, Load, load_named
from safedpa_sim.robots.scene import GOAL_RADIUS, Scene
from safedpa_sim.robots.world import CarWorld

__all__ = [
    "BRAKE",
    "CHANGES",
    "GOAL_RADIUS",
    "LOADS",
    "ActionGuard",
    "CarRobot",
    "CarWorld",
    "Collision",
    "Load",
    "PlannedChange",
    "Scene",
    "footprint",
    "load_named",
]
