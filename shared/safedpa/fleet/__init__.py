"""A fleet's diagnosis: which effect is missing in which robots, and what all of them have in common."""

from safedpa.fleet.fleet_diagnosis import Fleet, Workers, diagnose_fleet
from safedpa.fleet.inputs import Options
from safedpa.fleet.robots import By, DiscoveredRobots, RobotLogs, robots_in_folder, robots_of_files

__all__ = [
    "By",
    "DiscoveredRobots",
    "Fleet",
    "Options",
    "RobotLogs",
    "Workers",
    "diagnose_fleet",
    "robots_in_folder",
    "robots_of_files",
]
