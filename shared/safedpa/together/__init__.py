"""Adaptation, policy and filter of many robots at once, in one process and without a bus."""

from safedpa.together.histories import HistoriesTogether
from safedpa.together.learned_cars import CarsTogether, Surroundings

__all__ = ["CarsTogether", "HistoriesTogether", "Surroundings"]
