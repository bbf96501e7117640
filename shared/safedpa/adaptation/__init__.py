"""Adaptation: what the last seconds tell about the world that the robot is in."""

from safedpa.adaptation.abstract import AbstractEstimator
from safedpa.adaptation.estimator import EstimatorSettings, LatentEstimator
from safedpa.adaptation.history_estimator import HistoryEstimator
from safedpa.adaptation.node import AdaptationNode

__all__ = ["AbstractEstimator", "AdaptationNode", "EstimatorSettings", "HistoryEstimator", "LatentEstimator"]
