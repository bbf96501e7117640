"""Simulated robots: the reality that the services face."""

from safedpa_sim.robots.changes import CHANGES, PlannedChange
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.core import BRAKE, CarRobot
from safedpa_sim.robots.footprint import footprint
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.loads import LOADS, Load, load_named
from safedpa_sim.robots.pendulum_robot import PendulumRobot, Violation
from safedpa_sim.robots.pendulum_task import TASKS, PendulumTask, task_named
from safedpa_sim.robots.pendulum_world import PendulumWorld, wind_towards
from safedpa_sim.robots.robot import SimulatedRobot
from safedpa_sim.robots.scene import GOAL_RADIUS, Scene
from safedpa_sim.robots.shared_field import CarContact, SharedField
from safedpa_sim.robots.trace import TracedPeriod, TraceWriter, read_trace
from safedpa_sim.robots.world import CarWorld

__all__ = [
    "BRAKE",
    "CHANGES",
    "GOAL_RADIUS",
    "LOADS",
    "TASKS",
    "ActionGuard",
    "CarContact",
    "CarRobot",
    "CarWorld",
    "Collision",
    "Load",
    "PendulumRobot",
    "PendulumTask",
    "PendulumWorld",
    "PlannedChange",
    "Scene",
    "SharedField",
    "SimulatedRobot",
    "TraceWriter",
    "TracedPeriod",
    "Violation",
    "footprint",
    "load_named",
    "read_trace",
    "task_named",
    "wind_towards",
]
