"""From scans to what a safety filter needs: what is at rest, what may move, and what nobody sees."""

from safedpa.perception.node import PerceptionNode
from safedpa.perception.settings import PerceptionSettings
from safedpa.perception.surroundings import Surroundings

__all__ = ["PerceptionNode", "PerceptionSettings", "Surroundings"]
