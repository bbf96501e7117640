"""Computes the surroundings for the safety filter from scans: obstacles at rest, movers, and hidden regions.

Read ``surroundings`` first (one robot, from scans to discs), then ``obstacle_tracker`` (contents of grid cells) and
``occlusion`` (where something may hide). ``scan``, ``odometry``, ``occupancy_grid`` and ``ros_map`` are their parts;
``settings``, ``zones`` and ``overrides`` are the configuration, ``source_health`` checks the sensors, and ``node`` is
the service.
"""

from safedpa.perception.node import PerceptionNode
from safedpa.perception.settings import PerceptionSettings, SourceSettings, load_perception, parse_perception
from safedpa.perception.surroundings import SurroundingsTracker
from safedpa.perception.zones import Zone

__all__ = [
    "PerceptionNode",
    "PerceptionSettings",
    "SourceSettings",
    "SurroundingsTracker",
    "Zone",
    "load_perception",
    "parse_perception",
]
