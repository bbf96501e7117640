"""Adaptation: what the last seconds tell about the world that the robot is in."""

from safedpa.adaptation.estimator import EstimatorSettings, LatentEstimator
from safedpa.adaptation.node import AdaptationNode

__all__ = ["AdaptationNode", "EstimatorSettings", "LatentEstimator"]
