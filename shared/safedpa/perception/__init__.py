"""Computes the surroundings for the safety filter from scans: obstacles at rest, movers, and hidden regions.

Read ``surroundings`` first (one robot, from scans to discs), then ``obstacle_tracker`` (contents of grid cells) and
``occlusion`` (where something may hide). ``scan``, ``odometry``, ``occupancy_grid`` and ``ros_map`` are their parts;
``readings`` turns point clouds, depth images, ranges, grids and polygons into rays. ``settings``, ``zones`` and
``overrides`` are the configuration, ``source_health`` checks the sensors, and ``node`` is the service.
"""

from safedpa.perception.node import PerceptionNode
from safedpa.perception.readings import (
    Camera,
    HeightBand,
    Rays,
    rays_of_depth,
    rays_of_grid,
    rays_of_points,
    rays_of_polygon,
    rays_of_range,
)
from safedpa.perception.settings import PerceptionSettings, SourceSettings, load_perception, parse_perception
from safedpa.perception.surroundings import SurroundingsTracker
from safedpa.perception.zones import Zone

__all__ = [
    "Camera",
    "HeightBand",
    "PerceptionNode",
    "PerceptionSettings",
    "Rays",
    "SourceSettings",
    "SurroundingsTracker",
    "Zone",
    "load_perception",
    "parse_perception",
    "rays_of_depth",
    "rays_of_grid",
    "rays_of_points",
    "rays_of_polygon",
    "rays_of_range",
]
