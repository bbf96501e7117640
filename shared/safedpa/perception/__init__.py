"""From scans to what a safety filter needs: what is at rest, what may move, and what no one sees."""

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
