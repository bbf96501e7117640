"""A fleet's diagnosis: which effect is missing in which robots, and what all of them have in common."""

from safedpa.fleet.diagnosing import Fleet, Workers, diagnose_fleet
from safedpa.fleet.inputs import Options
from safedpa.fleet.robots import By, Found, RobotLogs, robots_in_folder, robots_of_files

__all__ = [
    "By",
    "Fleet",
    "Found",
    "Options",
    "RobotLogs",
    "Workers",
    "diagnose_fleet",
    "robots_in_folder",
    "robots_of_files",
]
