"""Simulated robots, which stand in for hardware; read ``robot`` first, then ``loop``.

``robot`` is the base class of every simulated robot, ``guard`` its check of actions and its watchdog. ``car``,
``pendulum`` and ``point_robot`` are the robots; ``stand_in_robot`` simulates any robot package from its own equations.
``loop`` runs one robot on the bus, ``fleet`` many. ``python -m safedpa_sim.robots`` is the command.
"""

from safedpa_sim.robots.car.loads import LOADS, footprint, load_named
from safedpa_sim.robots.car.robot import BRAKE, CHANGES, CarRobot, PlannedChange
from safedpa_sim.robots.car.scene import GOAL_RADIUS, Scene
from safedpa_sim.robots.car.shared_field import SharedField
from safedpa_sim.robots.car.world import CarWorld
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.pendulum.robot import TASKS, PendulumRobot, task_named
from safedpa_sim.robots.pendulum.world import PendulumWorld, wind_towards
from safedpa_sim.robots.run_summary import TraceWriter, read_trace

__all__ = [
    "BRAKE",
    "CHANGES",
    "GOAL_RADIUS",
    "LOADS",
    "TASKS",
    "ActionGuard",
    "CarRobot",
    "CarWorld",
    "PendulumRobot",
    "PendulumWorld",
    "PlannedChange",
    "Scene",
    "SharedField",
    "TraceWriter",
    "footprint",
    "load_named",
    "read_trace",
    "task_named",
    "wind_towards",
]
