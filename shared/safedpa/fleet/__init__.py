"""Diagnosis of a fleet from recordings: which robots lack which effect, and what they have in common.

``robots`` assigns recordings to robots, ``one_robot`` diagnoses each of them in ``workers``. ``similar_robots`` groups
robots with the same effects; ``pooled_evidence`` controls the false discovery rate and, with ``common``, finds effects
of the whole fleet. ``document``, ``page`` and ``summary`` present the result. Read ``fleet_diagnosis.py`` first.
"""

from safedpa.fleet.fleet_diagnosis import Fleet, Workers, diagnose_fleet
from safedpa.fleet.one_robot import Options
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
